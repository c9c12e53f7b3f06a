"""What the wire's model does not describe: patterns in its residuals, and the harmonics that a fit leaves out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, final

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from udccal.fitting.engine.misfit import NO_TEST, MisfitTest, chi2_test, excess_sigma, sharper
from udccal.fitting.wire.data import BLOCK, Pixels, Weighed
from udccal.fitting.wire.jacobian import LEAST_VARIANCE, TILES, rays_at, tile_numbers, values_at, with_harmonics
from udccal.fitting.wire.parameters import Harmonics, possible_harmonics
from udccal.fitting.wire.rules import WireRules, WireStart
from udccal.models.wire import Wire

# Bins in a tile, down and across: of a period of the rows and of the columns, once finer in one, once in the other.
_BINNINGS: Final = ((12, 3), (3, 12))
_LEAST_IN_BIN: Final = 4
# Of the harmonics left out the strongest, with so much of their power, are looked for: what the others would tell is
# not worth the seconds.
_LOOKED_FOR: Final = 0.9
# A real pupil's part of a round one's template is one within this.
_REAL_PUPILS: Final = 0.3
# Rows of half the amplitude that is expected would still have been noticed.
_SURELY_SEEN: Final = 4.0


@final
@dataclass(frozen=True)
class Misfit:
    """How far the model may be off the truth, as residuals show it.

    Attributes:
        sigma: of the map, relative, RMS over the sensor; 0 where residuals are not patterned.
        resolution: the smallest such sigma that would have been seen.
        test: whether chance explains the patterns.
        residual_rms: relative, of single pixels.
    """

    sigma: float
    resolution: float
    test: MisfitTest
    residual_rms: float


def misfit(judged: Weighed, wire: Wire | None, statistical: float, held_out: bool) -> Misfit:
    """Means over bins of the rows' and the columns' period, tile by tile, against chance.

    Noise is not patterned; a misfit is. Pixels that the fit has not seen show its statistical errors as well: those are
    known, and are taken off.

    Args:
        judged: pixels, weighed by the fitted wire.
        wire: says where rays meet the period; None where there is no panel, whose bins lie by place.
        statistical: the fit's own relative sigma, RMS over the map.
        held_out: whether the fit has not seen these pixels.
    """
    pixels, expected = judged.pixels, judged.expected
    used = (pixels.weight > 0) & (expected > 0)
    relative = np.where(used, pixels.value / np.where(used, expected, 1.0) - 1, 0.0)
    weight = np.where(used, pixels.weight * expected**2, 0.0)
    scale = max(float(np.sum(weight * relative**2)) / max(int(used.sum()), 1), LEAST_VARIANCE)
    tests, sizes, resolution = [], [], np.inf
    for binning in _BINNINGS:
        bins = _bins(pixels, wire, *binning)
        full = np.bincount(bins, used) >= _LEAST_IN_BIN
        total = np.bincount(bins, weight)[full]
        mean = np.bincount(bins, weight * relative)[full] / total
        noise = scale / total
        noise = noise + statistical**2 if held_out else np.maximum(noise - statistical**2, 0.1 * noise)
        tests.append(chi2_test(float(np.sum(mean**2 / noise)), float(len(mean))))
        sizes.append(excess_sigma(mean**2, noise, np.ones(len(mean)), float(len(mean))))
        resolution = min(resolution, float((2 * len(mean)) ** 0.25 / np.sqrt(np.sum(1 / noise) + 1e-300)))
    test = sharper(*tests) if len(mean) else NO_TEST
    sigma = sizes[int(np.argmin([one.p_value for one in tests]))] if test.found else 0.0
    return Misfit(sigma, resolution, test, float(np.sqrt(np.sum(relative**2) / max(int(used.sum()), 1))))


def _bins(pixels: Pixels, wire: Wire | None, down: int, across: int) -> Int[np.ndarray, " n"]:
    """A bin in each pixel's tile: where its ray meets the period of rows and columns; without a panel, by place."""
    by_place = 0.5 * (pixels.scaled.T + 1) * np.array([[TILES[1]], [TILES[0]]])
    periods = rays_at(wire, pixels.ideal).periods if wire is not None else by_place
    phase = periods - np.floor(periods)
    x, y = (np.minimum((p * n).astype(np.int64), n - 1) for p, n in zip(phase, (across, down), strict=True))
    return np.asarray((tile_numbers(pixels.scaled) * down + y) * across + x)


