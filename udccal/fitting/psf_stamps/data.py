"""Stamps of point sources as arrays, checked; the constants of their fit."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np
from jaxtyping import Bool, Float, Int

from udccal.arguments import check_array, check_number, check_positions, number_of
from udccal.cfa import cfa_named
from udccal.errors import FitError
from udccal.fitting.engine.robust import robust_sigma
from udccal.fitting.psf_stamps.field import polynomials
from udccal.models.fields import polynomial_terms
from udccal.result import FitStatus


@final
@dataclass(frozen=True)
class Stamps:
    """Data of a fit: each stamp is cut about one point source; other light has been subtracted.

    Attributes:
        values_e: samples in electrons; NaN where nothing is known.
        position_px: of each stamp's middle sample (``rows // 2, columns // 2``) on the sensor, (x, y).
        read_e: standard deviation of a sample's noise without light, in electrons, quantisation included.
        clip_e: level in electrons; a sample at or above it counts only as "at least that bright".
        channel: of each sample (0 = R, 1 = G, 2 = B) of raw mosaics; ``None`` for one plane.
    """

    values_e: Float[np.ndarray, "stars rows columns"]
    position_px: Int[np.ndarray, "positions 2"]
    read_e: float
    clip_e: float = np.inf
    channel: Int[np.ndarray, "*channels"] | None = None

    def __post_init__(self) -> None:
        axes, advice = ("stars", "rows", "columns"), "Cut one stamp about each star."
        check_array(self.values_e, "stamps", "real numbers", axes, advice, FitError)
        count, *sides = self.values_e.shape
        if min(sides) < 7 or max(sides) > 255:
            raise FitError(f"Expected stamps of 7 to 255 samples a side, found {sides[0]} x {sides[1]}. Cut them anew.")
        if self.values_e.size > 2**26:
            raise FitError(f"Expected at most {2**26} samples, found {self.values_e.size}. Use fewer stamps.")
        advice = "Give each stamp's middle sample."
        check_positions(self.position_px, count, advice, FitError)
        bounds, advice = (1e-6, 1e9), "Count the quantisation into it."
        check_number(number_of(self.read_e), "a read noise in e-", bounds, advice, FitError)
        advice = "Leave it out if nothing clips."
        check_number(number_of(self.clip_e), "a clipping level in e-", (1e-6, np.inf), advice, FitError)
        self._check_different()
        if self.channel is None:
            return
        advice = "Name the colour of every sample."
        check_array(self.channel, "channels", "whole numbers", self.values_e.shape, advice, FitError)
        found = np.unique(self.channel)
        if not np.array_equal(found, np.arange(len(found))) or len(found) > 3:
            raise FitError(f"Expected channels 0, 1 and 2 without gaps, found {found.tolist()}. Number them from 0.")

    def _check_different(self) -> None:
        """A FitError where all stamps have one place, or some are copies: noise is never the same twice."""
        if len(self.position_px) > 1 and not np.ptp(self.position_px, axis=0).any():
            raise FitError("Expected stamps from several places, found one. Give each stamp's own middle sample.")
        marks = [hash(one.tobytes()) for one in self.values_e if np.isfinite(one).any() and np.ptp(one) != 0]
        if copies := len(marks) - len(set(marks)):
            raise FitError(f"Expected a stamp of each star, found {copies} that are copies of others. Leave them out.")

    @cached_property
    def known(self) -> Bool[np.ndarray, "stars samples"]:
        """True for samples with a value; each stamp is row by row."""
        return np.isfinite(np.asarray(self.values_e)).reshape(len(self.values_e), -1)

    @cached_property
    def value_e(self) -> Float[np.ndarray, "stars samples"]:
        """The samples in electrons, zero where nothing is known."""
        # Sums of half precision would overflow.
        return np.where(self.known, self.values_e.reshape(self.known.shape), 0.0).astype(np.float64, copy=False)

    @cached_property
    def clipped(self) -> Bool[np.ndarray, "stars samples"]:
        """True for samples at or above the clipping level."""
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
        position_px = self.position_px.astype(np.float64)
        low, high = position_px.min(axis=0), position_px.max(axis=0)
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
        least_snr: least light over noise of the median stamp.
        fewest_unclipped: least number of stamps whose core (1.5 px about the middle) is neither clipped nor missing.
        outlier_sigma: samples further off, in robust sigma, are left out.
        star_ratio, star_lost: a stamp is left out if its mean square exceeds the median's by the first factor, or if it
            loses more than the second fraction of its samples.
        coarse: assumed relative model errors of the fits that lead from a round star to a field.
        spacings_px: spacings of nodes, the coarsest first.
        most_spacing_px: spacing below which fields of one image end.
        highest: largest degrees of the map and of the images' strengths.
        least_across: a mixture of polynomials of degree 1 that is smaller at the stars, RMS, is not determined: they
            lie on a line. 0.5 is usual.
        least_of_degree: the same of higher degrees, which are left out; at least 0.06 on drawn sets of 20 and more.
        strength_doubt: the likeliest width of strengths' prior is a guess: draws take a variance as much larger.
        image_beyond, images_at_once: new images are as many as this, of those whose significance is at least this part
            of the best one's.
        narrow_px: kernels whose Gaussian of the same area is narrower start with denser nodes.
        most_work: rows of nodes times the cube of unknowns in a row; images other than the first have nodes in the
            middle of the grid only, so many that a factor takes a quarter of a second and 0.1 GB.
        most_images: largest number of images that a search tries.
        worth_finer: expected decrease of the criterion from which denser nodes are tried, and chi-squared by which
            these must change what is expected of stars, at the end, if there are several images.
        steps_to_compare, steps_to_end: most steps of one fit, for orders that are compared, and for the chosen one.
        evidence, evidence_of_nodes: a fit has converged when the last step gained less log evidence than this (or than
            the second number times the nodes), and the next predicts less than half of it in log posterior: 0.03 is a
            quarter of a sigma for each node. Every sigma includes the way that is left.
        beyond_doubt: log posterior; a mode further away is not trusted.
        first_image: precisions before the data: of the first image (size, roughness), and of further ones.
        first_map, first_lateral: the same of maps of degrees 1 and 2, and of lateral colour.
        most_pedestal: part of a star's light that lies evenly all over a stamp: one standard deviation before the data.
        first_pedestal: the same of its change over the field, at first.
        new_map: the same of higher degrees. They start nearly absent; one update makes them appear where the data
            support them.
        draws: numbers of posterior draws: for updates of precisions, and for error bars (5 % of a sigma).
        prior_doubt: part by which the variance of nodes that the prior alone determines is larger than the prior's.
            0.5 keeps all but a thousandth of a kernel's pixels within 4.1 sigma on the seven of 350 drawn sets where
            they reached 4.3 to 4.7 without it.
        parts: of the stars, of which one at a time is left out to see the errors of the others' field.
        inflate_above: reduced chi-squared above which every sigma grows with its root. Counts are skewed, so that
            their chi-squared scatters more than that of normal samples.
        noise_off: part by which reduced chi-squared is below 1 where the noise given is too large.
        poor_above: reduced chi-squared above which the fit is poor; likewise squared errors of stars that were left
            out, in units of the expected ones.
        least_predicted: a fit is poor where stars that were left out are off by more than this part of the change of
            kernels over the field, and by more than is expected.
        poor_error: expected relative error of kernels above which the fit is poor.
    """

    least_snr: float = 10.0
    fewest_unclipped: int = 3
    outlier_sigma: float = 5.0
    star_ratio: float = 3.0
    star_lost: float = 0.2
    coarse: tuple[float, ...] = (0.3, 0.1, 0.05, 0.02)
    spacings_px: tuple[float, ...] = (1.0, 0.7, 0.5, 0.35)
    most_spacing_px: float = 0.7
    highest: tuple[int, int] = (4, 4)
    least_across: float = 0.1
    least_of_degree: float = 0.02
    strength_doubt: float = 4.0
    image_beyond: float = 0.1
    images_at_once: int = 3
    narrow_px: float = 0.7
    most_work: float = 3e8
    most_images: int = 10
    worth_finer: float = 200.0
    steps_to_compare: int = 4
    steps_to_end: int = 20
    evidence: float = 2.0
    evidence_of_nodes: float = 0.03
    beyond_doubt: float = 200.0
    first_image: tuple[tuple[float, float], tuple[float, float]] = ((1e-3, 1e-4), (30.0, 30.0))
    first_map: float = 100.0
    first_lateral: float = 10.0
    most_pedestal: float = 0.1
    first_pedestal: float = 0.01
    new_map: float = 3e4
    draws: tuple[int, int] = (16, 192)
    prior_doubt: float = 0.5
    parts: int = 4
    inflate_above: float = 1.05
    noise_off: float = 0.1
    poor_above: float = 2.0
    least_predicted: float = 0.7
    poor_error: float = 0.1


