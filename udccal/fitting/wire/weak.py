"""Harmonics that are too weak to be fitted, or to be fitted alone: what they may add to the map's error."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import final

import numpy as np
from jaxtyping import Bool, Float

from udccal.fitting.engine.misfit import excess_variance
from udccal.fitting.wire.data import BLOCK, Pixels, Weighed
from udccal.fitting.wire.jacobian import values_at, with_harmonics
from udccal.fitting.wire.parameters import Parameters, Selected
from udccal.fitting.wire.rules import Harmonics, WireRules, WireStart, possible_harmonics
from udccal.models.wire import Wire


@final
@dataclass(frozen=True)
class Strengths:
    """By what part each harmonic is off a round pupil's, and the information on that; 0 where no column holds it.

    The strengths of ``tied`` ones are not free in the fit. The information of one of them is that of a fit in which it
    is free, too, in units of the residuals' variance.
    """

    off: Float[np.ndarray, " harmonics"]
    known: Float[np.ndarray, " harmonics"]
    tied: Bool[np.ndarray, " harmonics"]


def strengths_of(
    full: Parameters, matrix: Float[np.ndarray, "all all"], right: Float[np.ndarray, " all"], chosen: Selected
) -> Strengths:
    """Strengths by the normal equations of all columns, of which some are ``chosen``."""
    keep, columns = chosen.keep, full.strengths
    inside = matrix[np.ix_(keep, keep)]
    known = np.diag(matrix) - np.einsum("ka,ka->a", matrix[keep], np.linalg.solve(inside, matrix[keep]))
    known[keep] = 1 / np.diag(np.linalg.inv(inside))
    known = np.maximum(known, 1e-12 * np.diag(matrix))
    off = np.where(keep, chosen.values, (right - matrix[:, keep] @ chosen.values[keep]) / known)
    held = columns >= 0
    return Strengths(np.where(held, off[columns], 0.0), np.where(held, known[columns], 0.0), ~(held & keep[columns]))


def tied_sigma(strengths: Strengths, wire: Wire, seen: Weighed, variance: float) -> float:
    """Relative RMS of what the harmonics without a free strength may be off.

    A round pupil and the edges of the openings tie all strengths together. Those that the pixels show tell by what part
    real ones differ from that. One that is tied may be off by as much, less what the pixels tell of it, and less what
    the others take of its effect on the map.

    Args:
        strengths: by the fit's normal equations.
        wire: the fitted one.
        seen: pixels of the fit with their weights.
        variance: of the residuals, in units of the noise's.
    """
    held = strengths.known > 0
    if not held.any():
        return 0.0
    off, own = strengths.off[held], variance / strengths.known[held]
    # Openings that are no rectangles change weak harmonics by a larger part than strong ones.
    weak = own >= np.median(own)
    part2 = max(_departure(off, own), _departure(off[weak], own[weak]))
    shrunk = part2 / np.maximum(part2 + own, 1e-300)
    square = np.where(strengths.tied[held], (shrunk * off) ** 2 + shrunk * own, 0.0)
    effect = square @ strengths.known[held] / np.sum(seen.pixels.weight * seen.expected**2)
    others = wire.harmonics[~held]
    alone = harmonics_alone(wire, others, seen.pixels.thinned(BLOCK)) if part2 > 0 and len(others) else np.zeros(1)
    return float(np.sqrt(effect + part2 * np.var(alone)))


def _departure(off: Float[np.ndarray, " some"], own: Float[np.ndarray, " some"]) -> float:
    """Mean square part by which strengths differ, beyond their own variance."""
    found, error2, _ = excess_variance(off**2, own, np.ones(len(off)))
    # Few strengths tell how much they differ: what they may differ by more counts, too.
    return found + float(np.sqrt(error2)) if found > 0 else 0.0


@final
@dataclass(frozen=True)
class Omitted:
    """The harmonics that a fit leaves out: hundreds, each too weak to be fitted.

    A panel has all of them, by its openings and a round pupil; a synthetic map without them has none. Together they
    are one template, whose amplitude in the residuals is one number with a sigma.

    Attributes:
        rms: their relative RMS over the sensor, if they are there.
        part, part_sigma: amplitude of the template in the residuals, 1 where all are there, and its sigma.
    """

    rms: float
    part: float
    part_sigma: float

    @property
    def probability(self) -> float:
        """Probability that they are there, from 1/2 before the data.

        The expected part is 0 or 1 within the part's sigma; around 1, real pupils differ by a further 0.3.
        """
        wide = np.hypot(self.part_sigma, 0.3)
        present = -0.5 * ((self.part - 1) / wide) ** 2 - np.log(wide)
        absent = -0.5 * (self.part / self.part_sigma) ** 2 - np.log(self.part_sigma)
        return float(1.0 / (1.0 + np.exp(np.clip(absent - present, -700.0, 700.0))))

    @property
    def sigma(self) -> float:
        """Their expected part of the map's relative sigma, RMS over the sensor."""
        return self.rms * float(np.sqrt(self.probability))


def omitted(start: WireStart, wire: Wire, seen: Weighed, rules: WireRules) -> Omitted | None:
    """Look for the omitted harmonics at the fitted shape, with a round pupil; None where the fit omits none.

    The pixels may be those of the fit, since it absorbs little of hundreds of harmonics.
    """
    left_out = possible_harmonics(start, rules.least_counted, rules.least_amplitude)
    if not len(left_out.bounds):
        return None
    pixels, expected = seen.pixels, seen.expected
    # The search is for the strongest, with nine tenths of the power: the others are not worth the time.
    power = np.cumsum(left_out.bounds**2)
    strongest = left_out.orders[: int(np.searchsorted(power, 0.9 * power[-1])) + 1]
    template = harmonics_alone(wire, strongest, pixels)
    weight = pixels.weight * np.where(expected > 0, expected, 0.0)
    information = max(float(np.sum(weight * expected * template**2)), 1e-300)
    part = float(np.sum(weight * (pixels.value - expected) * template)) / information
    rms = float(np.std(harmonics_alone(wire, left_out.orders, pixels.thinned(BLOCK))))
    return Omitted(rms, part, information**-0.5)


def harmonics_alone(wire: Wire, orders: Float[np.ndarray, "any 2"], pixels: Pixels) -> Float[np.ndarray, " n"]:
    """The modulation by these harmonics of a round pupil, at a wire's shape."""
    plain = replace(wire, amplitudes=np.zeros((0, 2, 1, 1)))
    return values_at(with_harmonics(plain, orders, pixels), pixels)[0] - 1


def unseen(harmonics: Harmonics, searched: Pixels, rules: WireRules) -> float:
    """Relative RMS modulation that the harmonics may have though the searched pixels show none; else 0."""
    power = float(np.sum(harmonics.bounds**2)) / 2
    # The mean value is 1 apart from shading; a few outliers must not count as light.
    expected_gain = power * float(np.sum(searched.weight))
    # Rows of half the expected amplitude would still have been found.
    if expected_gain > 4.0 * rules.least_gain:
        return 0.0
    return float(np.sqrt(power * min(1.0, rules.least_gain / max(expected_gain, 1e-300))))
