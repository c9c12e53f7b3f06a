"""From averaged flats to weighted pixels: shot and read noise by the expected signal, PRNU, clipping, outliers.

Weights come from the model's signal, not from the sample's own. Otherwise a pixel that is high by chance would count
more (or less) than its neighbours, and the map would be biased.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import TypeVar, final

import cv2
import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import nnls

from udccal.arguments import check_array, check_kind, check_number, number_of
from udccal.cfa import PATTERNS, cfa_named
from udccal.errors import FitError
from udccal.fitting.engine.robust import OutlierRule
from udccal.fitting.wire.parameters import WireRules, WireStart, wire_start
from udccal.models.geometry import Geometry
from udccal.models.noise import Noise, coarse_dark, linear_signal, scalar
from udccal.numerics import in_two_threads
from udccal.result import Outliers
from udccal.sessions.store import Session

# Tiles of the sensor, down and across, whose residuals are tested as a whole.
TILES = (6, 8)
# Functions are compiled for blocks of this many pixels.
BLOCK = 4096
Result = TypeVar("Result")
_OUTLIERS = OutlierRule("pixels (row, column)")


@final
@dataclass(frozen=True)
class WireData:
    """An averaged flat, and the rig's description.

    Attributes:
        signal: flat minus dark, in any linear unit; colours need not be balanced.
        variance: of ``signal`` itself (after averaging), in its unit squared; PRNU not included. The fit uses a
            straight line through it against the signal.
        geometry: gives the rays.
        start: the rig as built; its tolerances are the prior.
        PRNU1288: relative sigma of the pixels' response; its square is added to the relative variance.
        clip: signal at which single frames begin to clip; pixels are left out where the model expects more.
        clipped: part of the flat's pixels whose average is clipped.
        cfa: pattern of the sensor; each of its sites has a gain.
        dark_sigma: of the dark level that was subtracted, one error for all pixels, in the unit of ``signal``.

    Raises:
        FitError: when the arrays are not pictures of one size, no variance is usable, or a number is impossible.
    """

    signal: Float[np.ndarray, "rows columns"]
    variance: Float[np.ndarray, "rows columns"]
    geometry: Geometry
    start: WireStart
    PRNU1288: float
    clip: float = np.inf
    clipped: float = 0.0
    cfa: str = "RGGB"
    dark_sigma: float = 0.0

    def __post_init__(self) -> None:
        advice = "Pass the average of one mosaic, and give each pixel its variance."
        check_array(self.signal, "the signal", "real numbers", ("rows", "columns"), advice, FitError)
        check_array(self.variance, "the variance", "real numbers", self.signal.shape, advice, FitError)
        if self.variance.size and not (np.isfinite(self.variance) & (self.variance >= 0)).any():
            raise FitError("Expected variances of 0 or more, found none. Take them from the frames that were averaged.")
        for name, number in (("PRNU1288", self.PRNU1288), ("part of clipped pixels", self.clipped)):
            check_number(number_of(number), f"a {name}", (0.0, 1.0), "Take it from the noise fit.", FitError)
        check_number(number_of(self.dark_sigma), "a sigma of the dark level", (0.0, np.inf), advice, FitError)
        check_kind(self.geometry, Geometry, "Fit one, or take nominal_geometry(rig).", FitError)
        check_kind(self.start, WireStart, "Make one by wire_start(rig).", FitError)
        bounds, advice = (-np.inf, np.inf), "Leave it out if nothing clips."
        check_number(number_of(self.clip), "a signal from which frames clip", bounds, advice, FitError)
        if not isinstance(self.cfa, str) or self.cfa not in PATTERNS:
            raise FitError(
                f"Expected one of the patterns {', '.join(PATTERNS)}, found '{self.cfa}'. Name the sensor's."
            )

    @functools.cached_property
    def site_means(self) -> Float[np.ndarray, " sites"]:
        """Mean signal of each site's finite, unclipped pixels; NaN where there are none.

        A few pixels that are stuck high would lift the mean of a dark flat: those far beyond all shading do not count.
        """
        by_site = (self.signal[site.samples] for site in cfa_named(self.cfa).sites)
        good = (some[np.isfinite(some) & (some < self.clip)] for some in by_site)
        return np.array([_usual_mean(some) if some.size else np.nan for some in good])

    @property
    def balanced(self) -> Float[np.ndarray, "rows columns"]:
        """The signal over the mean of each pixel's site."""
        return self.signal / self.site_means[cfa_named(self.cfa).site_map(*self.signal.shape)]


