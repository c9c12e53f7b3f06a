"""Stamps of point sources as arrays, checked; the constants of their fit."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np
from jaxtyping import Bool, Float, Int

from udccal.cfa import cfa_named
from udccal.errors import FitError
from udccal.result import FitStatus


@final
@dataclass(frozen=True)
class Stamps:
    """What a fit is given: each stamp is cut about one point source; what else shines has been subtracted.

    Attributes:
        values_e: samples in electrons; NaN where nothing is known.
        position_px: of each stamp's middle sample (``rows // 2, columns // 2``) on the sensor, (x, y).
        read_e: standard deviation of a sample's noise without light, in electrons, quantisation included.
        clip_e: samples at or above it tell only that they are so.
        channel: of each sample (0 = R, 1 = G, 2 = B) of raw mosaics; ``None`` where all samples are of one kind.
    """

    values_e: Float[np.ndarray, "stars rows columns"]
    position_px: Int[np.ndarray, "positions 2"]
    read_e: float
    clip_e: float = np.inf
    channel: Int[np.ndarray, "*channels"] | None = None

    def __post_init__(self) -> None:
        count, *sides = self.values_e.shape
        if min(sides) < 7 or max(sides) > 255:
            raise FitError(f"Expected stamps of 7 to 255 samples a side, found {sides[0]} x {sides[1]}. Cut them anew.")
        if self.values_e.size > 2**26:
            raise FitError(f"Expected at most {2**26} samples, found {self.values_e.size}. Use fewer stamps.")
        if len(self.position_px) != count:
            raise FitError(f"Expected a position for each of {count} stamps, found {len(self.position_px)}.")
        if not (np.isfinite(self.read_e) and self.read_e > 0):
            raise FitError(f"Expected a read noise above 0 e-, found {self.read_e}. Count the quantisation into it.")
        if not self.clip_e > 0:
            raise FitError(f"Expected a clipping level above 0 e-, found {self.clip_e}. Leave it out if nothing clips.")
        if self.channel is None:
            return
        if self.channel.shape != self.values_e.shape:
            raise FitError(f"Expected a channel for every sample, {self.values_e.shape}, found {self.channel.shape}.")
        found = np.unique(self.channel)
        if not np.array_equal(found, np.arange(len(found))) or len(found) > 3:
            raise FitError(f"Expected channels 0, 1 and 2 without gaps, found {found.tolist()}. Number them from 0.")

    @cached_property
    def known(self) -> Bool[np.ndarray, "stars samples"]:
        """Which samples of each stamp, row by row, tell something."""
        return np.isfinite(self.values_e).reshape(len(self.values_e), -1)

    @cached_property
    def value_e(self) -> Float[np.ndarray, "stars samples"]:
        """The samples, zero where nothing is known."""
        return np.where(self.known, self.values_e.reshape(self.known.shape), 0.0)

    @cached_property
    def clipped(self) -> Bool[np.ndarray, "stars samples"]:
        """Which samples tell only that they are at or above the clipping level."""
        return self.known & (self.value_e >= self.clip_e)

    @cached_property
    def plane(self) -> Int[np.ndarray, "stars samples"]:
        """Colour of every sample."""
        return (np.zeros(self.known.shape, int) if self.channel is None else self.channel).reshape(self.known.shape)

    @cached_property
    def by_plane(self) -> Bool[np.ndarray, "planes stars samples"]:
        """Known samples of each colour."""
        return self.known & (self.plane == np.arange(self.plane.max() + 1)[:, None, None])

    @cached_property
    def offset_px(self) -> Float[np.ndarray, "samples 2"]:
        """(x, y) of every sample from the middle one."""
        return offsets(*self.values_e.shape[1:])

    @cached_property
    def frame_px(self) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
        """Centre c and half size h of the stamps' positions p, for which (p - c) / h is within [-1, 1]."""
        low, high = self.position_px.min(axis=0), self.position_px.max(axis=0)
        return (low + high) / 2.0, np.maximum((high - low) / 2.0, 1.0)

    @cached_property
    def unit(self) -> Float[np.ndarray, "stars 2"]:
        """Positions scaled to [-1, 1]."""
        return (self.position_px - self.frame_px[0]) / self.frame_px[1]