@final
@dataclass(frozen=True)
class Omitted:
    """The harmonics that a fit leaves out, hundreds, each too weak to be fitted.

    A panel has them all, as its open fractions and a round pupil have it; a map that was made without has none. As a
    whole they are one template, and how much of it is in the residuals is one number with an error.

    Attributes:
        rms: relative, over the sensor, if they are there.
        part, part_sigma: of them, how much the residuals have, and its error.
    """

    rms: float
    part: float
    part_sigma: float

    @property
    def probability(self) -> float:
        """That they are there, which beforehand is as likely as not.

        By the likelihoods of the part found: 0 with its error, or 1 with that and what real pupils differ by.
        """
        wide = np.hypot(self.part_sigma, _REAL_PUPILS)
        present = -0.5 * ((self.part - 1) / wide) ** 2 - np.log(wide)
        absent = -0.5 * (self.part / self.part_sigma) ** 2 - np.log(self.part_sigma)
        return float(1.0 / (1.0 + np.exp(np.clip(absent - present, -700.0, 700.0))))

    @property
    def sigma(self) -> float:
        """What they are expected to add to the map's error, relative, RMS over the sensor."""
        return self.rms * float(np.sqrt(self.probability))


def omitted(start: WireStart, wire: Wire, judged: Weighed, rules: WireRules) -> Omitted | None:
    """Look for them, at the fitted shape and with a round pupil; None where there are none to leave out.

    Args:
        start: says which harmonics a fit has.
        wire: as fitted.
        judged: pixels whose residuals are looked at, spread over the sensor; those that were fitted do, as a fit takes
            up little of so many harmonics.
        rules: say which harmonics are left out.
    """
    left_out = possible_harmonics(start, rules.least_counted, rules.least_amplitude)
    if not len(left_out.bounds):
        return None
    pixels, expected = judged.pixels, judged.expected
    power = np.cumsum(left_out.bounds**2)
    strongest = left_out.orders[: int(np.searchsorted(power, _LOOKED_FOR * power[-1])) + 1]
    template = harmonics_alone(wire, strongest, pixels)
    weight = pixels.weight * np.where(expected > 0, expected, 0.0)
    information = max(float(np.sum(weight * expected * template**2)), 1e-300)
    part = float(np.sum(weight * (pixels.value - expected) * template)) / information
    rms = float(np.std(harmonics_alone(wire, left_out.orders, pixels.thinned(BLOCK))))
    return Omitted(rms, part, information**-0.5)


def harmonics_alone(wire: Wire, orders: Float[np.ndarray, "any 2"], pixels: Pixels) -> Float[np.ndarray, " n"]:
    """What these harmonics of a round pupil add to 1, at a wire's shape.

    They go in chunks of as many as the wire has, so that what the fit compiled serves here; very few would take long.
    """
    size = max(len(wire.harmonics), 64)
    plain = eqx.tree_at(lambda w: w.amplitudes, wire, np.zeros_like(wire.amplitudes))
    total = np.zeros(len(pixels.value))
    for first in range(0, len(orders), size):
        some = orders[first : first + size]
        chunk = with_harmonics(plain, np.resize(some, (size, 2)), pixels.ideal)
        fields = np.where(np.arange(size)[:, None, None, None] < len(some), chunk.fields, 0.0)
        total += values_at(eqx.tree_at(lambda w: w.fields, chunk, fields), pixels.ideal, pixels.scaled)[0] - 1
    return total


def unseen(harmonics: Harmonics, searched: Pixels, rules: WireRules) -> float:
    """What the rig's rows may modulate by, relative RMS, though none were seen; 0 where they would have been.

    Args:
        harmonics: that a fit has.
        searched: the pixels that rows were looked for in, weighed.
        rules: say how much of chi-squared rows must explain.
    """
    power = float(np.sum(harmonics.bounds**2)) / 2
    # Values are 1 but for shading, and a few that are far off must not count as light.
    expected_gain = power * float(np.sum(searched.weight))
    if expected_gain > _SURELY_SEEN * rules.least_gain:
        return 0.0
    return float(np.sqrt(power * min(1.0, rules.least_gain / max(expected_gain, 1e-300))))
