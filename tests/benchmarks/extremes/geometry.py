"""Geometry at the ends of its range: mounting, number and placing of the boards, and what corners can go wrong."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from tests.benchmarks.extremes.case import Case, Outcome, outcome
from tests.fitting.geometry.boards import MOUNTED_DEG, Sight, sight
from udccal.fitting.engine.gaussian import Prior
from udccal.fitting.geometry.corners import BoardCorners
from udccal.fitting.geometry.data import BoardView, GeometryData
from udccal.fitting.geometry.fit import fit_boards
from udccal.models.geometry import Geometry

_FOCAL_SIGMA_PX, _CENTRE_SIGMA_PX = 15.0, 8.0
_BEND, _BEND_SIGMA = np.array([-0.07, 0.035, 0.0, 0.0, 0.0]), np.array([0.03, 0.02, 8e-4, 8e-4, 0.01])
_START = Geometry(
    np.full(2, 870.0), np.array([511.5, 383.5]), np.zeros(5), np.zeros(3), np.array([600.0, 190.0, -14.0])
)
_PRIOR = Prior.independent(
    np.array([870.0, 870.0, 511.5, 383.5, *_BEND]),
    np.array([*[_FOCAL_SIGMA_PX] * 2, *[_CENTRE_SIGMA_PX] * 2, *_BEND_SIGMA]),
)
Change = Callable[[list[BoardView], np.random.Generator], list[BoardView]]


def _same(views: list[BoardView], rng: np.random.Generator) -> list[BoardView]:
    return views


def _with(view: BoardView, xy: np.ndarray, keep: np.ndarray | slice = slice(None)) -> BoardView:
    return replace(view, corners=BoardCorners(view.corners.ids[keep], xy[keep], view.corners.sigma[keep]))


def _nan_corners(views: list[BoardView], rng: np.random.Generator) -> list[BoardView]:
    def spoiled(view: BoardView) -> BoardView:
        return _with(view, np.where(rng.uniform(size=(len(view.corners.ids), 1)) < 0.1, np.nan, view.corners.xy))

    return [spoiled(view) for view in views]


def _huge_outliers(views: list[BoardView], rng: np.random.Generator) -> list[BoardView]:
    """One corner in ten anywhere in the picture, and one view read in the wrong order."""

    def spoiled(view: BoardView) -> BoardView:
        wrong = rng.uniform(size=(len(view.corners.ids), 1)) < 0.1
        return _with(view, np.where(wrong, rng.uniform(0, 768, view.corners.xy.shape), view.corners.xy))

    last = views[-1]
    return [*(spoiled(view) for view in views[:-1]), _with(last, rng.permutation(last.corners.xy))]


def _one_line(views: list[BoardView], rng: np.random.Generator) -> list[BoardView]:
    """The last view shows one row of corners only."""
    last = views[-1]
    return [*views[:-1], _with(last, last.corners.xy, last.corners.ids < last.spec.columns - 1)]


def _twice(views: list[BoardView], rng: np.random.Generator) -> list[BoardView]:
    return [*views, *(replace(view, step_id=f"{view.step_id} again") for view in views)]


def _first(views: list[BoardView], rng: np.random.Generator) -> list[BoardView]:
    return views[:1]


def _run(
    scene: Sight, change: Change = _same, start: Geometry = _START, prior: Prior | None = None, parallel: int = 1
) -> Outcome:
    """Fit a scene; the errors are those of the lens and the mounting that the fit frees."""
    rng = np.random.default_rng(8)
    views = change(scene.views(rng, parallel), rng)
    result = fit_boards(GeometryData(tuple(views), start, scene.size, prior))
    if not result.ok:
        return outcome(result)
    truth = _truth(scene)
    z = [(e.value - truth[e.name]) / e.sigma for e in result.estimates if e.sigma > 0]
    return outcome(result, np.array(z))


def _truth(scene: Sight) -> dict[str, float]:
    camera = scene.camera
    names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "tilt_deg", "roll_deg", "yaw_deg")
    angles = (scene.tilt_deg, *MOUNTED_DEG)
    return dict(zip(names, (*camera.focal_px, *camera.principal_point_px, *camera.distortion, *angles), strict=True))


def _drawn_from_prior(**options: float | int | bool) -> Sight:
    """Draw a lens from the prior: only then are the error bars right where the data do not determine the lens."""
    rng = np.random.default_rng(12)
    focal = 870.0 + _FOCAL_SIGMA_PX * rng.standard_normal(2)
    centre = np.array([511.5, 383.5]) + _CENTRE_SIGMA_PX * rng.standard_normal(2)
    bend = _BEND + _BEND_SIGMA * rng.standard_normal(5)
    return sight(focal_px=(focal[0], focal[1]), centre_px=(centre[0], centre[1]), distortion=bend, **options)


def _from_wrong(part: float) -> Callable[[], Outcome]:
    """The start's focal length and centre wrong by that part."""
    start = replace(
        _START, focal_px=_START.focal_px * (1 + part), principal_point_px=_START.principal_point_px * (1 - part)
    )
    return lambda: _run(sight(), start=start)