def mosaic_channels(
    cfa: str, position_px: Int[np.ndarray, "stars 2"], rows: int, columns: int
) -> Int[np.ndarray, "stars rows columns"]:
    """Return the channels of stamps cut from a mosaic, for ``Stamps.channel``.

    Args:
        cfa: pattern of the mosaic, such as "RGGB".
        position_px: of the stamps' middle samples on the sensor, (x, y).
        rows, columns: of a stamp.

    Returns:
        0, 1, 2 for R, G, B at every sample.

    Raises:
        ValueError: when there is no such pattern.
    """
    pattern = cfa_named(cfa)
    y = position_px[:, 1, None] - rows // 2 + np.arange(rows)
    x = position_px[:, 0, None] - columns // 2 + np.arange(columns)
    return pattern.channels[y[:, :, None] % pattern.rows, x[:, None, :] % pattern.columns]


def centroids(
    stamps: Stamps, background_e: Float[np.ndarray, "stars planes"], window_px: float
) -> Float[np.ndarray, "stars 2"]:
    """Return each star's centroid, (x, y) in px, under a Gaussian that follows it, from all colours together."""
    centre = np.zeros((len(stamps.unit), 2))
    for _ in range(15):
        off = stamps.offset_px - centre[:, None]
        weight = stamps.by_plane * np.exp(-0.5 * (off**2).sum(axis=2) / window_px**2)
        light = weight * np.maximum(stamps.value_e - background_e.T[..., None], 0.0)
        # Subtract the mean under the weight alone: samples of a mosaic do not lie evenly about the centre.
        mean = np.einsum("pks,ksi->pki", weight, off) / np.maximum(weight.sum(axis=2), 1e-300)[..., None]
        top = np.einsum("pks,ksi->ki", light, off) - (light.sum(axis=2)[..., None] * mean).sum(axis=0)
        move = 2 * top / np.maximum(light.sum(axis=(0, 2)), 1e-300)[:, None]
        centre = np.clip(centre + np.clip(move, -1.0, 1.0), -3.0, 3.0)
    return centre


