"""Backscatter fit: averages of the panel's pictures under blackout -> how the panel's light gets into the lens.

The white picture gives the mask. The other pictures, divided by white so that mask, wire and pixel gains cancel,
give the transfer curve, the colour mix and the footprint. Candidates compete on every fourth picture, which is held out
of their fits.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from udccal.fitting.absent import absent_backscatter
from udccal.fitting.backscatter_data import (
    PanelShots,
    directions,
    grid_step,
    nominal_term,
    read_shots,
    sampled_rays,
    visible_crop,
)
from udccal.fitting.backscatter_solve import (
    NAMES,
    SLACK_PX,
    UNITS,
    Ratios,
    corners_of,
    errors,
    prior_sigma,
    ratios,
    scan_offset,
    solve,
    start_vector,
    window_for,
    with_vector,
)
from udccal.fitting.result import Candidate, Diagnostic, Estimate, FitResult, FitStatus
from udccal.fitting.solvers import Solution
from udccal.models.backscatter import Backscatter, grid_positions
from udccal.models.geometry import Geometry
from udccal.models.noise import Noise
from udccal.numerics import in_float64
from udccal.rig import RigDescription
from udccal.sessions.store import Session

_MIN_PICTURES = 6
_HELD_OUT_EVERY = 4
_MAX_CLIPPED = 0.02
# White light below this many sigma of a bin, at the 90th percentile of bins, is no light.
_VISIBLE_SIGMA = 5.0
# A simpler candidate is taken when its held-out error is within this factor of the best.
_AS_GOOD = 1.05
_WORST_ERROR = 0.05
# Which of NAMES each candidate leaves free, simplest first.
_ONE_PLACE = np.array([1, 1, 1, 1, 0, 0, 1, 1, 0, 0, 0, 0, 1, 1, 1, 1, 1, 1.0])
_ONE_PLANE = np.array([1, 1, 1, 1, 0, 0, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1.0])
_RIG_GLASS = np.array([1, 1, 1, 1, 1, 0, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1.0])
_ALL_FREE = np.ones(18)
ORDERS = (
    ("one plane, primaries in one place", _ONE_PLACE),
    ("one plane", _ONE_PLANE),
    ("two planes, glass of the rig", _RIG_GLASS),
    ("two planes", _ALL_FREE),
)


@dataclass(frozen=True)
class _Problem:
    """What all candidates share."""

    template: Backscatter
    data: Ratios
    white: Float[np.ndarray, "3 n"]
    start: Float[np.ndarray, "18"]
    sigma: Float[np.ndarray, "18"]


def fit_backscatter(
    session: Session,
    noise: Noise,
    geometry: Geometry,
    shading: Float[np.ndarray, "rows columns"],
    positions: int = 96,
) -> FitResult[Backscatter]:
    """Fit the backscatter term to the steps ``backscatter/*`` of a session.

    Args:
        session: holds ``backscatter/white``, ``backscatter/dark`` and at least 6 other pictures, as averages.
        noise: gives K, black level and saturation.
        geometry: where rays go.
        shading: the wire's map of the sensor (``fitting.wire.sensor_map``), divided out of what was measured.
        positions: number of sensor positions that the footprint is fitted at.

    Raises:
        SessionError: when a file is missing or damaged.
    """
    shots = read_shots(session, noise, visible_crop(geometry, session.rig), shading)
    if shots is None:
        note = "Expected the steps backscatter/white and backscatter/dark, found that they were not captured."
        return _without(session.rig, geometry, FitStatus.TOO_FEW_DATA, note)
    return fit_shots(shots, geometry, session.rig, positions)


def fit_shots(
    shots: PanelShots, geometry: Geometry, rig: RigDescription, positions: int = 96
) -> FitResult[Backscatter]:
    """Fit the backscatter term to binned rates; see ``fit_backscatter``."""
    if shots.white.clipped > _MAX_CLIPPED:
        note = f"{shots.white.clipped:.0%} of the white picture's samples are clipped."
        return _without(rig, geometry, FitStatus.SATURATED, note)
    signal = shots.white.rate / np.sqrt(np.maximum(shots.white.variance, 1e-30))
    if np.percentile(signal, 90) < _VISIBLE_SIGMA:
        return _without(rig, geometry, FitStatus.ABSENT, "The white picture gives no light that shows above noise.")
    seen = [one for one in shots.seen if one.clipped <= _MAX_CLIPPED]
    dropped = len(shots.seen) - len(seen)
    if len(seen) < _MIN_PICTURES:
        note = f"Expected at least {_MIN_PICTURES} unclipped pictures, found {len(seen)} ({dropped} clipped)."
        return _without(rig, geometry, FitStatus.TOO_FEW_DATA, note)
    keep = np.array([one.clipped <= _MAX_CLIPPED for one in shots.seen])
    problem = _problem(replace(shots, seen=tuple(seen), shown=shots.shown[keep]), geometry, rig, positions)
    notes = (f"{dropped} clipped pictures left out.",) if dropped else ()
    return _fit(problem, rig, notes)


def _without(rig: RigDescription, geometry: Geometry, status: FitStatus, note: str) -> FitResult[Backscatter]:
    term = absent_backscatter(rig, geometry)
    return FitResult(term, status, estimates=(), cov=np.zeros((0, 0)), chi2_dof=0.0, samples=0, notes=(note,))


def _problem(shots: PanelShots, geometry: Geometry, rig: RigDescription, positions: int) -> _Problem:
    step = grid_step(rig)
    rays, flat = sampled_rays(geometry, rig, step, positions)
    data = ratios(shots, rays, flat)
    few = ratios(shots, rays[::4], flat[::4])
    mask = np.maximum(shots.white.rate, 0.0)
    template = nominal_term(geometry, rig, mask, step, window=1)
    nominal = start_vector(rig, np.zeros(2))
    wide = replace(template, window=window_for(template, nominal, rays, SLACK_PX))
    start = start_vector(rig, scan_offset(wide, few, rig))
    return _Problem(wide, data, shots.white.rate.reshape(3, -1)[:, flat], start, prior_sigma(rig))


def _fit(problem: _Problem, rig: RigDescription, notes: tuple[str, ...]) -> FitResult[Backscatter]:
    pictures = len(problem.data.ratio)
    fitted = np.ones(pictures)
    fitted[_HELD_OUT_EVERY - 1 :: _HELD_OUT_EVERY] = 0.0
    prior = (problem.start.copy(), problem.sigma)
    corner = corners_of(problem.template, problem.start, problem.data.rays)
    tried: list[Float[np.ndarray, "18"]] = []
    held_out: list[float] = []
    for _, free in ORDERS:
        start = problem.start.copy()
        start[4] *= free[4]
        solution = solve(problem.template, problem.data, start, corner, prior, free, fitted)
        tried.append(solution.x)
        held_out.append(_held_out_error(problem, solution.x, corner, fitted == 0))
    best = next(k for k, error in enumerate(held_out) if error <= _AS_GOOD * min(held_out))
    candidates = tuple(
        Candidate(name, int(free.sum()), error, chosen=k == best)
        for k, ((name, free), error) in enumerate(zip(ORDERS, held_out, strict=True))
    )
    free = ORDERS[best][1]
    corner = corners_of(problem.template, tried[best], problem.data.rays)
    final = solve(problem.template, problem.data, tried[best], corner, prior, free, np.ones(pictures))
    return _result(problem, final, free, candidates, rig, notes)


def _held_out_error(
    problem: _Problem, x: Float[np.ndarray, "18"], corner: np.ndarray, held_out: Bool[np.ndarray, " pictures"]
) -> float:
    """RMS over the held-out pictures of the error of b, each in units of its own picture's peak."""
    error = errors(problem.template, problem.data, x, corner)[held_out] * problem.white
    peak = (problem.data.ratio[held_out] * problem.white).max(axis=(1, 2), keepdims=True)
    return float(np.sqrt(np.mean((error / np.maximum(peak, 1e-12)) ** 2)))


def _result(
    problem: _Problem,
    final: Solution,
    free: Float[np.ndarray, "18"],
    candidates: tuple[Candidate, ...],
    rig: RigDescription,
    notes: tuple[str, ...],
) -> FitResult[Backscatter]:
    data_count = int((problem.data.weight > 0).sum())
    chi2_dof = final.chi2 / max(data_count - int(free.sum()), 1)
    cov = final.cov * max(chi2_dof, 1.0)
    sigma = np.sqrt(np.maximum(np.diag(cov), 0.0))
    error = min(c.criterion for c in candidates if c.chosen)
    status = FitStatus.CONVERGED if final.converged else FitStatus.NOT_CONVERGED
    if error > _WORST_ERROR:
        status = FitStatus.POOR_FIT
    held = [name for name, one in zip(NAMES, free, strict=True) if not one]
    fixed = (f"Held: {', '.join(held)}.",) if held else ()
    return FitResult(
        term=_term(problem.template, final.x),
        status=status,
        estimates=tuple(
            Estimate(name, float(value), float(one), unit)
            for name, value, one, unit in zip(NAMES, final.x, sigma, UNITS, strict=True)
        ),
        cov=cov,
        chi2_dof=float(chi2_dof),
        samples=data_count,
        candidates=candidates,
        diagnostics=(
            Diagnostic("held_out_rms_of_peak", error, "1"),
            Diagnostic("pictures", float(len(problem.data.ratio)), "1"),
            Diagnostic("positions", float(len(problem.data.rays)), "1"),
            Diagnostic("iterations", float(final.iterations), "1"),
        ),
        notes=(*notes, *fixed, "Estimates start from the rig's values with its tolerances as prior sigma."),
    )


@in_float64
def _term(template: Backscatter, x: Float[np.ndarray, "18"]) -> Backscatter:
    """The fitted term in numpy, its window no larger than the footprints on the whole grid need."""
    columns, rows = (np.asarray(a) for a in grid_positions(template.columns, template.rows, template.step))
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    rays = np.asarray(directions(template.geometry, pixels), dtype=np.float64)
    fitted = with_vector(template, jnp.asarray(x))
    return Backscatter(
        geometry=template.geometry,
        mask=np.asarray(template.mask, dtype=np.float64),
        mix=np.asarray(fitted.mix, dtype=np.float64),
        gamma=np.float64(x[0]),
        pitch_mm=np.asarray(template.pitch_mm, dtype=np.float64),
        pupil_mm=np.float64(x[2]),
        distance_mm=np.float64(x[1]),
        emitters_px=np.asarray(fitted.emitters_px, dtype=np.float64),
        softness_px=np.float64(abs(x[3])),
        reflection=np.float64(x[4]),
        reflection_mm=np.float64(x[5]),
        columns=template.columns,
        rows=template.rows,
        cfa=template.cfa,
        step=template.step,
        window=window_for(template, x, rays, slack=0.5),
    )
