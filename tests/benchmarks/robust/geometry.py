"""Lenses, views and boards of every kind, with corners that are missing, far off, or of another picture."""

from __future__ import annotations

import functools

import numpy as np

from tests.benchmarks.efficiency.geometry import corners_seen
from tests.benchmarks.robust.family import Answer, Case, Family, Number, of_result
from tests.fitting.geometry.boards import Sight, sight
from tests.scenes.information import fisher_information
from udccal.board.charuco import board_points_mm
from udccal.fitting.engine.gaussian import cramer_rao
from udccal.fitting.geometry.bundle import LENS, Intrinsics
from udccal.fitting.geometry.fit import fit_geometry
from udccal.numerics import in_float64

_UNSEEN_PX2 = 1e12


def draw(seed: int) -> Case:
    """A lens and views of one board."""
    rng = np.random.default_rng([seed, 19])
    focal = float(np.exp(rng.uniform(np.log(450.0), np.log(2500.0))))
    # Wide lenses bend more; tangential terms and the sixth order are small or absent.
    wide = min(1.0, 900.0 / focal)
    bend = np.array([rng.uniform(-0.3, 0.1), rng.uniform(-0.05, 0.12), *rng.uniform(-1e-3, 1e-3, 2), 0.0])
    bend = wide**2 * bend * np.array([1.0, wide**2 * rng.integers(0, 2), *[rng.integers(0, 2)] * 2, 0.0])
    views, lean, noise = int(rng.integers(3, 16)), float(rng.uniform(0.3, 0.8)), float(np.exp(rng.uniform(-4.6, -0.3)))
    missing, far = float(rng.choice([0.0, rng.uniform(0, 0.4)])), float(rng.choice([0.0, rng.uniform(0, 0.06)]))
    scene = sight(
        seed=seed,
        views=views,
        distortion=bend,
        focal_px=(focal, focal * float(rng.uniform(0.97, 1.03))),
        centre_px=(511.5 + float(rng.uniform(-40, 40)), 383.5 + float(rng.uniform(-40, 40))),
        distance_mm=(0.75 * focal, 1.4 * focal),
        lean_rad=lean,
        sigma_px=noise,
    )
    swapped = int(rng.choice([0, 0, 1])) if views >= 6 else 0
    what = f"f {focal:.0f}, k1 {bend[0]:.2f}, {views} views, lean {lean:.2f}, noise {noise:.2g} px"
    what += f", {missing:.0%} missing, {far:.1%} far off, {swapped} view out of order"
    return Case(what, functools.partial(answer, scene, seed, missing, far, swapped))


def corners(
    scene: Sight, seed: int, missing: float, far: float, swapped: int
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Board points and image points of each view; every other view as OpenCV gives them, (n, 1, 2)."""
    rng, points = np.random.default_rng([seed, 20]), board_points_mm(scene.spec)
    boards, images = [], []
    for view, exact in enumerate(scene.corners_px()):
        xy = exact + scene.sigma_px[view, :, None] * rng.standard_normal(exact.shape)
        wrong = rng.random(len(xy)) < far
        xy[wrong] = rng.uniform((0, 0), scene.size, (int(wrong.sum()), 2))
        seen = scene.seen()[view] & (rng.random(len(xy)) >= missing)
        if view >= len(scene.poses) - swapped:
            xy = xy[rng.permutation(len(xy))]
        # Corners that were not found are NaN in some programs, and left out in others.
        if view % 3 == 0:
            boards.append(points), images.append(np.where(seen[:, None], xy, np.nan))
        else:
            boards.append(points[seen]), images.append(xy[seen])
        if view % 2:
            images[-1] = images[-1][:, None, :]
    return boards, images


@in_float64
def answer(scene: Sight, seed: int, missing: float, far: float, swapped: int) -> Answer:
    """Of the fit of the lens, without a start and without the corners' sigma."""
    boards, images = corners(scene, seed, missing, far, swapped)
    result = fit_geometry(boards, images, scene.size)
    if not result.ok:
        return of_result(result, ())
    true = np.concatenate([scene.camera.focal_px, scene.camera.principal_point_px, scene.camera.distortion])
    least = _least(scene)
    return of_result(
        result,
        tuple(
            Number(one.name, one.value - value, one.sigma, bound)
            for one, value, bound in zip(result.estimates, true, least, strict=True)
        ),
    )


def _least(scene: Sight) -> np.ndarray:
    """The bound with all coefficients of distortion and every corner in the picture."""
    true = np.append(Intrinsics.of_geometry(scene.camera).vector, scene.poses.ravel())
    variance = np.repeat(np.where(scene.seen(), scene.sigma_px**2, _UNSEEN_PX2).ravel(), 2)
    information = fisher_information(corners_seen, true, board_points_mm(scene.spec), variance)
    return cramer_rao(information, np.eye(len(true))[:LENS])


FAMILY = Family("geometry", draw, most_refused=0.1)
