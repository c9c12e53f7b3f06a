"""Backscatter fit: averages of the panel's pictures under blackout -> how the panel's light gets into the lens.

White, dark and pictures share one likelihood (``backscatter.likelihood``). Candidates compete by their
evidence; what the best of them cannot describe is estimated, from all pictures and from every fourth one,
which is held out of a fit of its own, and counts as noise. Shots and samples that do not belong are listed.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from udccal.fitting.absent import absent_backscatter
from udccal.fitting.backscatter.begin import Problem
from udccal.fitting.backscatter.data import (
    PanelShots,
    grid_step,
    read_shots,
    sampled_rays,
    visible_crop,
)
from udccal.fitting.backscatter.evidence import LEAST_VARIANCE, evidence, pictures_of
from udccal.fitting.backscatter.report import told
from udccal.fitting.backscatter.select import choose
from udccal.fitting.backscatter.solve import SLACK_PX, scan_offset, window_for
from udccal.fitting.backscatter.vector import prior_of
from udccal.fitting.nominal import nominal_backscatter
from udccal.models.backscatter import Backscatter
from udccal.models.geometry import Geometry
from udccal.models.noise import Noise
from udccal.result import FitResult, FitStatus
from udccal.rig import RigDescription
from udccal.sessions.store import Session

_MIN_PICTURES = 6
# A shot with more than this share of clipped bins is left out whole; of others, the clipped bins are.
_MAX_CLIPPED = 0.02
# Light that is below this many sigma of a bin at its 90th percentile, or in all bins together, is no light.
_VISIBLE_SIGMA, _PRESENT_SIGMA = 2.0, 5.0


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
        noise: gives K, black level and saturation, and the variance of samples.
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
    if (clipped := float(shots.white.clipped.mean())) > _MAX_CLIPPED:
        note = f"{clipped:.0%} of the white picture's bins hold clipped samples."
        return _without(rig, geometry, FitStatus.SATURATED, note)
    if not _shows_light(shots):
        return _without(rig, geometry, FitStatus.ABSENT, "The white picture gives no light that shows above noise.")
    keep = np.array([one.clipped.mean() <= _MAX_CLIPPED for one in shots.seen], dtype=bool)
    if keep.sum() < _MIN_PICTURES:
        note = f"Expected at least {_MIN_PICTURES} unclipped pictures, found {keep.sum()} ({(~keep).sum()} clipped)."
        return _without(rig, geometry, FitStatus.TOO_FEW_DATA, note)
    used = _only(shots, keep)
    problem = problem_of(used, geometry, rig, positions)
    dropped = [name for name, kept in zip(shots.names, keep, strict=True) if not kept]
    return told(choose(problem), used, rig, dropped)


def problem_of(shots: PanelShots, geometry: Geometry, rig: RigDescription, positions: int) -> Problem:
    """The evidence at sampled positions, with a start found by scanning."""
    step = grid_step(rig)
    rays, flat = sampled_rays(geometry, rig, step, positions)
    prior = prior_of(rig)
    # The mask comes out of the likelihood; the template's is of no size.
    template = nominal_backscatter(geometry, rig, np.zeros((3, 1, 1)), step, window=1)
    wide = replace(template, window=window_for(template, prior.mean, rays, SLACK_PX))
    seen = evidence(shots, rays, flat, pictures_of(shots.shown, shots.crop))
    return Problem(wide, seen, flat, prior, scan_offset(wide, seen, rig, prior).x)


def _shows_light(shots: PanelShots) -> bool:
    white, dark = shots.white, shots.dark
    excess = white.rate - dark.rate * (dark.exposure_s / white.exposure_s)
    variance = np.maximum(white.rest + dark.rest, LEAST_VARIANCE * white.shot**2)
    sigma = excess / np.sqrt(variance)
    total = float(sigma.sum()) / np.sqrt(sigma.size)
    return bool(total > _PRESENT_SIGMA) and float(np.percentile(sigma, 90)) > _VISIBLE_SIGMA


def _only(shots: PanelShots, keep: np.ndarray) -> PanelShots:
    seen = tuple(one for one, kept in zip(shots.seen, keep, strict=True) if kept)
    names = tuple(one for one, kept in zip(shots.names, keep, strict=True) if kept)
    return replace(shots, seen=seen, shown=shots.shown[keep], names=names)


def _without(rig: RigDescription, geometry: Geometry, status: FitStatus, note: str) -> FitResult[Backscatter]:
    term = absent_backscatter(rig, geometry)
    return FitResult.failed("backscatter", term, status, note)
