"""The psf field that stamps tell: kernels anywhere in the field, and how sure they are."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import final

import numpy as np
import scipy.sparse
from jaxtyping import Float

from udccal.fitting.psf_stamps.field import TAPS, PlaneField, polynomials, see
from udccal.numerics import in_float64

_CHUNK = 8
_CENTRING = 20


@dataclass(frozen=True)
class Draws:
    """Draws of the posterior about its mode; their covariance is that of the fit.

    Attributes:
        nodes: by colour. warp, lateral: by colour, flat.
        centre_px, light: of the stars in the fit; light relatively, by colour.
    """

    nodes: tuple[Float[np.ndarray, "_terms _nodes draws"], ...]
    warp: tuple[Float[np.ndarray, "_numbers draws"], ...]
    lateral: tuple[Float[np.ndarray, "_numbers draws"], ...]
    centre_px: Float[np.ndarray, "stars 2 draws"]
    light: Float[np.ndarray, "stars planes draws"]


@dataclass(frozen=True)
class Kernels:
    """Kernels at some positions with what belongs to their convention.

    Attributes:
        value: each sums to 1.
        centre_px: where the model's own centre lies beside the kernel's, (x, y).
        total: light in the window per unit of the model's light.
        change: of the kernels, of the centre and, relatively, of the total, draw by draw.
    """

    value: Float[np.ndarray, "n rows columns"]
    centre_px: Float[np.ndarray, "n 2"]
    total: Float[np.ndarray, " n"]
    change: Float[np.ndarray, "n pixels draws"]
    centre_change: Float[np.ndarray, "n 2 draws"]
    total_change: Float[np.ndarray, "n draws"]
    slope: Float[np.ndarray, "n pixels 2"]


@final
@dataclass(frozen=True)
class Sources:
    """The stars of a fit in the term's convention: (x, y) from the middle sample, and light in the window by colour."""

    place_px: Float[np.ndarray, "stars 2"]
    place_sigma_px: Float[np.ndarray, "stars 2"]
    light_e: Float[np.ndarray, "stars planes"]
    light_sigma_e: Float[np.ndarray, "stars planes"]