def backgrounds(stamps: Stamps) -> Float[np.ndarray, "stars planes"]:
    """Return the light per sample that is not the stars', from the stamps' edges; 0 for all where there is none.

    A psf's own light at the edge grows with a star's light, a background does not.
    """
    far = at_edge(stamps)
    out = np.zeros((len(stamps.unit), len(stamps.by_plane)))
    for plane, seen in enumerate(stamps.by_plane):
        stars = np.flatnonzero((seen & far).sum(axis=1) > 8)
        if len(stars) < 4:
            continue
        edge = np.array([np.median(stamps.value_e[star, seen[star] & far]) for star in stars])
        light = ((stamps.value_e[stars] - edge[:, None]) * seen[stars]).sum(axis=1)
        off = light - np.median(light)
        spread = np.median(np.abs(off)) + 1e-300
        # The slope of the edge by light, from stars of usual light.
        usual = np.abs(off) < 5 * spread
        wing = max(float(off[usual] @ edge[usual]) / max(float(off[usual] @ off[usual]), 1e-300), 0.0)
        left = edge - wing * light
        scatter, noise = robust_sigma(left - np.median(left)), np.median(np.maximum(edge, 0.0)) + stamps.read_e**2
        noise = np.sqrt(1.6 * noise / (seen & far)[stars].sum(axis=1).mean())
        doubt = max(scatter, noise) * np.sqrt((1.0 + (np.median(light) / spread) ** 2) / len(stars))
        if abs(np.median(left)) > 5.0 * doubt or scatter > max(4.0 * noise, wing * np.median(light)):
            out[:, plane] = np.median(left)
            out[stars, plane] = left
    return out