@final
@dataclass(frozen=True)
class StampsRules:
    """The constants of a fit of stamps.

    Attributes:
        least_snr: light over noise of the median stamp, at least.
        fewest_unclipped: stamps, at least, whose core (1.5 px about the middle) is neither clipped nor missing.
        outlier_sigma: samples further off, in robust sigma, are left out.
        star_ratio, star_lost: stamps are left out whose mean square is over so many times the median's, or that lose
            more than such a part of their samples.
        coarse: degrees of map and images, and the relative model error that is allowed for, of the fits that lead from
            a round star to a field.
        spacings_px: of nodes, the coarsest first.
        worth_finer: nodes are made denser again where the criterion may still fall by so much.
        highest: degrees of map and images.
        steps_to_compare, steps_to_end: of one fit at most: of orders that are compared, and of those that are chosen.
        evidence: converged when the last step brought less log evidence, and the next promises half of it in log
            posterior. Near the maximum precisions and unknowns go on to trade places by hundredths.
        beyond_doubt: log posterior; maps of lower degrees that are expected to lose more are not fitted.
        first_image: precisions before the data: of images of degree 0 (size, roughness) and of higher ones.
        first_map, first_lateral: of maps of degrees 1 and 2, and of lateral colour.
        new_image, new_map: of higher degrees, relative to the degree below, and as it is: nearly absent. Where the data
            ask for them, one update makes them appear.
        draws: of the posterior: for updates of precisions, and for error bars (5 % of a sigma).
        inflate_above: reduced chi-squared above which every sigma grows with its root. Counts are skewed: theirs
            scatters more than that of normal samples.
        poor_above: reduced chi-squared beyond which this is no psf field.
    """

    least_snr: float = 10.0
    fewest_unclipped: int = 3
    outlier_sigma: float = 5.0
    star_ratio: float = 3.0
    star_lost: float = 0.2
    coarse: tuple[tuple[int, int, float], ...] = ((0, 0, 0.3), (0, 0, 0.1), (2, 0, 0.05), (2, 1, 0.02))
    spacings_px: tuple[float, ...] = (1.0, 0.75, 0.5)
    worth_finer: float = 200.0
    highest: tuple[int, int] = (4, 3)
    steps_to_compare: int = 1
    steps_to_end: int = 12
    evidence: float = 2.0
    beyond_doubt: float = 200.0
    first_image: tuple[tuple[float, float], tuple[float, float]] = ((1e-3, 1e-4), (30.0, 30.0))
    first_map: float = 100.0
    first_lateral: float = 10.0
    new_image: float = 20.0
    new_map: float = 3e4
    draws: tuple[int, int] = (16, 192)
    inflate_above: float = 1.05
    poor_above: float = 2.0


def mosaic_channels(
    cfa: str, position_px: Int[np.ndarray, "stars 2"], rows: int, columns: int
) -> Int[np.ndarray, "stars rows columns"]:
    """Channels of stamps cut from a mosaic; for ``Stamps.channel``.

    Args:
        cfa: pattern of the mosaic, such as "RGGB".
        position_px: of the stamps' middle samples on the sensor, (x, y).
        rows, columns: of a stamp.

    Returns:
        0, 1, 2 for R, G, B, of every sample.

    Raises:
        ValueError: when there is no such pattern.
    """
    pattern = cfa_named(cfa)
    y = position_px[:, 1, None] - rows // 2 + np.arange(rows)
    x = position_px[:, 0, None] - columns // 2 + np.arange(columns)
    return pattern.channels[y[:, :, None] % pattern.rows, x[:, None, :] % pattern.columns]


def centroids(stamps: Stamps, window_px: float) -> Float[np.ndarray, "stars 2"]:
    """Under a Gaussian that follows, all colours alike: of light per sample, each colour by its own number of them."""
    centre = np.zeros((len(stamps.unit), 2))
    for _ in range(15):
        off = stamps.offset_px - centre[:, None]
        weight = stamps.by_plane * np.exp(-0.5 * (off**2).sum(axis=2) / window_px**2)
        light = weight * np.maximum(stamps.value_e, 0.0)
        # The mean under the weight alone is taken off: samples of a mosaic do not lie evenly about the centre.
        mean = np.einsum("pks,ksi->pki", weight, off) / np.maximum(weight.sum(axis=2), 1e-300)[..., None]
        top = np.einsum("pks,ksi->ki", light, off) - (light.sum(axis=2)[..., None] * mean).sum(axis=0)
        move = 2 * top / np.maximum(light.sum(axis=(0, 2)), 1e-300)[:, None]
        centre = np.clip(centre + np.clip(move, -1.0, 1.0), -3.0, 3.0)
    return centre


def light_of(stamps: Stamps) -> Float[np.ndarray, "stars planes"]:
    """Sums, scaled up for samples that are missing; in light per pixel of all colours."""
    known = np.maximum(stamps.by_plane.sum(axis=2), 1)
    total = (stamps.value_e * stamps.by_plane).sum(axis=2) * stamps.value_e.shape[1] / known
    return np.maximum(total, 10 * stamps.read_e).T


def unusable(stamps: Stamps, rules: StampsRules) -> tuple[FitStatus, str] | None:
    """What makes a fit impossible, if anything."""
    core = stamps.by_plane & (np.abs(stamps.offset_px).max(axis=1) <= 1.5)
    light = (stamps.value_e * stamps.by_plane).sum(axis=2)
    noise = np.sqrt(np.maximum(light, 0.0) + stamps.by_plane.sum(axis=2) * stamps.read_e**2)
    snr = float(np.median(light / np.maximum(noise, 1e-300), axis=1).min())
    if snr < rules.least_snr:
        needed = f"at least {rules.least_snr:.0f} are needed."
        return FitStatus.TOO_DARK, f"Light over noise of a stamp is {snr:.1f} in the median; {needed}"
    clear = int((core.any(axis=2) & ~(core & stamps.clipped).any(axis=2)).sum(axis=1).min())
    if clear < rules.fewest_unclipped:
        needed = f"{rules.fewest_unclipped} are needed."
        return FitStatus.SATURATED, f"{clear} stamps have a core that is not clipped or missing; {needed}"
    return None


def offsets(rows: int, columns: int) -> Float[np.ndarray, "samples 2"]:
    """(x, y) of every sample of a stamp from its middle one, row by row."""
    y, x = np.mgrid[:rows, :columns].reshape(2, -1)
    return np.stack([x - columns // 2, y - rows // 2], axis=1).astype(np.float64)
