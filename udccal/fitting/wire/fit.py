"""Wire fit: from the average of flats to a smooth, noise-free map of the panel's modulation and the shading.

The fit takes the maximum a posteriori, with the rig description as prior. The weight of a pixel follows from the
variance at its expected signal (shot, read and quantisation noise over the frames, PRNU). Pixels that the model expects
to clip are left out; outliers are listed. A search on few pixels precedes one joint fit of shape and fields on many.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import final

import numpy as np
from jaxtyping import Float, Float32

from udccal.arguments import check_kind
from udccal.errors import FitError
from udccal.fitting.engine.gaussian import Posterior, square_root
from udccal.fitting.engine.least_squares import minimise
from udccal.fitting.engine.misfit import clustered_cov
from udccal.fitting.engine.report import coarse
from udccal.fitting.wire.columns import best_of_columns, likely_columns
from udccal.fitting.wire.data import Pixels, WireData, flat_noise, pixels_at, sample_pixels
from udccal.fitting.wire.jacobian import WireProblem, block_jacobian, values_at, weighed_at
from udccal.fitting.wire.parameters import Kind, Parameters, parameters_of, select
from udccal.fitting.wire.report import Joint, misfits, rms, wire_result
from udccal.fitting.wire.rules import SOLVER, WireRules, ideal_wire
from udccal.fitting.wire.search import Descent, Found, Search
from udccal.fitting.wire.weak import omitted, strengths_of, tied_sigma, unseen
from udccal.models.geometry import Geometry
from udccal.models.wire import Wire, wire_map
from udccal.numerics import in_float64
from udccal.result import FitResult, FitStatus

# Places of the map's Jacobian, down and across.
_PLACES = 64


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
        joint = replace(joint, cov=clustered_cov(joint.cov, joint.last.problem.sums(joint.x)[1] / joint.variance))
    if joint.parameters.panel:
        missing = omitted(data.start, wire, joint.seen, rules)
        tied = tied_sigma(joint.strengths, wire, joint.seen, joint.variance)
        left_out = float(np.hypot(tied, missing.sigma if missing else 0.0))
    else:
        left_out = unseen(search.harmonics, found.searched, rules)
    model = float(np.hypot(off.sigma, left_out))
    posterior = _posterior(joint, jacobian, model)
    map_sigma, cov = jacobian.sigma_map(joint.cov, model), jacobian.cov_of_mean_one(joint.cov)
    return wire_result(joint, cov, off, left_out, map_sigma, posterior, shape, rules)


@in_float64
def sensor_map(wire: Wire, rows: int, columns: int) -> Float[np.ndarray, "rows columns"]:
    """The wire at every pixel of the sensor: modulation times shading. The computation takes seconds."""
    return np.asarray(wire_map(wire, rows, columns), dtype=np.float64)


def unusable_flat(data: WireData, rules: WireRules) -> tuple[FitStatus, str] | None:
    """Return why a flat cannot be fitted; None where it can be."""
    means = data.site_means
    if data.clipped > rules.most_clipped:
        return FitStatus.SATURATED, f"{100 * data.clipped:.1f} % of the flat is clipped."
    if not np.isfinite(means).all():
        return FitStatus.SATURATED, "All of a CFA site is clipped, or no number; expose shorter."
    if not all(means > 0):
        return FitStatus.TOO_DARK, "A CFA site has no light; check the lamp."
    if data.signal.size < rules.least_samples:
        return FitStatus.TOO_FEW_DATA, f"There are {data.signal.size} pixels; use a larger region of the sensor."
    worst = float(np.sqrt(flat_noise(data).variance(np.arange(means.size), np.ones(means.size)).max()))
    if worst > 1.0:
        note = f"A pixel's noise is {worst:.2g} of its signal. Average more frames, or expose longer."
        return FitStatus.TOO_DARK, note
    return None


def _joint(found: Found, every: Pixels, search: Search) -> Joint:
    """Choose the columns that the data support, and fit them with the shape until the solver converges."""
    descent, panel = found.descent, found.descent.problem.parameters.panel
    start, noise, rules = search.data.start, search.noise, search.rules
    bounds = search.harmonics.bounds if panel else ()
    full = parameters_of(descent.wire, rules, descent.gains.size, bounds, panel)
    prior, x = full.prior(start, rules), full.vector(descent.wire, descent.gains)
    here = WireProblem("wire, orders", full, descent.weighs(every, noise), prior).equations_at(x)
    # The equations are moved to where the columns are 0, so that the present coefficients count as the columns' own.
    already = np.where(full.groups >= 0, x - prior.mean, 0.0)
    right = here.right + here.shared @ already
    power = here.samples - len(x) + prior.cost(x) + float((here.right + right) @ already)
    orders = select(here.shared, right, power, here.samples, full.groups)
    chosen = orders.best.fit
    strengths = strengths_of(full, here.shared, right, chosen)
    kept, x = full.kept(chosen.keep), (x - already + chosen.values)[chosen.keep]
    problem = WireProblem("wire, joint", kept, weighed_at(kept, x, every, noise).pixels, kept.prior(start, rules))
    # On the pixels of the search: by then, columns that are strong enough leave a single place.
    searched, margin = descent.problem.pixels, rules.rival * descent.variance
    others = likely_columns(descent.wire, descent.gains, searched, start.column_open, margin) if panel else []
    solution, spread = best_of_columns(problem, minimise(problem, x, SOLVER), others)
    # A last step whose expected gain is below the solver's limit is taken without a check of the cost.
    x = solution.place + (solution.equations.step(0.0).shared if solution.converged else 0.0)
    seen = weighed_at(kept, x, every, noise)
    cov, last = solution.with_rest(solution.equations.cov()) + spread, Descent(problem, solution)
    return Joint(found, last, x, cov, problem.variance(float(seen.z @ seen.z)), seen, orders, strengths)


def _grid(geometry: Geometry, shape: tuple[int, int], parts: tuple[int, int]) -> Pixels:
    """The middles of ``parts`` (down, across) of a sensor of that shape."""
    y, x = ((np.arange(n) + 0.5) / n * size - 0.5 for n, size in zip(parts, shape, strict=True))
    return pixels_at(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2), geometry, shape)


def mean_one(parameters: Parameters, x: Float[np.ndarray, " n"], shape: tuple[int, int]) -> Float[np.ndarray, " n"]:
    """``x`` with the first coefficient of the shading that gives the map a mean of 1, by the midpoint rule.

    ``shape`` is the sensor's (rows, columns).
    """
    wire = parameters.wire(x)
    whole, base = values_at(wire, _grid(wire.geometry, shape, (192, 256)))
    scaled = x.copy()
    scaled[0] -= np.log(float(np.mean(whole * base)))
    return scaled


@final
@dataclass(frozen=True)
class MapJacobian:
    """Values of the map and their derivatives ``rows`` at a fixed mean of 1, on a grid over the sensor.

    ``of_mean`` are the derivatives of the mean where it is not fixed.
    """

    value: Float[np.ndarray, " places"]
    rows: Float[np.ndarray, "n places"]
    of_mean: Float[np.ndarray, " n"]

    def sigma_map(self, cov: Float[np.ndarray, "n n"], model: float = 0.0) -> Float32[np.ndarray, "1 16 16"]:
        """Relative sigma of the map, RMS over 16 x 16 cells; ``model`` is the relative model error."""
        variance = np.einsum("ip,ij,jp->p", self.rows, cov, self.rows, optimize=True) + (model * self.value) ** 2
        return np.sqrt(coarse(variance.reshape(1, _PLACES, _PLACES), 16)).astype(np.float32)

    def sigma(self, cov: Float[np.ndarray, "n n"], model: float = 0.0) -> float:
        """Relative sigma of the map, RMS over the sensor; ``model`` is the relative model error."""
        return rms(self.sigma_map(cov, model))

    def cov_of_mean_one(self, cov: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
        """Covariance of the parameters where the first coefficient of the shading keeps the map's mean at 1."""
        change = np.eye(len(cov))
        change[0] -= self.of_mean
        return np.asarray(change @ cov @ change.T)


