"""The psf field of stamps as a term: kernels anywhere in the field, and the stars' places and light, with sigmas."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, final

import numpy as np
from jaxtyping import Float

from udccal.arguments import check_count, check_positions
from udccal.errors import FitError
from udccal.fitting.psf_stamps.data import offsets
from udccal.fitting.psf_stamps.field import (
    OWN,
    Changes,
    PsfField,
    Seen,
    by_maps,
    changes_of_images,
    changes_of_light,
    see,
)
from udccal.fitting.psf_stamps.probability import LEAST
from udccal.numerics import in_float64

# Of a psf's area, over that at the stars: what a map does beyond is no measurement.
_MOST_STRETCH = 3.0


class Kernels(NamedTuple):
    """Kernels, model centres relative to theirs, light in the window; changes along the factor (relative for light)."""

    value: Float[np.ndarray, "n pixels"]
    centre_px: Float[np.ndarray, "n 2"]
    total: Float[np.ndarray, " n"]
    change: Float[np.ndarray, "n pixels k"]
    centre_change: Float[np.ndarray, "n 2 k"]
    total_change: Float[np.ndarray, "n k"]
    jacobian: Float[np.ndarray, "n pixels 2"]


class Sources(NamedTuple):
    """A fit's stars in the term's convention: (x, y) from the middle sample, and light in the window by colour."""

    place_px: Float[np.ndarray, "stars 2"]
    place_sigma_px: Float[np.ndarray, "stars 2"]
    light_e: Float[np.ndarray, "stars planes"]
    light_sigma_e: Float[np.ndarray, "stars planes"]


@final
@dataclass(frozen=True)
class StampsPsf:
    """The psf field of stamps; every colour of a mosaic is a plane.

    A kernel sums to 1 over its window. The centroid of the field's reference plane, under a Gaussian of ``window_px``,
    is the kernel's centre; other planes keep their lateral colour relative to it.

    Attributes:
        field: of all colours.
        factor: of the covariance of all unknowns, in the order of ``Changes``: draws of the posterior over the root of
            their number, so that sigmas are known to 5 %. It includes the inflation by the misfit.
        centre_px, half_px: positions scale as (p - centre) / half; beyond one half the field is extrapolated.
        rows, columns: of kernels.
        window_px: standard deviation of the Gaussian that weights centroids.
        star_px, star_place_px, star_light_e: of the stars in the fit: middle samples on the sensor; the model's own
            centres and light, which ``sources`` converts to the convention.
    """

    field: PsfField
    factor: Float[np.ndarray, "unknowns k"]
    centre_px: Float[np.ndarray, "2"]
    half_px: Float[np.ndarray, "2"]
    rows: int
    columns: int
    window_px: float
    star_px: Float[np.ndarray, "stars 2"]
    star_place_px: Float[np.ndarray, "stars 2"]
    star_light_e: Float[np.ndarray, "stars planes"]

    @in_float64
    def predict(self, position_px: Float[np.ndarray, "n 2"], plane: int = 0) -> Float[np.ndarray, "n rows columns"]:
        """Return kernels centred on the middle sample, at positions (x, y) on the sensor in px.

        Raises:
            FitError: when positions are none on a sensor, or far from all stars, or there is no such plane; so do
                ``sigma`` and ``relative_l2``.
        """
        parts = [kernels.value for kernels in replace(self, factor=self.factor[:, :0])._asked(position_px, plane)]
        return np.concatenate([*parts, self._no_kernels]).reshape(-1, self.rows, self.columns)

    @in_float64
    def sigma(self, position_px: Float[np.ndarray, "n 2"], plane: int = 0) -> Float[np.ndarray, "n rows columns"]:
        """Return one standard deviation of every pixel of ``predict``."""
        parts = []
        for kernels in self._asked(position_px, plane):
            sigma, peak = np.linalg.norm(kernels.change, axis=2), np.abs(kernels.value).max(axis=1, keepdims=True)
            # Beyond the nodes, nothing is known but that light is below the least that the prior expects.
            parts.append(np.where(sigma > 0, sigma, LEAST * peak))
        return np.concatenate([*parts, self._no_kernels]).reshape(-1, self.rows, self.columns)

    @in_float64
    def relative_l2(self, position_px: Float[np.ndarray, "n 2"], plane: int = 0) -> Float[np.ndarray, "n 2"]:
        """Return the expected error of ``predict`` relative to the kernel's L2 norm: root mean square, and spread.

        The error is the one after the best amplitude and shift, which are a matter of convention.
        """
        each = [np.zeros((0, self.factor.shape[1]))]
        for kernels in self._asked(position_px, plane):
            free, _ = np.linalg.qr(np.concatenate([kernels.value[..., None], kernels.jacobian], axis=2))
            change = kernels.change - free @ (free.transpose(0, 2, 1) @ kernels.change)
            each.append(np.linalg.norm(change, axis=1) / np.linalg.norm(kernels.value, axis=1)[:, None])
        every = np.concatenate(each)
        return np.stack([np.linalg.norm(every, axis=1), np.sqrt(every.shape[1]) * every.std(axis=1)], axis=1)

    @in_float64
    def sources(self) -> Sources:
        """Return places and light of the stars in the fit, with one standard deviation."""
        own = Changes.of(self.field, len(self.star_px), self.factor).stars
        light, relative = self.star_light_e.copy(), np.zeros_like(self.star_light_e)
        for plane in range(light.shape[1]):
            every = self._kernels(self.star_px, plane)
            parts = zip(*((k.centre_px, k.total, k.centre_change, k.total_change) for k in every), strict=True)
            centre, total, centre_change, total_change = (np.concatenate(part) for part in parts)
            light[:, plane] *= total
            relative[:, plane] = np.linalg.norm(own[:, 2 + plane] + total_change, axis=1)
        # Kernels of all planes have the centre of the reference.
        sigma_px = np.linalg.norm(own[:, :2] - centre_change, axis=2)
        return Sources(self.star_place_px - centre, sigma_px, light, light * relative)

    def changed(self, vector: Float[np.ndarray, " unknowns"]) -> StampsPsf:
        """Return the term with changes of its unknowns, in the order of ``Changes``; a fit's posterior draws these."""
        changes = Changes.of(self.field, len(self.star_px), vector[:, None])
        field = self.field.moved(changes)
        unknowns = len(self.factor) - changes.mix.size + field.nodes.size - self.field.nodes.size
        return replace(
            self,
            field=field,
            # What is drawn has no spread of its own.
            factor=np.zeros((unknowns, 1)),
            star_place_px=self.star_place_px + changes.stars[:, :2, 0],
            star_light_e=self.star_light_e * np.exp(changes.stars[:, 2 : 2 + len(self.field.nodes), 0]),
        )

    @property
    def _no_kernels(self) -> Float[np.ndarray, "0 pixels"]:
        """What there is at no position at all."""
        return np.zeros((0, self.rows * self.columns))

    def with_own_window(self) -> StampsPsf:
        """Return the term with a window as wide as its middle kernel, whose noise-equivalent area is 4 pi sigma^2."""
        middle = replace(self, factor=self.factor[:, :0])._kernels(self.centre_px[None], self.field.reference)
        return replace(self, window_px=float(1 / np.sqrt(4 * np.pi * (next(middle).value ** 2).sum())))

    def _asked(self, position_px: Float[np.ndarray, "n 2"], plane: int) -> Iterator[Kernels]:
        """Yield kernels at positions that somebody asks for."""
        check_positions(position_px, "n", "Give (x, y) in px for each kernel.", FitError)
        check_count(plane, "a plane", 0, len(self.field.nodes) - 1, FitError)
        self._check_like_stars(position_px)
        return self._kernels(position_px, plane)

    def _kernels(self, position_px: Float[np.ndarray, "n 2"], plane: int) -> Iterator[Kernels]:
        """Yield kernels with their changes, eight positions at a time: this size needs one compilation."""
        grid = offsets(self.rows, self.columns)
        window = grid * np.exp(-0.5 * (grid**2).sum(axis=1) / self.window_px**2)[:, None]
        for start in range(0, len(position_px), 8):
            unit = self._unit(position_px[start : start + 8])
            centre = self._centres(unit, window)
            reference = _, own, by_centre = self._light(unit, centre, self.field.reference)
            centre_change = -np.linalg.solve(window.T @ by_centre, window.T @ own)
            same = plane == self.field.reference
            light, change, jacobian = reference if same else self._light(unit, centre, plane)
            change = change + jacobian @ centre_change
            total = light.sum(axis=1)
            value, relative = light / total[:, None], change.sum(axis=1) / total[:, None]
            shape = change / total[:, None, None] - value[..., None] * relative[:, None]
            yield Kernels(value, centre, total, shape, centre_change, relative, jacobian)

    def _unit(self, position_px: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        return (np.asarray(position_px, dtype=np.float64) - self.centre_px) / self.half_px

    @cached_property
    def _star_areas(self) -> Float[np.ndarray, "stars planes"]:
        """By how much the map makes images of each plane larger at the stars."""
        return np.asarray(np.linalg.det(self.field.maps(self._unit(self.star_px))))

    def _check_like_stars(self, position_px: Float[np.ndarray, "n 2"]) -> None:
        """Refuse positions at which the map stretches far more or less than at any star: its polynomials run away."""
        reference = self.field.reference
        areas = np.linalg.det(self.field.maps(self._unit(position_px))[:, reference])
        least, most = self._star_areas[:, reference].min(), self._star_areas[:, reference].max()
        # A poor fit may turn the map over at a star.
        low, high = min(least / _MOST_STRETCH, least), max(most * _MOST_STRETCH, most)
        off = ~((areas >= low) & (areas <= high))
        if off.any():
            (left, top), (right, bottom) = self.centre_px - self.half_px, self.centre_px + self.half_px
            x, y = position_px[off][0]
            raise FitError(
                f"Expected positions where the psf is like that of the stars (x {left:.0f} to {right:.0f}, y {top:.0f} "
                f"to {bottom:.0f} px), found ({x:.6g}, {y:.6g}). Ask for positions nearer to them, or add stars there."
            )

    def _centres(
        self, unit: Float[np.ndarray, "n 2"], window: Float[np.ndarray, "pixels 2"]
    ) -> Float[np.ndarray, "n 2"]:
        """Find the model's centre for which the reference plane's centroid is 0, by Newton's method."""
        centre, grid = np.zeros_like(unit), offsets(self.rows, self.columns)
        plane = np.full((len(unit), len(grid)), self.field.reference)
        for _ in range(20):
            seen = see(self.field, unit, centre, grid, plane)
            off = window.T @ seen.value[..., None]
            move = -np.linalg.solve(window.T @ seen.jacobian[..., 1:3], off)[..., 0]
            centre = centre + np.clip(move, -0.5, 0.5)
            if np.abs(move).max() < 1e-9:
                break
        return centre

    def _light(
        self, unit: Float[np.ndarray, "n 2"], centre: Float[np.ndarray, "n 2"], plane: int
    ) -> tuple[Float[np.ndarray, "n pixels"], Float[np.ndarray, "n pixels k"], Float[np.ndarray, "n pixels 2"]]:
        """Return the model's light, its changes along the columns of the factor, and its derivatives by the centre."""
        field, grid, k = self.field, offsets(self.rows, self.columns), self.factor.shape[1]
        changes = Changes.of(field, len(self.star_px), self.factor)
        seen = see(field, unit, centre, grid, np.full((len(unit), len(grid)), plane))
        index, matrix = by_maps(field, unit, plane)
        own, used, change = matrix @ changes.maps[index], np.arange(len(grid)), np.empty((*seen.value.shape, k))
        size = np.random.default_rng(4).standard_normal(k) / np.sqrt(max(k, 1))
        own.reshape(len(unit), OWN, k)[:, 3:7] += self._beyond_stars(unit, plane).reshape(-1, 4, 1) * size
        # One star at a time: changes of its image along all draws may take 10 MB.
        for star in range(len(unit)):
            one = slice(star, star + 1)
            images = changes_of_images(field, unit[one], changes, plane)
            of_star = own[star * OWN : (star + 1) * OWN]
            change[star] = changes_of_light(Seen(*(part[one] for part in seen)), of_star, images, used)
        return seen.value, change, seen.jacobian[..., 1:3]

    def _beyond_stars(self, unit: Float[np.ndarray, "n 2"], plane: int) -> Float[np.ndarray, "n 2 2"]:
        """Return the part of the map by which it stretches more, or less, than at any star.

        It is one more standard deviation: where there are no stars around, polynomials may do anything.
        """
        maps, like = self.field.maps(unit)[:, plane], np.abs(self._star_areas[:, plane])
        areas = np.abs(np.linalg.det(maps))
        stretch = 1 - np.sqrt(np.clip(areas, like.min(), like.max()) / areas)
        return maps * stretch[:, None, None]
