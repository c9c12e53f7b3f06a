"""What a wire fit says of itself: misfit, harmonics that were left out, and the numbers for a person to read."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, final

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from udccal.fitting.engine.gaussian import Posterior, Prior
from udccal.fitting.engine.misfit import NO_TEST, MisfitTest, chi2_test, excess_sigma, sharper
from udccal.fitting.engine.orders import Choice
from udccal.fitting.engine.report import estimates, residual_sample
from udccal.fitting.wire.data import BLOCK, Pixels, Weighed
from udccal.fitting.wire.jacobian import TILES, rays_at, tile_numbers, values_at, with_harmonics
from udccal.fitting.wire.parameters import (
    SHAPE_NAMES,
    SHAPE_UNITS,
    Harmonics,
    Parameters,
    WireRules,
    WireStart,
    possible_harmonics,
)
from udccal.models.geometry import tilt_rad
from udccal.models.wire import Wire, panel_rotation
from udccal.result import Diagnostic, Estimate, FitResult, FitStatus

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
_FEW: Final = 16_384


@final
@dataclass(frozen=True)
class Joint:
    """A fitted wire, and what tells how sure it is.

    Attributes:
        parameters: those kept, of all orders of ``orders``.
        x: their values; the map's mean is 1.
        cov: theirs, misfit included where it was found.
        prior: of the same.
        variance: of the residuals, in units of what noise makes.
        by_tile: each tile's part of the score.
        seen: the pixels of the fit, weighed by the fitted wire.
        converged, iterations: of the descents.
        gain: chi-squared that the rows' first harmonic explained in the scan.
    """

    parameters: Parameters
    x: Float[np.ndarray, " n"]
    cov: Float[np.ndarray, "n n"]
    prior: Prior
    variance: float
    seen: Weighed
    by_tile: Float[np.ndarray, "tiles n"]
    orders: Choice
    converged: bool
    iterations: int
    gain: float

    @property
    def wire(self) -> Wire:
        """As fitted."""
        return self.parameters.wire(self.x)

    @property
    def impossible(self) -> bool:
        """Whether an opening is surely wider than its period."""
        wide = self.x[self.parameters.linear :][7:9] - 1
        return bool(np.any(wide > 3 * np.sqrt(np.diag(self.cov)[self.parameters.linear :][7:9])))


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
    scale = float(np.sum(weight * relative**2)) / max(int(used.sum()), 1) + 1e-300
    tests, sizes, resolution = [], [], np.inf
    for binning in _BINNINGS:
        bins = _bins(pixels, wire, *binning)
        full = np.bincount(bins, used) >= _LEAST_IN_BIN
        total = np.bincount(bins, weight)[full]
        mean = np.bincount(bins, weight * relative)[full] / total
        noise = scale / total
        noise = noise + statistical**2 if held_out else np.maximum(noise - statistical**2, 0.1 * noise)
        tests.append(chi2_test(float(np.sum(mean**2 / noise)), len(mean)))
        sizes.append(excess_sigma(mean**2, noise, np.ones(len(mean)), len(mean)))
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


def wire_result(
    joint: Joint,
    found: Misfit,
    left_out: float,
    map_sigma: float,
    posterior: Posterior[Wire],
    shape: tuple[int, int],
    rules: WireRules,
) -> FitResult[Wire]:
    """The result of a fit that came to its end.

    Args:
        joint: the fit.
        found: whether the model describes the data.
        left_out: of harmonics that were left out, or of rows that may be there unseen; relative, RMS over the sensor.
        map_sigma: of the map, relative, RMS over the sensor.
        posterior: of the wire.
        shape: rows and columns of the sensor.
        rules: what is doubted.
    """
    panel, seen = joint.parameters.panel, joint.seen
    term = trimmed(posterior.term_at(posterior.mean), panel)
    outliers = seen.outliers(shape[1])
    drawn = np.flatnonzero(seen.pixels.weight > 0)
    places = (seen.pixels.scaled[drawn] + 1) / 2 * [shape[1] - 1, shape[0] - 1]
    named, cov = _estimates(joint) if panel else ((), np.zeros((0, 0)))
    return FitResult(
        name="wire",
        term=term,
        status=_status(joint, rules),
        estimates=named,
        cov=cov,
        chi2_dof=joint.variance,
        samples=seen.pixels.used,
        candidates=joint.orders.candidates,
        diagnostics=(
            Diagnostic("wire_map_rms_sigma", 100 * map_sigma, "%"),
            Diagnostic("wire_map_model_sigma", 100 * float(np.hypot(found.sigma, left_out)), "%"),
            Diagnostic("harmonics_left_out", 100 * left_out, "%"),
            Diagnostic("model_sigma_that_would_be_seen", 100 * found.resolution, "%"),
            Diagnostic("residual_pattern_p_value", found.test.p_value, "1"),
            Diagnostic("efficiency", seen.pixels.used / (shape[0] * shape[1]), "1"),
            Diagnostic("residual_rms", 100 * found.residual_rms, "%"),
            Diagnostic("modulation_peak_to_peak", 100 * _peak_to_peak(joint), "%"),
            Diagnostic("harmonics", float(np.shape(term.harmonics)[0]), "1"),
            Diagnostic("parameters", float(joint.parameters.linear), "1"),
            Diagnostic("pixels_left_out", float(sum(one.count for one in outliers)), "1"),
            Diagnostic("gain_in_chi2", joint.gain, "1"),
            *_tilts(term),
            Diagnostic("iterations", float(joint.iterations), "1"),
        ),
        notes=tuple(_notes(joint, found, left_out, rules)),
        outliers=outliers,
        residuals=residual_sample(places, seen.z[drawn]),
        posterior=posterior,
    )


def trimmed(wire: Wire, panel: bool) -> Wire:
    """Without Legendre degrees that no harmonic uses, and without harmonics where no panel is: quicker to compute."""
    used = np.flatnonzero(np.any(np.asarray(wire.fields) != 0, axis=(0, 1, 2)))
    degrees, count = (int(used.max()) + 1 if used.size else 1), (None if panel else 0)
    beside = wire.amplitudes if np.any(wire.amplitudes) else np.zeros((0, 2, 1, 1))
    leaves = (wire.harmonics[:count], wire.frequency[:count], wire.fields[:count, ..., :degrees], beside)
    return eqx.tree_at(lambda w: (w.harmonics, w.frequency, w.fields, w.amplitudes), wire, leaves)


def _status(joint: Joint, rules: WireRules) -> FitStatus:
    if joint.variance > rules.worst_variance or joint.impossible:
        return FitStatus.POOR_FIT
    if not joint.parameters.panel:
        return FitStatus.ABSENT
    return FitStatus.CONVERGED if joint.converged else FitStatus.NOT_CONVERGED


def _notes(joint: Joint, found: Misfit, left_out: float, rules: WireRules) -> Iterator[str]:
    if joint.parameters.panel:
        yield "cov covers the shape parameters, as fitted together with all coefficients of the fields."
        off = (joint.prior.root @ (joint.x - joint.prior.mean))[joint.parameters.linear :]
        for name, sigmas in zip(SHAPE_NAMES, np.abs(off), strict=True):
            if sigmas > rules.doubted_sigma:
                yield f"{name} is {sigmas * 2:.0f} tolerances away from the rig description; check it."
    else:
        yield "No modulation by rows is visible; the map is the shading alone."
        if left_out > 0:
            yield (
                f"These flats are too noisy to tell: rows may modulate by {100 * left_out:.2g} % unseen, which "
                "the stated sigmas include. Average more frames, or expose longer."
            )
    if found.test.found:
        yield (
            f"The residuals are patterned (p = {found.test.p_value:.1g}): the model may be {100 * found.sigma:.3f} % "
            "off, which the stated sigmas include."
        )
    if joint.impossible:
        yield "An opening came out wider than its period: check panel, pitch and lens in the rig description."
    if joint.variance > rules.worst_variance:
        yield "Look at the residual map for dust, glare or uneven light; check PRNU and the rig description."
    elif not joint.converged:
        yield "Capture more flats, or give the fit more pixels."


def _peak_to_peak(joint: Joint) -> float:
    few = joint.seen.pixels.thinned(_FEW)
    return float(np.ptp(values_at(joint.wire, few.ideal, few.scaled)[0]))


def _tilts(wire: Wire) -> tuple[Diagnostic, Diagnostic]:
    tilt = float(np.rad2deg(np.arcsin(np.clip(np.asarray(panel_rotation(wire))[1, 2], -1.0, 1.0))))
    apart = tilt - float(np.rad2deg(tilt_rad(wire.geometry)))
    return Diagnostic("tilt_by_wire", tilt, "deg"), Diagnostic("tilt_by_wire_minus_geometry", apart, "deg")


def _estimates(joint: Joint) -> tuple[tuple[Estimate, ...], Float[np.ndarray, "10 10"]]:
    # The fit's own parameters are radians and, for stand-off and pupil, logarithms.
    values, unit = joint.x[joint.parameters.linear :].copy(), np.ones(len(SHAPE_NAMES))
    values[[3, 6]] = unit[[3, 6]] = np.exp(values[[3, 6]])
    values[:3], unit[:3] = np.rad2deg(values[:3]), 180 / np.pi
    values[4:6] %= 1.0
    cov = joint.cov[joint.parameters.linear :, joint.parameters.linear :] * np.outer(unit, unit)
    return estimates(SHAPE_NAMES, SHAPE_UNITS, values, cov), cov
