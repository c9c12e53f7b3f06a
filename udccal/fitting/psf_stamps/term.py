"""The psf field that stamps tell: kernels anywhere in the field, and how sure they are."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import final

import numpy as np
import scipy.sparse
from jaxtyping import Float

from udccal.fitting.psf_stamps.field import TAPS, Changes, PlaneField, polynomials, see
from udccal.numerics import in_float64

_CHUNK = 8
_CENTRING = 20


@dataclass(frozen=True)
class Kernels:
    """Kernels at some positions with what belongs to their convention.

    Attributes:
        value: each sums to 1.
        centre_px: where the model's own centre lies beside the kernel's, (x, y).
        total: light in the window per unit of the model's light.
        change: of the kernels, of the centre and, relatively, of the total, along the columns of the term's factor.
        jacobian: of the model's light by its centre.
    """

    value: Float[np.ndarray, "n rows columns"]
    centre_px: Float[np.ndarray, "n 2"]
    total: Float[np.ndarray, " n"]
    change: Float[np.ndarray, "n pixels k"]
    centre_change: Float[np.ndarray, "n 2 k"]
    total_change: Float[np.ndarray, "n k"]
    jacobian: Float[np.ndarray, "n pixels 2"]


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
        factor: of the covariance of all unknowns, in the order of ``Changes``: draws of the posterior over the root of
            their number, so that sigmas are known to 5 %. It holds what the model leaves unexplained.
        centre_px, half_px: positions scale as (p - centre) / half; beyond one half the field is extrapolated.
        rows, columns: of kernels.
        window_px: standard deviation of the Gaussian that weights centroids.
        reference: the plane that centres are of.
        star_px, star_place_px, star_light_e: of the stars in the fit: middle samples on the sensor; the model's own
            centres and light, of which ``sources`` are the convention's.
    """

    fields: tuple[PlaneField, ...]
    factor: Float[np.ndarray, "unknowns k"]
    centre_px: Float[np.ndarray, "2"]
    half_px: Float[np.ndarray, "2"]
    rows: int
    columns: int
    window_px: float
    reference: int
    star_px: Float[np.ndarray, "stars 2"]
    star_place_px: Float[np.ndarray, "stars 2"]
    star_light_e: Float[np.ndarray, "stars planes"]

    @in_float64
    def predict(self, position_px: Float[np.ndarray, "n 2"], plane: int = 0) -> Float[np.ndarray, "n rows columns"]:
        """Kernels of light centred on the middle sample, at positions (x, y) on the sensor in px."""
        return np.concatenate([self._plain(part, plane)[0] for part in _parts(position_px)])

    @in_float64
    def sigma(self, position_px: Float[np.ndarray, "n 2"], plane: int = 0) -> Float[np.ndarray, "n rows columns"]:
        """One standard deviation of every pixel of ``predict``."""
        parts = [_spread(kernels.change) for kernels in self.kernels(position_px, plane)]
        return np.concatenate(parts).reshape(-1, self.rows, self.columns)

    @in_float64
    def relative_l2(self, position_px: Float[np.ndarray, "n 2"], plane: int = 0) -> Float[np.ndarray, "n 2"]:
        """Error of ``predict`` that is to be expected, relative to the kernel's L2 norm: root mean square, and spread.

        After the best amplitude and shift, which are a matter of convention.
        """
        return np.concatenate([self._relative(kernels) for kernels in self.kernels(position_px, plane)])

    def _relative(self, kernels: Kernels) -> Float[np.ndarray, "n 2"]:
        flat = kernels.value.reshape(len(kernels.value), -1)
        free, _ = np.linalg.qr(np.concatenate([flat[..., None], kernels.jacobian], axis=2))
        change = kernels.change - free @ (free.transpose(0, 2, 1) @ kernels.change)
        each = np.sqrt((change**2).sum(axis=1)) / np.linalg.norm(flat, axis=1)[:, None]
        return np.stack([_spread(each), np.sqrt(each.shape[1]) * each.std(axis=1)], axis=1)

    @in_float64
    def sources(self) -> Sources:
        """Places and light of the stars in the fit, with one standard deviation."""
        change = self._changes.stars
        place, place_change, light, light_sigma = self.star_place_px, change[:, :2], [], []
        for plane in range(len(self.fields)):
            parts = list(self.kernels(self.star_px, plane))
            light.append(self.star_light_e[:, plane] * np.concatenate([part.total for part in parts]))
            relative = change[:, 2 + plane] + np.concatenate([part.total_change for part in parts])
            light_sigma.append(light[-1] * _spread(relative))
            if plane == self.reference:
                place = place - np.concatenate([part.centre_px for part in parts])
                place_change = place_change - np.concatenate([part.centre_change for part in parts])
        return Sources(place, _spread(place_change), np.stack(light, axis=1), np.stack(light_sigma, axis=1))

    def changed(self, vector: Float[np.ndarray, " unknowns"]) -> StampsPsf:
        """The term with changes of its unknowns, in the order of ``Changes``: what the posterior of a fit draws."""
        changes = Changes.of(self.fields, len(self.star_px), vector[:, None])
        return replace(
            self,
            fields=changes.applied(self.fields),
            star_place_px=self.star_place_px + changes.stars[:, :2, 0],
            star_light_e=self.star_light_e * np.exp(changes.stars[:, 2:, 0]),
        )

    @property
    def _changes(self) -> Changes:
        return Changes.of(self.fields, len(self.star_px), self.factor)

    def unit(self, position_px: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Positions scaled for the polynomials."""
        return (np.asarray(position_px, dtype=np.float64) - self.centre_px) / self.half_px

    def kernels(self, position_px: Float[np.ndarray, "n 2"], plane: int) -> Iterator[Kernels]:
        """Kernels with their changes, some positions at a time. Call in double precision."""
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
        own, own_jacobian = self._change(unit, centre, self.reference)
        moved = np.einsum("pi,npk->nik", window, own)
        by_centre = np.einsum("pj,npi->nji", window, own_jacobian)
        centre_change = -np.linalg.solve(by_centre, moved)
        change, jacobian = (own, own_jacobian) if plane == self.reference else self._change(unit, centre, plane)
        change = change + jacobian @ centre_change
        relative = change.sum(axis=1) / total[:, None]
        flat = value.reshape(len(unit), -1)
        shape = change / total[:, None, None] - flat[..., None] * relative[:, None]
        return Kernels(value, centre, total, shape, centre_change, relative, jacobian)

    def _change(
        self, unit: Float[np.ndarray, "n 2"], centre: Float[np.ndarray, "n 2"], plane: int
    ) -> tuple[Float[np.ndarray, "n pixels k"], Float[np.ndarray, "n pixels 2"]]:
        """Of the model's light along the columns of the factor, and its derivatives by the centre."""
        field, changes = self.fields[plane], self._changes
        seen = see(field, unit, centre, self._grid(len(unit)))
        basis, columns = polynomials(unit, field.image_degree), field.nodes.shape[2]
        step = (np.arange(TAPS)[:, None] * columns + np.arange(TAPS)).ravel()
        out = []
        for k, terms in enumerate(basis):
            weights = seen.down[k][:, :, None] * seen.across[k][:, None, :]
            index = (seen.first[k][:, None] + step).ravel()
            ends = np.arange(0, index.size + 1, TAPS**2)
            shape = (len(seen.first[k]), changes.nodes[plane].shape[1])
            matrix = scipy.sparse.csr_array((weights.ravel(), index, ends), shape=shape)
            out.append(matrix @ np.tensordot(terms, changes.nodes[plane], axes=1))
        jacobian = np.asarray(seen.slopes)
        maps = (
            (field.warp_degree, changes.warp[plane], jacobian[..., 2:]),
            (field.lateral_degree, changes.lateral[plane], jacobian[..., :2]),
        )
        change = np.stack(out)
        for degree, own, by in maps:
            values = polynomials(unit, degree)[:, 1:]
            change += by @ np.tensordot(values, own.reshape(values.shape[1], by.shape[2], own.shape[1]), axes=1)
        return change, jacobian[..., :2]


def _spread(change: Float[np.ndarray, "*n k"]) -> Float[np.ndarray, "*n"]:
    return np.asarray(np.sqrt((change**2).sum(axis=-1)))


def _parts(position_px: Float[np.ndarray, "n 2"]) -> Iterator[Float[np.ndarray, "m 2"]]:
    """Of one size, as far as it goes, for what is compiled."""
    position = np.asarray(position_px, dtype=np.float64)
    for start in range(0, len(position), _CHUNK):
        yield position[start : start + _CHUNK]