def off_by(factor: float) -> Outcome:
    """The start's focal length off by a factor."""
    return _run(sight(), start=replace(_START, focal_px=_START.focal_px * factor))


def _at_standoff(standoff_mm: float) -> Callable[[], Outcome]:
    return lambda: _run(sight(), start=replace(_START, pupil_mm=np.array([600.0, 190.0, -standoff_mm])))


def _tilted(tilt_deg: float) -> Callable[[], Outcome]:
    return lambda: _run(sight(tilt_deg=tilt_deg))


_EXTREMES: tuple[tuple[str, Callable[[], Outcome]], ...] = (
    *((f"tilt {tilt:.0f} degrees", _tilted(tilt)) for tilt in (0.0, 30.0, 60.0)),
    *((f"pupil {gap:g} mm behind the panel", _at_standoff(gap)) for gap in (0.0, 100.0)),
    *((f"start {part:+.0%} wrong", _from_wrong(part)) for part in (-0.2, 0.2, 2.0)),
    ("a single board view", lambda: _run(sight(), _first)),
    ("a single board view, with the rig's description", lambda: _run(_drawn_from_prior(), _first, prior=_PRIOR)),
    ("three views", lambda: _run(sight(views=3))),
    ("all boards parallel", lambda: _run(sight(lean_rad=0.0, tilt_deg=0.0))),
    (
        "all boards parallel, with the rig's description",
        lambda: _run(_drawn_from_prior(lean_rad=0.0, tilt_deg=0.0), prior=_PRIOR),
    ),
    ("corners in one quadrant", lambda: _run(sight(quadrant=True, distance_mm=(1500.0, 2500.0)))),
    ("boards 30 m away", lambda: _run(sight(distance_mm=(25000.0, 30000.0)))),
    ("boards nearer than they are wide", lambda: _run(sight(distance_mm=(330.0, 420.0)))),
    ("a tenth of the corners anywhere, one view out of order", lambda: _run(sight(), _huge_outliers)),
    ("every view twice, to the last digit", lambda: _run(sight(), _twice)),
    ("a view of corners on one line", lambda: _run(sight(), _one_line)),
    ("a tenth of the corners not a number", lambda: _run(sight(), _nan_corners)),
    ("corners to 1 px", lambda: _run(sight(sigma_px=1.0))),
    ("corners without noise of their own", lambda: _run(sight(sigma_px=0.0))),
    ("no distortion", lambda: _run(sight(distortion=np.zeros(5)))),
    ("distortion of a third", lambda: _run(sight(distortion=np.array([-0.35, 0.15, 1e-3, -1e-3, -0.03])))),
)
CASES = [Case("geometry", name, run) for name, run in _EXTREMES]