def map_jacobian(parameters: Parameters, x: Float[np.ndarray, " n"], shape: tuple[int, int]) -> MapJacobian:
    """Jacobian of the map at ``x``, whose mean is 1, on a grid of places over a sensor (rows, columns)."""
    wire = parameters.wire(x)
    grid = _grid(wire.geometry, shape, (_PLACES, _PLACES))
    whole, base, rows = grid.by_block(lambda block: block_jacobian(parameters, wire, block))
    value, rows = whole * base, rows * base
    # Site gains are not in the map.
    rows[parameters.of(Kind.SITE)] = 0.0
    of_mean = rows.mean(axis=1)
    return MapJacobian(value, rows - of_mean[:, None] * value, of_mean)


def _posterior(joint: Joint, jacobian: MapJacobian, model: float) -> Posterior[Wire]:
    """Posterior of the fitted parameters and of the model error.

    The model error is a further modulation of unknown phase. Its cosine and sine are two more parameters, so that it
    adds the same variance everywhere. To first order, the map's mean stays 1.
    """

    def term_at(values: Float[np.ndarray, " n_2"]) -> Wire:
        x, beside = values[:-2].copy(), values[-2:]
        x[0] -= jacobian.of_mean @ (x - joint.x)
        wire = joint.parameters.wire(x)
        amplitudes = np.zeros(max(np.shape(wire.amplitudes), (1, 2, 1, 1)))
        amplitudes[: len(wire.amplitudes)] = wire.amplitudes
        amplitudes[0, :, 0, 0] += beside
        return replace(wire, amplitudes=amplitudes)

    size = len(joint.x)
    factor = np.zeros((size + 2, size + 2))
    factor[:size, :size] = square_root(joint.cov)
    factor[size:, size:] = model * np.eye(2)
    return Posterior(np.append(joint.x, [0.0, 0.0]), factor, term_at)
