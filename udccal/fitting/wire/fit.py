"""Wire fit: from the average of flats to a smooth, noise-free map of the panel's modulation and the shading.

The fit takes the maximum a posteriori, with the rig description as prior. The weight of a pixel follows from the
variance at its expected signal (shot, read and quantisation noise over the frames, PRNU). Pixels that the model expects
to clip are left out; outliers are listed. A search on few pixels precedes one joint fit of shape and fields on many.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import final

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from udccal.arguments import check_kind, check_optional
from udccal.errors import FitError
from udccal.fitting.engine.least_squares import minimise
from udccal.fitting.engine.misfit import clustered_cov
from udccal.fitting.engine.orders import Attempt, Choice, bic, choose
from udccal.fitting.engine.report import estimates, priors_of, residual_sample
from udccal.fitting.wire.data import (
    BLOCK,
    TILES,
    Pixels,
    Weighed,
    WireData,
    flat_noise,
    sample_pixels,
    tile_numbers,
)
from udccal.fitting.wire.jacobian import WireProblem, values_at, weighed_at
from udccal.fitting.wire.map_error import (
    MapJacobian,
    Strengths,
    map_jacobian,
    mean_one,
    omitted,
    strengths_of,
    tied_sigma,
    unseen,
)
from udccal.fitting.wire.parameters import SHAPE_NAMES, SOLVER, Kind, Parameters, WireRules, ideal_wire, parameters_of
from udccal.fitting.wire.residuals import Misfits, misfits
from udccal.fitting.wire.search import Descent, Search, best_of_columns, likely_columns
from udccal.models.wire import Wire, wire_map
from udccal.numerics import in_float64
from udccal.result import Diagnostic, Estimate, FitResult, FitStatus

# A number of each column that may be fitted.
_Columns = Float[np.ndarray, " all"]
_ARRAYS = {Kind.SHADING: "baseline", Kind.AMPLITUDE: "amplitudes", Kind.FIELD: "fields"}


@in_float64
def fit_wire(data: WireData, rules: WireRules | None = None, start: Wire | None = None) -> FitResult[Wire]:
    """Fit the wire to an averaged flat.

    Args:
        data: see ``WireData``.
        rules: constants of the fit.
        start: a wire of an earlier fit to go on from, instead of a search about the rig as built.

    Returns:
        the wire, whose map has a mean of 1, and its posterior: ``result.sigma_of`` gives the sigma of the map at any
        pixels, model error included. The status of a flat that cannot be used says why.
    """
    check_kind(data, WireData, "Give the average of a flat as one.", FitError)
    check_optional(rules, WireRules, FitError)
    check_optional(start, Wire, FitError)
    rules, shape = rules or WireRules(), data.signal.shape
    refused = unusable_flat(data, rules)
    if refused:
        return FitResult.failed("wire", ideal_wire(data.geometry, data.start, np.zeros((0, 2)), rules), *refused)
    noise, values = flat_noise(data), data.balanced
    few, many, every = (
        sample_pixels(values, data.geometry, max(int(part * rules.samples), 1), data.cfa)
        for part in (rules.search_part, rules.shape_part, 1.0)
    )
    search = Search(data, noise, rules)
    if start is not None and np.array_equal(start.harmonics, search.harmonics.orders):
        found = search.resumed(start, many)
    else:
        found = search.found(few, many)
    joint = _joint(found, every, search)
    tested, held_out = joint.seen, every.used < values.size / 2
    if held_out:
        others = sample_pixels(values, data.geometry, rules.samples, data.cfa, other=True)
        tested = weighed_at(joint.parameters, joint.x, others, noise)
    joint = replace(joint, x=mean_one(joint.parameters, joint.x, shape))
    jacobian, wire = map_jacobian(joint.parameters, joint.x, shape), joint.parameters.wire(joint.x)
    panel = wire if joint.parameters.panel else None
    off = misfits(tested, panel, jacobian.sigma(joint.cov), held_out, joint.variance, rules)
    if off.found:
        joint = replace(joint, cov=_wider(joint, off.lines.test.found, shape))
    if panel is not None:
        missing = omitted(data.start, wire, joint.seen, rules)
        tied = tied_sigma(joint.strengths, wire, joint.seen, joint.variance)
        left_out = float(np.hypot(tied, missing.sigma if missing else 0.0))
    else:
        left_out = unseen(search.harmonics, found.problem.pixels, rules)
    # A dark level that is off changes dim places by a larger part than bright ones.
    by_dark = data.dark_sigma * float(np.mean(1 / data.site_means) * np.std(1 / jacobian.value))
    return _result(joint, jacobian, off, (left_out, by_dark), shape, rules)


def _wider(joint: _Joint, lines: bool, shape: tuple[int, int]) -> Float[np.ndarray, "n n"]:
    """The covariance where parts of the sensor differ by more than noise: tiles, and columns and rows where they do."""
    of_lines = [
        (lambda pixels: pixels.place % shape[1], shape[1]),
        (lambda pixels: np.maximum(pixels.place, 0) // shape[1], shape[0]),
    ]
    groups = [(lambda pixels: tile_numbers(pixels.scaled), int(np.prod(TILES))), *(of_lines if lines else ())]
    each = joint.last.problem.scores(joint.x, groups)
    return joint.cov + np.sum([clustered_cov(joint.cov, one / joint.variance) - joint.cov for one in each], axis=0)


@in_float64
def sensor_map(wire: Wire, rows: int, columns: int) -> Float[np.ndarray, "rows columns"]:
    """The wire at every pixel of the sensor: modulation times shading. The computation takes seconds."""
    return np.asarray(wire_map(wire, rows, columns), dtype=np.float64)


def unusable_flat(data: WireData, rules: WireRules) -> tuple[FitStatus, str] | None:
    """Return why a flat cannot be fitted; None where it can be."""
    if data.signal.size < rules.least_samples:
        return FitStatus.TOO_FEW_DATA, f"There are {data.signal.size} pixels; use a larger region of the sensor."
    means = data.site_means
    if data.clipped > rules.most_clipped:
        return FitStatus.SATURATED, f"{100 * data.clipped:.1f} % of the flat is clipped."
    if not np.isfinite(means).all():
        return FitStatus.SATURATED, "All of a CFA site is clipped, or no number; expose shorter."
    if not all(means > 0):
        return FitStatus.TOO_DARK, "A CFA site has no light; check the lamp."
    worst = float(np.sqrt(flat_noise(data).variance(np.arange(means.size), np.ones(means.size)).max()))
    if worst > 1.0:
        note = f"A pixel's noise is {worst:.2g} of its signal. Average more frames, or expose longer."
        return FitStatus.TOO_DARK, note
    return None


@final
@dataclass(frozen=True)
class Selected:
    """Columns that are kept, and the solution with them alone."""

    keep: Bool[np.ndarray, " all"]
    values: _Columns


def select(
    matrix: Float[np.ndarray, "all all"], right: _Columns, power: float, samples: int, groups: Int[np.ndarray, " all"]
) -> Choice[Selected]:
    """Drop groups of columns, the weakest first, while that lowers BIC.

    A group of k columns is kept when leaving it out raises chi-squared, in units of the residual variance of the full
    model (so that PRNU counts as noise), by more than k ln(samples). Group -1 is always kept. ``power`` is the weighted
    sum of the squared data. The result holds the full choice and the last steps to the best one.
    """
    unit = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    # The tiny ridge only decides between columns that the data cannot distinguish.
    cov = np.linalg.inv(matrix / np.outer(unit, unit) + 1e-10 * np.eye(len(unit))) / np.outer(unit, unit)
    values, keep, total = cov @ right, np.ones(len(right), dtype=bool), len(np.unique(groups[groups >= 0]))
    variance = max((power - float(right @ values)) / max(samples - len(right), 1), 1e-300)
    tried: list[Attempt[Selected]] = []
    while True:
        optional = np.unique(groups[keep & (groups >= 0)])
        criterion = bic((power - float(right @ values)) / variance, float(keep.sum()), samples)
        selected = Selected(keep, values)
        tried.append(Attempt(f"{len(optional)} of {total} terms", int(keep.sum()), criterion, selected))
        # The exact rise of chi-squared when one group is left out, by column.
        inside = [np.flatnonzero(groups == group) for group in optional]
        rises = [values[g] @ np.linalg.solve(cov[np.ix_(g, g)], values[g]) / len(g) / variance for g in inside]
        if not rises or min(rises) >= np.log(samples):
            return choose((tried[0], *tried[1:][-8:]))
        weakest = inside[int(np.argmin(rises))]
        gone = np.linalg.solve(cov[np.ix_(weakest, weakest)], cov[weakest])
        # By Schur's complement, the inverse without these rows and columns.
        values, cov = values - gone.T @ values[weakest], cov - cov[:, weakest] @ gone
        values[weakest], cov[weakest], cov[:, weakest] = 0.0, 0.0, 0.0
        keep = keep & (groups != groups[weakest[0]])


@final
@dataclass(frozen=True)
class _Joint:
    """A fitted wire: the search, the last descent, and the parameters' values and covariance.

    ``variance`` is that of the residuals in units of the noise's, ``seen`` the pixels of the fit with their weights.
    """

    found: Descent
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
        openings = np.flatnonzero(self.parameters.of(Kind.SHAPE))[7:9]
        return bool(np.any(self.x[openings] - 1 > 3 * np.sqrt(np.diag(self.cov)[openings])))


def _joint(found: Descent, every: Pixels, search: Search) -> _Joint:
    """Choose the columns that the data support, and fit them with the shape until the solver converges."""
    panel, start, noise, rules = found.problem.parameters.panel, search.data.start, search.noise, search.rules
    full = parameters_of(found.wire, rules, found.gains.size, search.harmonics.bounds if panel else (), panel)
    prior, x = full.prior(start, rules), full.vector(found.wire, found.gains)
    here = WireProblem("wire, orders", full, found.weighs(every, noise), prior).equations_at(x)
    # The equations are moved to where the columns are 0, so that the present coefficients count as the columns' own.
    already = np.where(full.groups >= 0, x - prior.mean, 0.0)
    right = here.right + here.shared @ already
    power = here.samples - len(x) + prior.cost(x) + float((here.right + right) @ already)
    orders = select(here.shared, right, power, here.samples, full.groups)
    chosen = orders.best.fit
    strengths = strengths_of(full, here.shared, right, chosen.keep, chosen.values)
    kept, x = full.kept(chosen.keep), (x - already + chosen.values)[chosen.keep]
    problem = WireProblem("wire, joint", kept, weighed_at(kept, x, every, noise).pixels, kept.prior(start, rules))
    # On the pixels of the search: by then, columns that are strong enough leave a single place.
    others = likely_columns(found, found.problem.pixels, start, rules.rival * found.variance) if panel else []
    last, spread = best_of_columns(Descent(problem, minimise(problem, x, SOLVER)), others, found.problem.pixels)
    solution = last.solution
    # A last step whose expected gain is below the solver's limit is taken without a check of the cost.
    x = solution.place + (solution.equations.step(0.0).shared if solution.converged else 0.0)
    seen = weighed_at(kept, x, every, noise)
    cov = solution.with_rest(solution.equations.cov()) + spread
    return _Joint(found, last, x, cov, problem.variance(float(seen.z @ seen.z)), seen, orders, strengths)


def _result(
    joint: _Joint,
    jacobian: MapJacobian,
    found: Misfits,
    unfitted: tuple[float, float],
    shape: tuple[int, int],
    rules: WireRules,
) -> FitResult[Wire]:
    """The result of a finished fit, on a sensor of that shape.

    ``unfitted`` is the relative part by harmonics that are tied or omitted, or by rows that may be there unseen, and
    that by the dark level, RMS over the sensor.
    """
    (left_out, by_dark), seen, solution = unfitted, joint.seen, joint.last.solution
    model = float(np.linalg.norm([found.sigma, left_out, by_dark]))
    posterior = jacobian.posterior(joint.parameters, joint.x, joint.cov, model)
    term, outliers = _trimmed(posterior.term), seen.outliers(shape[1])
    drawn = np.flatnonzero(seen.pixels.weight > 0)
    mounted = Rotation.from_rotvec(term.geometry.rotation_rad)
    turned = Rotation.from_rotvec(term.rotation_rad) * mounted
    tilt, nominal = (np.rad2deg(np.arcsin(np.clip(one.as_matrix()[1, 2], -1.0, 1.0))) for one in (turned, mounted))
    diagnostics = (
        ("wire_map_rms_sigma", 100 * jacobian.sigma(joint.cov, model), "%"),
        ("wire_map_model_sigma", 100 * model, "%"),
        ("harmonics_left_out", 100 * left_out, "%"),
        ("map_sigma_by_dark_level", 100 * by_dark, "%"),
        ("residual_pattern_p_value", found.pattern.test.p_value, "1"),
        ("residual_lines_p_value", found.lines.test.p_value, "1"),
        ("residual_spots_p_value", found.spots.test.p_value, "1"),
        ("modulation_peak_to_peak", 100 * np.ptp(values_at(term, seen.pixels.thinned(8 * BLOCK))[0]), "%"),
        ("harmonics", len(term.harmonics), "1"),
        ("parameters", joint.parameters.linear, "1"),
        ("pixels_left_out", sum(one.count for one in outliers), "1"),
        ("gain_in_chi2", joint.found.gain, "1"),
        ("tilt_by_wire", tilt, "deg"),
        ("tilt_by_wire_minus_geometry", tilt - nominal, "deg"),
        ("iterations", joint.found.solution.iterations + solution.iterations, "1"),
    )
    if joint.variance > rules.worst_variance or joint.impossible:
        status = FitStatus.POOR_FIT
    elif not joint.parameters.panel:
        status = FitStatus.ABSENT
    else:
        status = FitStatus.CONVERGED if solution.converged else FitStatus.NOT_CONVERGED
    named, cov = _estimates(joint, jacobian) if joint.parameters.panel else ((), np.eye(0))
    return FitResult(
        name="wire",
        term=term,
        status=status,
        estimates=named,
        cov=cov,
        chi2_dof=joint.variance,
        samples=seen.pixels.used,
        candidates=joint.orders.candidates,
        diagnostics=tuple(Diagnostic(name, float(value), unit) for name, value, unit in diagnostics),
        notes=tuple(_notes(joint, found, left_out, shape, rules)),
        outliers=outliers,
        residuals=residual_sample((seen.pixels.scaled[drawn] + 1) / 2 * [shape[1] - 1, shape[0] - 1], seen.z[drawn]),
        posterior=posterior,
        map_sigma=jacobian.sigma_map(joint.cov, model),
    )


def _trimmed(wire: Wire) -> Wire:
    """The wire without unused Legendre degrees, amplitudes, and harmonics where there is no panel: it is faster."""
    used = np.flatnonzero(np.any(wire.fields != 0, axis=(0, 1, 2)))
    beside = wire.amplitudes if np.any(wire.amplitudes) else np.zeros((0, 2, 1, 1))
    seen = np.s_[: len(wire.harmonics) if used.size or len(beside) else 0]
    fields = wire.fields[seen, ..., : used.max(initial=0) + 1]
    parts = {"harmonics": wire.harmonics[seen], "frequency": wire.frequency[seen], "fields": fields}
    return replace(wire, amplitudes=beside, **parts)


def _notes(joint: _Joint, found: Misfits, left_out: float, shape: tuple[int, int], rules: WireRules) -> Iterator[str]:
    if joint.parameters.panel:
        prior = joint.last.problem.prior
        off = (prior.root @ (joint.x - prior.mean))[joint.parameters.linear :]
        if joint.found.sharpness < 1:
            yield (
                "The rows lack the higher harmonics of rectangular openings: row_open and column_open describe the "
                "strength of the first harmonics, not edges that a microscope would show."
            )
        elif (free := joint.strengths.free).any():
            worst = 100 * np.abs(joint.strengths.off[free]).max()
            yield (
                f"Harmonics are up to {worst:.2g} % stronger or weaker than rectangular openings make them, which the "
                "map has: row_open, column_open and depth_per_pitch are those of the rectangles that come closest, and "
                "an edge may lie beyond their sigmas. The psf tells the openings' shape."
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
    if found.spots.test.found:
        spot, (rows, columns) = found.spot, shape
        at = f"column {columns * spot.across:.0f}, row {rows * spot.down:.0f}"
        kind = "brighter" if spot.off > 0 else "darker"
        yield (
            f"The flat is {100 * abs(spot.off):.2g} % {kind} than the map about {at}, in "
            f"{columns * spot.size[0]:.0f} x {rows * spot.size[1]:.0f} px, and the map may be so much off "
            "there. Look for dust, glare and shadows."
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


def _estimates(joint: _Joint, jacobian: MapJacobian) -> tuple[tuple[Estimate, ...], Float[np.ndarray, "n n"]]:
    """The shape, then all elements of the wire's arrays that were fitted, with their covariance."""
    parameters, prior = joint.parameters, joint.last.problem.prior
    # Gains of the CFA sites are not in the term: their errors remain in the variances of the others.
    others = np.flatnonzero(~parameters.of(Kind.SITE) & ~parameters.of(Kind.SHAPE))
    order = np.concatenate([np.flatnonzero(parameters.of(Kind.SHAPE)), others])
    names = list(SHAPE_NAMES)
    for kind, *index in parameters.columns[others].tolist():
        names.append(".".join(map(str, (_ARRAYS[kind], *(index[2:] if kind == Kind.SHADING else index)))))
    (values, unit), (known, wide) = _in_units(joint.x[order]), _in_units(prior.mean[order])
    sigma = prior.sigma[order] * wide
    # Places have no origin beforehand.
    values[4:6], sigma[4:6] = values[4:6] % 1.0, np.inf
    # The first coefficient of the shading keeps the map's mean at 1.
    change = np.eye(len(joint.x))
    change[0] -= jacobian.of_mean
    cov = (change @ joint.cov @ change.T)[np.ix_(order, order)] * np.outer(unit, unit)
    return estimates("wire", names, values, cov, priors_of(names, known, sigma)), cov


def _in_units(x: Float[np.ndarray, " n"]) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Values from the fit's own parameters, of which the shape is first, and their derivatives by these."""
    values, unit = x.copy(), np.ones(len(x))
    # The fit's own are radians and, for stand-off and pupil, logarithms.
    values[[3, 6]] = unit[[3, 6]] = np.exp(values[[3, 6]])
    values[:3], unit[:3] = np.rad2deg(values[:3]), 180 / np.pi
    return values, unit