def _usual_mean(values: Float[np.ndarray, " n"]) -> float:
    off = np.abs(values - np.median(values))
    return float(values[off <= 20 * np.median(off)].mean(dtype=np.float64))


def read_wire(
    session: Session, noise: Noise, geometry: Geometry, rules: WireRules | None = None, black_sigma_DN: float = 0.0
) -> WireData:
    """Read the steps ``wire/dark`` and ``wire/flat`` of a session, at one exposure, in DN.

    The noise term gives saturation and PRNU, ``rules`` the distance of single frames from saturation. Where dark codes
    are too coarse, or cut off, the noise term gives the dark level too, whose sigma is ``black_sigma_DN``.

    Raises:
        SessionError: when a file of the session is missing or damaged.
    """
    rules = rules or WireRules()
    captured = (session.step(f"wire/{step}").captures[0] for step in ("flat", "dark"))
    (flat, _), (dark, dark_s) = ((session.average(one), one.exposure_s) for one in captured)
    saturation, black, bend, K = (
        scalar(one) for one in (noise.saturation_DN, noise.black_DN, noise.bend_per_DN, noise.K_DN_per_e)
    )
    coarse = coarse_dark(noise, dark.mean, dark.variance, dark_s)
    dark_mean = dark.mean if coarse is None else coarse
    lit, unlit = (linear_signal(mean - np.float32(black), np.float32(bend)) for mean in (flat.mean, dark_mean))
    # Where the response bends, it shows less of the noise as well: the slope of linear signals, to first order.
    steep2 = (1 + 2 * np.float32(bend) * lit) ** 2
    headroom = float(linear_signal(saturation - black, bend)) - float(np.mean(unlit))
    return WireData(
        signal=lit - unlit,
        variance=flat.variance * steep2 / flat.frames + dark.variance / dark.frames,
        geometry=geometry,
        start=wire_start(session.rig),
        PRNU1288=scalar(noise.PRNU1288),
        clip=headroom - rules.headroom_sigma * max(headroom * K, 0.0) ** 0.5,
        clipped=float(np.mean(flat.mean >= 0.98 * saturation)),
        cfa=session.rig.camera.cfa,
        dark_sigma=0.0 if coarse is None else black_sigma_DN,
    )


