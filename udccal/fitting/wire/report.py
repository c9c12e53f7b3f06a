"""The result of a wire fit: patterns in its residuals, and numbers for a person."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import final

import numpy as np
from jaxtyping import Float, Float32, Int
from scipy.spatial.transform import Rotation

from udccal.fitting.engine.gaussian import Posterior
from udccal.fitting.engine.misfit import MisfitTest, chi2_test, excess_sigma, sharper
from udccal.fitting.engine.orders import Choice
from udccal.fitting.engine.report import estimates, priors_of, residual_sample
from udccal.fitting.wire.data import BLOCK, Pixels, Weighed
from udccal.fitting.wire.jacobian import LEAST_VARIANCE, TILES, rays_at, tile_numbers, values_at
from udccal.fitting.wire.parameters import SHAPE_NAMES, Kind, Parameters, element_name
from udccal.fitting.wire.rules import WireRules
from udccal.fitting.wire.search import Descent, Found
from udccal.fitting.wire.weak import Strengths
from udccal.models.wire import Wire
from udccal.result import Diagnostic, Estimate, FitResult, FitStatus


@final
@dataclass(frozen=True)
class Misfit:
    """Relative model error of the map by patterned residuals, RMS over the sensor; 0 where chance explains them."""

    sigma: float
    test: MisfitTest


@final
@dataclass(frozen=True)
class Misfits:
    """What residuals show of the map's model error: a pattern in the panel's period, and lines of the sensor.

    ``excess`` is the RMS of residuals beyond noise where they are so large that the fit is poor, else 0.
    """

    pattern: Misfit
    lines: Misfit
    excess: float

    @property
    def found(self) -> bool:
        """Whether chance does not explain the residuals' means."""
        return self.pattern.test.found or self.lines.test.found

    @property
    def sigma(self) -> float:
        """Relative model error of the map."""
        return max(float(np.hypot(self.pattern.sigma, self.lines.sigma)), self.excess)


@final
@dataclass(frozen=True)
class Relative:
    """Residuals relative to the expected signal, their weights, and their variance in units of the noise's."""

    values: Float[np.ndarray, " n"]
    weight: Float[np.ndarray, " n"]
    scale: float

    @classmethod
    def of(cls, tested: Weighed) -> Relative:
        """The residuals of a sample; pixels without a weight have none here."""
        pixels, expected = tested.pixels, tested.expected
        used = (pixels.weight > 0) & (expected > 0)
        values = np.where(used, pixels.value / np.where(used, expected, 1.0) - 1, 0.0)
        weight = np.where(used, pixels.weight * expected**2, 0.0)
        scale = float(np.sum(weight * values**2)) / max(int(used.sum()), 1)
        return cls(values, weight, max(scale, LEAST_VARIANCE))

    def means(self, group: Int[np.ndarray, " n"], statistical: float, held_out: bool) -> Misfit:
        """Test the means of groups against chance.

        ``held_out`` pixels show the fit's ``statistical`` errors as well; these are accounted for.
        """
        full = np.bincount(group, self.weight > 0) >= 4
        total = np.bincount(group, self.weight)[full]
        mean = np.bincount(group, self.weight * self.values)[full] / total
        noise = self.scale / total
        noise = noise + statistical**2 if held_out else np.maximum(noise - statistical**2, 0.1 * noise)
        test = chi2_test(float(np.sum(mean**2 / noise)), float(len(mean)))
        return Misfit(excess_sigma(mean**2, noise, np.ones(len(mean)), float(len(mean))), test)

    def beyond_noise(self) -> float:
        """RMS of the residuals less that of the noise."""
        mean_square = float(np.sum(self.values**2)) / max(int(np.count_nonzero(self.weight)), 1)
        return float(np.sqrt(mean_square * max(1 - 1 / self.scale, 0.0)))


def misfit(tested: Weighed, wire: Wire | None, statistical: float, held_out: bool) -> Misfit:
    """Test means over bins of the rows' and the columns' period, tile by tile, against chance.

    Noise has no pattern; a misfit has. ``wire`` gives the phase of each ray in the period; without a panel, bins are
    parts of a tile. See ``Relative.means`` for the others.
    """
    return _pattern(Relative.of(tested), tested.pixels, wire, statistical, held_out)


def _pattern(relative: Relative, pixels: Pixels, wire: Wire | None, statistical: float, held_out: bool) -> Misfit:
    # Bins of a period of the rows and of the columns, once finer in the one, once in the other.
    binned = (_bins(pixels, wire, down, across) for down, across in ((12, 3), (3, 12)))
    found = [relative.means(bins, statistical, held_out) for bins in binned]
    test = sharper(*(one.test for one in found))
    return Misfit(min(found, key=lambda one: one.test.p_value).sigma if test.found else 0.0, test)