def edge_light(stamps: Stamps) -> float:
    """Return the light of a sample at the stamps' edges, wings and background together, RMS over colours."""
    light = [np.median(stamps.value_e[own]) if own.any() else 0.0 for own in stamps.by_plane & at_edge(stamps)]
    return float(np.linalg.norm(light) / np.sqrt(len(light)))


def at_edge(stamps: Stamps) -> Bool[np.ndarray, " samples"]:
    """Return the samples that are a stamp's border."""
    return (np.abs(stamps.offset_px) / (np.array(stamps.values_e.shape[:0:-1]) // 2)).max(axis=1) > 0.85


def light_of(stamps: Stamps, background_e: Float[np.ndarray, "stars planes"]) -> Float[np.ndarray, "stars planes"]:
    """Return each star's light by colour: sums, scaled up for missing samples, as light per pixel of all colours."""
    known = np.maximum(stamps.by_plane.sum(axis=2), 1)
    light = (stamps.value_e - background_e.T[..., None]) * stamps.by_plane
    total = light.sum(axis=2) * stamps.value_e.shape[1] / known
    return np.maximum(total, 10 * stamps.read_e).T


def unusable(stamps: Stamps, rules: StampsRules) -> tuple[FitStatus, str] | None:
    """Return a status and a note if a fit is impossible, or None."""
    core = stamps.by_plane & (np.abs(stamps.offset_px).max(axis=1) <= 1.5)
    light = ((stamps.value_e - backgrounds(stamps).T[..., None]) * stamps.by_plane).sum(axis=2)
    noise = np.sqrt(np.maximum(light, 0.0) + stamps.by_plane.sum(axis=2) * stamps.read_e**2)
    snr = float(np.median(light / np.maximum(noise, 1e-300), axis=1).min())
    if snr < rules.least_snr:
        needed = f"at least {rules.least_snr:.0f} are needed."
        return FitStatus.TOO_DARK, f"Light over noise of a stamp is {snr:.1f} in the median; {needed}"
    clear = int((core.any(axis=2) & ~(core & stamps.clipped).any(axis=2)).sum(axis=1).min())
    if clear < rules.fewest_unclipped:
        needed = f"{rules.fewest_unclipped} are needed."
        return FitStatus.SATURATED, f"{clear} stamps have a core that is not clipped or missing; {needed}"
    quadratic = 2 * polynomial_terms(2) > len(stamps.unit) or determined(stamps, 2, rules.least_of_degree)
    if not (quadratic and determined(stamps, 1, rules.least_across)):
        told = (
            "The stamps lie on a line or two, or at a few places, and tell nothing of the psf between and beside them."
        )
        return FitStatus.TOO_FEW_DATA, f"{told} One psf for all places is given. Spread them over the field."
    return None


def determined(stamps: Stamps, degree: int, least: float) -> bool:
    """Return whether no mixture of polynomials up to a degree is smaller at the stars than this, root mean square."""
    every = polynomials(stamps.unit, degree)
    return bool(np.linalg.svd(every / np.sqrt(len(every)), compute_uv=False).min() > least)


def offsets(rows: int, columns: int) -> Float[np.ndarray, "samples 2"]:
    """Return (x, y) in px of every sample of a stamp from its middle one, row by row."""
    y, x = np.mgrid[:rows, :columns].reshape(2, -1)
    return np.stack([x - columns // 2, y - rows // 2], axis=1).astype(np.float64)