@final
@dataclass(frozen=True)
class FlatNoise:
    """Variance of an averaged flat whose CFA sites have been divided by their means.

    At a site's relative signal s it is ``floor + by_signal s + (PRNU1288 s)^2``. Single frames clip from the relative
    signal ``clip`` on: pixels are left out where the model expects more.
    """

    floor: Float[np.ndarray, " sites"]
    by_signal: Float[np.ndarray, " sites"]
    PRNU1288: float
    clip: Float[np.ndarray, " sites"]

    def variance(self, site: Int[np.ndarray, "*n"], signal: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        """Variance of pixels of these sites at these relative signals."""
        # The weight must stay bounded where a model expects no light, or less than none.
        some = np.maximum(signal, 0.01)
        unequal = max(self.PRNU1288, 1e-5) * some
        return np.asarray(self.floor[site] + self.by_signal[site] * some + unequal**2)


def flat_noise(data: WireData) -> FlatNoise:
    """Straight lines through variance against signal, site by site (EMVA 1288's photon transfer).

    The variance of few frames is itself too noisy for the weight of single pixels.
    """
    sites, means = cfa_named(data.cfa).site_map(*data.signal.shape), data.site_means
    parts = ((data.signal[sites == k] / mean, data.variance[sites == k] / mean**2) for k, mean in enumerate(means))
    floor, by_signal = np.array([_line(*part) for part in parts]).T
    return FlatNoise(floor, by_signal, data.PRNU1288, data.clip / means)


def _line(signal: Float[np.ndarray, " n"], variance: Float[np.ndarray, " n"]) -> Float[np.ndarray, "2"]:
    """Constant and slope, neither negative, through the means of 32 bins of equal counts."""
    good = np.isfinite(variance) & np.isfinite(signal) & (variance >= 0)
    if not good.any():
        return np.zeros(2)
    order = np.argsort(signal[good], kind="stable")
    parts = (np.array_split(part[good][order], min(32, len(order))) for part in (signal, variance))
    # A sample variance beyond 30 medians of its bin is a pixel that blinks, not noise.
    kept = [(x[steady := y <= 30.0 * np.median(y)], y[steady]) for x, y in zip(*parts, strict=True)]
    at, mean = np.array([(max(float(x.mean()), 0.0), float(y.mean())) for x, y in kept]).T
    # Sample variances scatter in proportion to themselves.
    weight = 1.0 / np.maximum(mean, 1e-3 * mean.max() + 1e-300)
    line, _ = nnls(np.stack([weight, at * weight], axis=1), mean * weight)
    return np.asarray(line, dtype=np.float64)


@final
class Pixels(eqx.Module):
    """A sample of the sensor's pixels; ``weight`` 0 leaves a pixel out.

    ``place`` is the index in reading order; it is -1 for padding and for values that are not finite.
    """

    ideal: Float[np.ndarray, "n 2"]
    scaled: Float[np.ndarray, "n 2"]
    site: Int[np.ndarray, " n"]
    value: Float[np.ndarray, " n"]
    weight: Float[np.ndarray, " n"]
    place: Int[np.ndarray, " n"]

    def thinned(self, most: int) -> Pixels:
        """About ``most`` of the pixels at most, evenly drawn, in whole blocks."""
        drawn = np.arange(0, len(self.value), -(-len(self.value) // most))
        return jax.tree.map(lambda a: a[np.resize(drawn, -(-len(drawn) // BLOCK) * BLOCK)], self)

    @property
    def used(self) -> int:
        """Number of pixels with a weight."""
        return int(np.count_nonzero(self.weight))

    def blocks(self) -> Iterator[Pixels]:
        """The sample in pieces of one size."""
        firsts = range(0, len(self.value), BLOCK)
        return (jax.tree.map(lambda a, first=first: a[first : first + BLOCK], self) for first in firsts)

    def by_block(self, function: Callable[[Pixels], Result]) -> Result:
        """Join what a compiled function makes of each block; its results have pixels last."""
        found = in_two_threads(function, self.blocks())
        joined: Result = jax.tree.map(lambda *parts: np.concatenate(parts, axis=-1), *found)
        return joined


def sample_pixels(
    value: Float[np.ndarray, "rows columns"], geometry: Geometry, samples: int, cfa: str, other: bool = False
) -> Pixels:
    """Draw pixels in reading order, shifted from row to row so that all CFA sites are among them, in whole blocks.

    Args:
        value: CFA-balanced signal; pixels that are not finite have weight 0, the others 1.
        geometry: gives the rays.
        samples: number of pixels; the sample has somewhat more, or all where there are fewer.
        cfa: pattern of the sensor.
        other: draw a third as many, from the pixels that the sample without ``other`` leaves out if there are any.
    """
    rows, columns = value.shape
    step = odd_step(value.size, samples)
    flat = np.arange(step // 2, rows * columns, 3 * step) if other else np.arange(0, rows * columns, step)
    count, padded = len(flat), -(-len(flat) // BLOCK) * BLOCK
    y, x = np.divmod(np.resize(flat, padded), columns)
    if columns % step == 0:
        x = (x + y) % columns
    positions = np.stack([x, y], axis=-1).astype(np.float64)
    seen = value[y, x].astype(np.float64)
    real = (np.arange(padded) < count) & np.isfinite(seen)
    return Pixels(
        ideal=ideal_points(geometry, positions),
        scaled=scaled_places(positions, value.shape),
        site=cfa_named(cfa).site_map(rows, columns)[y, x],
        value=np.where(real, seen, 0.0),
        weight=np.where(real, 1.0, 0.0),
        place=np.where(real, y * columns + x, -1),
    )


def ideal_points(geometry: Geometry, positions_px: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    """Ideal image points of pixels (x, y), as ``models.geometry.unproject`` gives them."""
    matrix = np.eye(3)
    matrix[[0, 1], [0, 1]], matrix[:2, 2] = np.asarray(geometry.focal_px), np.asarray(geometry.principal_point_px)
    until = cv2.TERM_CRITERIA_MAX_ITER + cv2.TERM_CRITERIA_EPS, 60, 1e-14
    lens = matrix, np.asarray(geometry.distortion, dtype=np.float64)
    return cv2.undistortPoints(positions_px[:, None], *lens, R=np.eye(3), P=np.eye(3), criteria=until)[:, 0]


def scaled_places(pixels: Float[np.ndarray, "n 2"], shape: tuple[int, int]) -> Float[np.ndarray, "n 2"]:
    """Pixels (x, y) in px, scaled to [-1, 1] over a sensor of that shape (rows, columns)."""
    return 2 * pixels / (np.array(shape[::-1]) - 1.0) - 1


def tile_numbers(scaled: Float[np.ndarray, "n 2"], tiles: tuple[int, int] = TILES) -> Int[np.ndarray, " n"]:
    """Number of the sensor's tile, of so many down and across, in which each position of [-1, 1] lies, row by row."""
    x, y = (np.clip((0.5 * (scaled[:, i] + 1) * n).astype(np.int64), 0, n - 1) for i, n in enumerate(tiles[::-1]))
    return np.asarray(y * tiles[1] + x)


def odd_step(size: int, samples: int) -> int:
    """Step from pixel to pixel for so many ``samples`` of ``size`` pixels; an odd step visits all CFA sites."""
    step = max(1, size // max(samples, 1))
    return step + 1 - step % 2


@final
@dataclass(frozen=True)
class Weighed:
    """A sample weighted by a model; ``clipped`` counts and ``outlying`` marks the pixels left out.

    ``expected`` is the model's signal in CFA-balanced units.
    """

    pixels: Pixels
    expected: Float[np.ndarray, " n"]
    clipped: int
    outlying: Bool[np.ndarray, " n"]

    @property
    def z(self) -> Float[np.ndarray, " n"]:
        """Residuals in units of their expected sigma; 0 for pixels left out."""
        return np.asarray((self.pixels.value - self.expected) * np.sqrt(self.pixels.weight))

    def outliers(self, columns: int) -> tuple[Outliers, ...]:
        """The pixels left out, for a person; ``columns`` is the width of the sensor."""
        y, x = np.divmod(np.sort(self.pixels.place[self.outlying]), columns)
        found = _OUTLIERS.listed(f"({row}, {column})" for row, column in zip(y, x, strict=True))
        clipped = (Outliers("so bright, by the fitted map, that single frames clip", self.clipped),)
        return (*found, *(clipped if self.clipped else ()))


def weighed(pixels: Pixels, expected: Float[np.ndarray, " n"], noise: FlatNoise) -> Weighed:
    """Weight a sample by the signal that a model expects; leave out clipped pixels and outliers."""
    variance = noise.variance(pixels.site, expected)
    real = (pixels.place >= 0) & np.isfinite(pixels.value)
    usable = real & (expected + 3 * np.sqrt(variance) < noise.clip[pixels.site])
    outlying = _OUTLIERS.off((pixels.value - expected) / np.sqrt(variance), usable)
    kept = replace(pixels, weight=np.where(usable & ~outlying, 1.0 / variance, 0.0))
    return Weighed(kept, expected, int(np.count_nonzero(real & ~usable)), outlying)