def misfits(
    tested: Weighed, wire: Wire | None, statistical: float, held_out: bool, variance: float, rules: WireRules
) -> Misfits:
    """All that residuals show; ``variance`` is that of the fit's residuals in units of the noise's."""
    relative = Relative.of(tested)
    # Columns and rows of the sensor, each by the place of its pixels.
    sides = (np.unique(side, return_inverse=True)[1] for side in tested.pixels.scaled.T)
    columns, rows = (relative.means(side, statistical, held_out) for side in sides)
    test = sharper(columns.test, rows.test)
    lines = Misfit(float(np.hypot(columns.sigma, rows.sigma)) if test.found else 0.0, test)
    excess = relative.beyond_noise() if variance > rules.worst_variance else 0.0
    return Misfits(_pattern(relative, tested.pixels, wire, statistical, held_out), lines, excess)


def _bins(pixels: Pixels, wire: Wire | None, down: int, across: int) -> Int[np.ndarray, " n"]:
    """Number of each pixel's bin in its tile: by its ray's phase in rows and columns, or by place without a panel."""
    by_place = 0.5 * (pixels.scaled.T + 1) * np.array([[TILES[1]], [TILES[0]]])
    periods = rays_at(wire, pixels).periods if wire is not None else by_place
    phase = periods - np.floor(periods)
    x, y = (np.minimum((p * n).astype(np.int64), n - 1) for p, n in zip(phase, (across, down), strict=True))
    return np.asarray((tile_numbers(pixels.scaled) * down + y) * across + x)


@final
@dataclass(frozen=True)
class Joint:
    """A fitted wire: the search, the last descent, and the parameters' values and covariance.

    ``variance`` is that of the residuals in units of the noise's, ``seen`` the pixels of the fit with their weights.
    """

    found: Found
    last: Descent
    x: Float[np.ndarray, " n"]
    cov: Float[np.ndarray, "n n"]
    variance: float
    seen: Weighed
    orders: Choice
    strengths: Strengths

    @property
    def parameters(self) -> Parameters:
        """The parameters kept."""
        return self.last.problem.parameters

    @property
    def impossible(self) -> bool:
        """Whether an opening is wider than its period by more than three sigma."""
        wide = self.x[self.parameters.linear :][7:9] - 1
        return bool(np.any(wide > 3 * np.sqrt(np.diag(self.cov)[self.parameters.linear :][7:9])))


def rms(values: Float[np.ndarray, "..."]) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(values, dtype=np.float64))))


def wire_result(
    joint: Joint,
    cov: Float[np.ndarray, "n n"],
    found: Misfits,
    left_out: float,
    map_sigma: Float32[np.ndarray, "1 down across"],
    posterior: Posterior[Wire],
    shape: tuple[int, int],
    rules: WireRules,
) -> FitResult[Wire]:
    """The result of a finished fit, on a sensor of that shape.

    ``cov`` is that of the parameters of a map whose mean is 1. ``map_sigma`` is the whole sigma of the map.
    ``left_out`` is the part by harmonics that are tied or omitted, or by rows that may be there unseen, RMS over the
    sensor. Both are relative.
    """
    panel, seen = joint.parameters.panel, joint.seen
    term = _trimmed(posterior.term)
    outliers = seen.outliers(shape[1])
    drawn = np.flatnonzero(seen.pixels.weight > 0)
    few = seen.pixels.thinned(8 * BLOCK)
    mounted = Rotation.from_rotvec(term.geometry.rotation_rad)
    turned = Rotation.from_rotvec(term.rotation_rad) * mounted
    tilt, nominal = (np.rad2deg(np.arcsin(np.clip(one.as_matrix()[1, 2], -1.0, 1.0))) for one in (turned, mounted))
    named, named_cov = _estimates(joint, cov) if panel else ((), np.zeros((0, 0)))
    diagnostics = (
        ("wire_map_rms_sigma", 100 * rms(map_sigma), "%"),
        ("wire_map_model_sigma", 100 * float(np.hypot(found.sigma, left_out)), "%"),
        ("harmonics_left_out", 100 * left_out, "%"),
        ("residual_pattern_p_value", found.pattern.test.p_value, "1"),
        ("residual_lines_p_value", found.lines.test.p_value, "1"),
        ("modulation_peak_to_peak", 100 * float(np.ptp(values_at(term, few)[0])), "%"),
        ("harmonics", float(len(term.harmonics)), "1"),
        ("parameters", float(joint.parameters.linear), "1"),
        ("pixels_left_out", float(sum(one.count for one in outliers)), "1"),
        ("gain_in_chi2", joint.found.gain, "1"),
        ("tilt_by_wire", float(tilt), "deg"),
        ("tilt_by_wire_minus_geometry", float(tilt - nominal), "deg"),
        ("iterations", float(joint.found.descent.solution.iterations + joint.last.solution.iterations), "1"),
    )
    return FitResult(
        name="wire",
        term=term,
        status=_status(joint, rules),
        estimates=named,
        cov=named_cov,
        chi2_dof=joint.variance,
        samples=seen.pixels.used,
        candidates=joint.orders.candidates,
        diagnostics=tuple(Diagnostic(*one) for one in diagnostics),
        notes=tuple(_notes(joint, found, left_out, rules)),
        outliers=outliers,
        residuals=residual_sample((seen.pixels.scaled[drawn] + 1) / 2 * [shape[1] - 1, shape[0] - 1], seen.z[drawn]),
        posterior=posterior,
        map_sigma=map_sigma,
    )