@final
@dataclass(frozen=True)
class StampsPsf:
    """The psf field of stamps; every colour of a mosaic is a plane.

    A kernel sums to 1 over its window. Its centre is where the centroid under a Gaussian of ``window_px`` vanishes, of
    the plane ``reference``; other planes keep their lateral colour beside it.

    Attributes:
        fields: by colour.
        draws: of the posterior.
        centre_px, half_px: positions scale as (p - centre) / half; beyond one half the field is extrapolated.
        rows, columns: of kernels.
        window_px: standard deviation of the Gaussian that weights centroids.
        reference: the plane that centres are of.
        star_px, star_place_px, star_light_e: of the stars in the fit: middle samples on the sensor; the model's own
            centres and light, of which ``sources`` are the convention's.
        inflation: of every sigma, for what the model leaves unexplained; 1 when it explains all.
    """

    fields: tuple[PlaneField, ...]
    draws: Draws
    centre_px: Float[np.ndarray, "2"]
    half_px: Float[np.ndarray, "2"]
    rows: int
    columns: int
    window_px: float
    reference: int
    star_px: Float[np.ndarray, "stars 2"]
    star_place_px: Float[np.ndarray, "stars 2"]
    star_light_e: Float[np.ndarray, "stars planes"]
    inflation: float

    @in_float64
    def predict(self, position_px: Float[np.ndarray, "n 2"], plane: int = 0) -> Float[np.ndarray, "n rows columns"]:
        """Kernels of light centred on the middle sample, at positions (x, y) on the sensor in px."""
        return np.concatenate([self._plain(part, plane)[0] for part in _parts(position_px)])

    @in_float64
    def sigma(self, position_px: Float[np.ndarray, "n 2"], plane: int = 0) -> Float[np.ndarray, "n rows columns"]:
        """One standard deviation of every pixel of ``predict``."""
        parts = [kernels.change.std(axis=2) for kernels in self.kernels(position_px, plane)]
        return self.inflation * np.concatenate(parts).reshape(-1, self.rows, self.columns)

    @in_float64
    def relative_l2(self, position_px: Float[np.ndarray, "n 2"], plane: int = 0) -> Float[np.ndarray, "n 2"]:
        """Error of ``predict`` that is to be expected, relative to the kernel's L2 norm: root mean square, and spread.

        After the best amplitude and shift, which are a matter of convention.
        """
        return np.concatenate([self._relative(kernels) for kernels in self.kernels(position_px, plane)])

    def _relative(self, kernels: Kernels) -> Float[np.ndarray, "n 2"]:
        flat = kernels.value.reshape(len(kernels.value), -1)
        free, _ = np.linalg.qr(np.concatenate([flat[..., None], kernels.slope], axis=2))
        change = kernels.change - free @ (free.transpose(0, 2, 1) @ kernels.change)
        each = np.sqrt((change**2).sum(axis=1)) / np.linalg.norm(flat, axis=1)[:, None]
        return self.inflation * np.stack([np.sqrt((each**2).mean(axis=1)), each.std(axis=1)], axis=1)

    @in_float64
    def sources(self) -> Sources:
        """Places and light of the stars in the fit, with one standard deviation."""
        place, place_change = self.star_place_px, self.draws.centre_px
        light, light_change = [], []
        for plane in range(len(self.fields)):
            parts = list(self.kernels(self.star_px, plane))
            total = np.concatenate([part.total for part in parts])
            light.append(self.star_light_e[:, plane] * total)
            light_change.append(self.draws.light[:, plane] + np.concatenate([part.total_change for part in parts]))
            if plane == self.reference:
                place = place - np.concatenate([part.centre_px for part in parts])
                place_change = place_change - np.concatenate([part.centre_change for part in parts])
        size = np.stack(light, axis=1)
        relative = np.stack([change.std(axis=1) for change in light_change], axis=1)
        return Sources(place, self.inflation * place_change.std(axis=2), size, self.inflation * relative * size)

    def unit(self, position_px: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Positions scaled for the polynomials."""
        return (np.asarray(position_px, dtype=np.float64) - self.centre_px) / self.half_px

    def kernels(self, position_px: Float[np.ndarray, "n 2"], plane: int) -> Iterator[Kernels]:
        """Kernels with their draws, some positions at a time. Call in double precision."""
        for part in _parts(position_px):
            yield self._drawn(part, plane)

    def _grid(self, count: int) -> Float[np.ndarray, "n pixels 2"]:
        y, x = np.mgrid[: self.rows, : self.columns].reshape(2, -1)
        offsets = np.stack([x - self.columns // 2, y - self.rows // 2], axis=1).astype(np.float64)
        return np.broadcast_to(offsets, (count, *offsets.shape))

    def _window(self) -> Float[np.ndarray, "pixels 2"]:
        """Gaussian weight times place."""
        grid = self._grid(1)[0]
        return grid * np.exp(-0.5 * (grid**2).sum(axis=1) / self.window_px**2)[:, None]

    def _centres(self, unit: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Where the model's centre must lie for the reference plane's centroid to vanish, by Newton's method."""
        centre, window = np.zeros_like(unit), self._window()
        for _ in range(_CENTRING):
            seen = see(self.fields[self.reference], unit, centre, self._grid(len(unit)))
            off = np.asarray(seen.value) @ window
            slope = np.einsum("npi,pj->nji", np.asarray(seen.slopes)[..., :2], window)
            move = np.linalg.solve(slope, -off[..., None])[..., 0]
            centre = centre + np.clip(move, -0.5, 0.5)
            if np.abs(move).max() < 1e-9:
                break
        return centre

    def _plain(
        self, position_px: Float[np.ndarray, "n 2"], plane: int
    ) -> tuple[Float[np.ndarray, "n rows columns"], Float[np.ndarray, "n 2"], Float[np.ndarray, " n"]]:
        unit = self.unit(position_px)
        centre = self._centres(unit)
        value = np.asarray(see(self.fields[plane], unit, centre, self._grid(len(unit))).value)
        total = value.sum(axis=1)
        return (value / total[:, None]).reshape(-1, self.rows, self.columns), centre, total

    def _drawn(self, position_px: Float[np.ndarray, "n 2"], plane: int) -> Kernels:
        unit = self.unit(position_px)
        value, centre, total = self._plain(position_px, plane)
        window = self._window()
        own, own_slope = self._change(unit, centre, self.reference)
        moved = np.einsum("pi,npd->nid", window, own)
        by_centre = np.einsum("pj,npi->nji", window, own_slope)
        centre_change = -np.linalg.solve(by_centre, moved)
        change, slope = (own, own_slope) if plane == self.reference else self._change(unit, centre, plane)
        change = change + slope @ centre_change
        relative = change.sum(axis=1) / total[:, None]
        flat = value.reshape(len(unit), -1)
        shape = change / total[:, None, None] - flat[..., None] * relative[:, None]
        return Kernels(value, centre, total, shape, centre_change, relative, slope)

    def _change(
        self, unit: Float[np.ndarray, "n 2"], centre: Float[np.ndarray, "n 2"], plane: int
    ) -> tuple[Float[np.ndarray, "n pixels draws"], Float[np.ndarray, "n pixels 2"]]:
        """Of the model's light with the posterior's draws, and its slopes to the centre."""
        field = self.fields[plane]
        seen = [np.asarray(part) for part in see(field, unit, centre, self._grid(len(unit)))]
        _, slopes, first, down, across, _ = seen
        basis = polynomials(unit, field.image_degree)
        nodes = self.draws.nodes[plane]
        columns = field.nodes.shape[2]
        step = (np.arange(TAPS)[:, None] * columns + np.arange(TAPS)).ravel()
        taps = (down[..., :, None] * across[..., None, :]).reshape(*first.shape, -1)
        out = []
        for k in range(len(unit)):
            ends = np.arange(0, taps[k].size + 1, TAPS**2)
            index = (first[k][:, None] + step).ravel()
            matrix = scipy.sparse.csr_array((taps[k].ravel(), index, ends), shape=(first.shape[1], nodes.shape[1]))
            out.append(matrix @ np.tensordot(basis[k], nodes, axes=1))
        warp = _field_change(unit, field.warp_degree, self.draws.warp[plane], 4)
        lateral = _field_change(unit, field.lateral_degree, self.draws.lateral[plane], 2)
        change = np.stack(out) + slopes[..., 2:] @ warp + slopes[..., :2] @ lateral
        return change, slopes[..., :2]


def _field_change(
    unit: Float[np.ndarray, "n 2"], degree: int, draws: Float[np.ndarray, "numbers draws"], each: int
) -> Float[np.ndarray, "n each draws"]:
    basis = polynomials(unit, degree)[:, 1:]
    return np.tensordot(basis, draws.reshape(basis.shape[1], each, draws.shape[1]), axes=1)


def _parts(position_px: Float[np.ndarray, "n 2"]) -> Iterator[Float[np.ndarray, "m 2"]]:
    """Of one size, as far as it goes, for what is compiled."""
    position = np.asarray(position_px, dtype=np.float64)
    for start in range(0, len(position), _CHUNK):
        yield position[start : start + _CHUNK]