def _trimmed(wire: Wire) -> Wire:
    """The wire without unused Legendre degrees, amplitudes, and harmonics where there is no panel: it is faster."""
    used = np.flatnonzero(np.any(np.asarray(wire.fields) != 0, axis=(0, 1, 2)))
    beside = wire.amplitudes if np.any(wire.amplitudes) else np.zeros((0, 2, 1, 1))
    seen = np.s_[: len(wire.harmonics) if used.size or len(beside) else 0]
    fields = wire.fields[seen, ..., : used.max(initial=0) + 1]
    return replace(
        wire, harmonics=wire.harmonics[seen], frequency=wire.frequency[seen], fields=fields, amplitudes=beside
    )


def _status(joint: Joint, rules: WireRules) -> FitStatus:
    if joint.variance > rules.worst_variance or joint.impossible:
        return FitStatus.POOR_FIT
    if not joint.parameters.panel:
        return FitStatus.ABSENT
    return FitStatus.CONVERGED if joint.last.solution.converged else FitStatus.NOT_CONVERGED


def _notes(joint: Joint, found: Misfits, left_out: float, rules: WireRules) -> Iterator[str]:
    if joint.parameters.panel:
        prior = joint.last.problem.prior
        off = (prior.root @ (joint.x - prior.mean))[joint.parameters.linear :]
        if joint.found.sharpness < 1:
            yield (
                "The rows lack the higher harmonics of rectangular openings: row_open and column_open describe the "
                "strength of the first harmonics, not edges that a microscope would show."
            )
        for name, sigmas in zip(SHAPE_NAMES, np.abs(off), strict=True):
            if sigmas > rules.doubted_sigma:
                yield f"{name} is {sigmas * rules.widening:.0f} tolerances away from the rig description; check it."
    else:
        yield "No modulation by rows is visible; the map is the shading alone."
        if left_out > 0:
            yield (
                f"These flats are too noisy to tell: rows may modulate by {100 * left_out:.2g} % unseen, which "
                "the sigmas include. Average more frames, or expose longer."
            )
    if (pattern := found.pattern).test.found:
        yield (
            f"The residuals are patterned (p = {pattern.test.p_value:.1g}): the model may be {100 * pattern.sigma:.3f} "
            "% off, which the sigmas include."
        )
    if (lines := found.lines).test.found:
        yield (
            f"Columns or rows of the sensor differ by {100 * lines.sigma:.2g} % (p = {lines.test.p_value:.1g}), which "
            "the map lacks and the sigmas include. Check the gains of the sensor's columns, and the light for stripes."
        )
    if joint.impossible:
        yield "An opening came out wider than its period: check panel, pitch and lens in the rig description."
    if joint.variance > rules.worst_variance:
        yield (
            "Look at the residual map for dust, glare or uneven light; check PRNU and the rig description. The sigmas "
            f"take all {100 * found.excess:.2g} % by which residuals exceed noise for an error of the map."
        )
    elif not joint.last.solution.converged:
        yield "Capture more flats, or give the fit more pixels."


def _estimates(
    joint: Joint, cov: Float[np.ndarray, "all all"]
) -> tuple[tuple[Estimate, ...], Float[np.ndarray, "n n"]]:
    """The shape, then all elements of the wire's arrays that were fitted, with their covariance."""
    parameters, prior = joint.parameters, joint.last.problem.prior
    # Gains of the CFA sites are not in the term: their errors remain in the variances of the others.
    others = np.flatnonzero(~parameters.of(Kind.SITE) & ~parameters.of(Kind.SHAPE))
    order = np.concatenate([np.flatnonzero(parameters.of(Kind.SHAPE)), others])
    names = (*SHAPE_NAMES, *(element_name(*column) for column in parameters.columns[others].tolist()))
    (values, unit), (known, wide) = _in_units(joint.x[order]), _in_units(prior.mean[order])
    sigma = prior.sigma[order] * wide
    # Places have no origin beforehand.
    values[4:6], sigma[4:6] = values[4:6] % 1.0, np.inf
    cov = cov[np.ix_(order, order)] * np.outer(unit, unit)
    return estimates("wire", names, values, cov, priors_of(names, known, sigma)), cov


def _in_units(x: Float[np.ndarray, " n"]) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Values from the fit's own parameters, of which the shape is first, and their derivatives by these."""
    values, unit = x.copy(), np.ones(len(x))
    # The fit's own are radians and, for stand-off and pupil, logarithms.
    values[[3, 6]] = unit[[3, 6]] = np.exp(values[[3, 6]])
    values[:3], unit[:3] = np.rad2deg(values[:3]), 180 / np.pi
    return values, unit
