"""The work ``intrinsics`` of the peers' folder, through ``calibrate_views``. Prints one JSON line as the peers do.

    python -m tests.benchmarks.peers.ours_intrinsics --peers ../shared/peers --seeds 10 --starts 1000 --covered 200

``rot_rms`` is the pixel error over the field after the best common rotation, root mean square over the seeds, and
``predicted_rms`` its prediction by the covariances; ``projection_z_std`` compares the two place by place, over as many
seeds as ``--covered`` says: the places of one seed have the same noise, and ten seeds do not determine an error bar.
``seconds`` is the median of one calibration once compiled, ``first_run_s`` the very first with compilation.
"""

from __future__ import annotations

import argparse
import importlib
import sys
import time
from pathlib import Path
from types import ModuleType

import numpy as np

from udccal import __version__
from udccal.fitting.geometry.calibrated import CalibratedViews, Gauge
from udccal.fitting.geometry.data import gather
from udccal.fitting.geometry.views import calibrate_views
from udccal.models.geometry import Geometry
from udccal.result import FitStatus

Boards = tuple[list[np.ndarray], list[np.ndarray]]
# Starts: focal lengths wrong by up to this factor either way, the centre by this part of the width.
_FOCAL_FACTOR, _CENTRE_PART = 3.0, 0.2


def boards(works: ModuleType, seed: int) -> Boards:
    """The corners of each view that are inside the picture, on the board and in it."""
    data = works.intrinsics_data(seed)
    seen = [np.isfinite(view[..., 0]) for view in data["obs"]]
    return [data["board"][ok] for ok in seen], [view[ok] for view, ok in zip(data["obs"], seen, strict=True)]


def random_start(works: ModuleType, views: int, rng: np.random.Generator) -> tuple[Geometry, np.ndarray]:
    """Intrinsics far off, and poses that know nothing."""
    size = np.array([works.W, works.H], dtype=float)
    focal = works.INTR["fx"] * _FOCAL_FACTOR ** rng.uniform(-1, 1, 2)
    centre = (size - 1) / 2 + _CENTRE_PART * size[0] * rng.uniform(-1, 1, 2)
    bend = np.array([rng.uniform(-0.3, 0.3), rng.uniform(-0.3, 0.3), 0.0, 0.0, 0.0])
    turn = rng.normal(size=(views, 3))
    turn *= rng.uniform(0, np.pi, (views, 1)) / np.linalg.norm(turn, axis=1, keepdims=True)
    place = rng.uniform([-0.5, -0.5, 0.1], [0.5, 0.5, 3.0], (views, 3))
    return Geometry(focal, centre, bend, np.zeros(3), np.zeros(3)), np.hstack([turn, place])


def same(found: CalibratedViews, reference: CalibratedViews) -> bool:
    """Whether two calibrations are one minimum: within a hundredth of a sigma in everything."""
    sigma = np.sqrt(np.diag(reference.cov))[:9]
    told = sigma > 0
    off = np.abs(found.intrinsics.vector - reference.intrinsics.vector)
    return found.free == reference.free and bool((off[told] < 0.01 * sigma[told]).all())


def converged(works: ModuleType, data: list[Boards], references: list[CalibratedViews], starts: int) -> int:
    """Of so many random starts, those that lead to the calibration without a start."""
    rng, count = np.random.default_rng(0), 0
    for k in range(starts):
        board, image = data[k % len(data)]
        start, poses = random_start(works, len(board), rng)
        found = calibrate_views(gather(board, image), (works.W, works.H), start, start_poses=poses)
        count += found.status is FitStatus.CONVERGED and same(found, references[k % len(data)])
    return count


def aligned(works: ModuleType, intrinsics: np.ndarray) -> np.ndarray:
    """Errors in px over the works' grid after the best common rotation, as its metric has them."""
    pixels = works.intr_grid()
    rays, turn = works.unproject_true(pixels), np.zeros(3)
    for _ in range(5):
        at = works.rodrigues(turn)
        error = works.project(intrinsics, rays @ at.T) - pixels
        small = [works.rodrigues(1e-6 * axis) @ at for axis in np.eye(3)]
        slope = [((works.project(intrinsics, rays @ s.T) - pixels - error) / 1e-6).ravel() for s in small]
        turn = turn + np.linalg.lstsq(np.stack(slope, axis=1), -error.ravel(), rcond=None)[0]
    return works.project(intrinsics, rays @ works.rodrigues(turn).T) - pixels


def z_scores(works: ModuleType, result: CalibratedViews) -> np.ndarray:
    """Errors after the best common rotation in units of their sigma, (81, 2)."""
    cov = result.projection_covariance(works.intr_grid(), Gauge.ALIGNED)
    return aligned(works, result.intrinsics.vector) / np.sqrt(np.einsum("nii->ni", cov))


def spread(works: ModuleType, seeds: int) -> tuple[float, float]:
    """Root mean square of the z-scores over so many seeds, and its standard error."""
    size = (works.W, works.H)
    square = np.array(
        [(z_scores(works, calibrate_views(gather(*boards(works, seed)), size)) ** 2).mean() for seed in range(seeds)]
    )
    rms = float(np.sqrt(square.mean()))
    return rms, float(square.std(ddof=1) / np.sqrt(seeds) / (2 * rms))


def main() -> None:
    """Calibrate all seeds, then start from anywhere."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--peers", type=Path, required=True, help="folder that holds works.py")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--starts", type=int, default=0, help="random starts, spread over the seeds")
    parser.add_argument("--covered", type=int, default=10, help="seeds over which error bars are compared with errors")
    options = parser.parse_args()
    sys.path.insert(0, str(options.peers.resolve()))
    works = importlib.import_module("works")
    size = (works.W, works.H)
    data = [boards(works, seed) for seed in range(options.seeds)]
    begun = time.perf_counter()
    calibrate_views(gather(*data[0]), size)
    first = time.perf_counter() - begun
    results, seconds, sigmas = [], [], []
    for views in data:
        calibrate_views(gather(*views), size)  # other numbers of corners may be another padded size
        result, taken, _ = works.timed(lambda views=views: calibrate_views(gather(*views), size))
        results.append(result)
        seconds.append(taken)
        cov = result.projection_covariance(works.intr_grid(), Gauge.ALIGNED)
        sigmas.append(np.sqrt(np.einsum("nii->ni", cov)))
    metrics = [works.intrinsics_metrics(result.intrinsics.vector) for result in results]
    pooled = {key: float(np.sqrt(np.mean([m[key] ** 2 for m in metrics]))) for key in metrics[0]}
    z_std, z_std_error = spread(works, options.covered)
    found = converged(works, data, results, options.starts) if options.starts else None
    works.emit(
        "intrinsics",
        "udccal",
        __version__,
        float(np.median(seconds)),
        first_run_s=first,
        seeds=options.seeds,
        converged=sum(result.status is FitStatus.CONVERGED for result in results),
        orders=[next(c.name for c in result.candidates if c.chosen) for result in results],
        reproj_rms=[result.rms_px for result in results],
        predicted_rms=float(np.sqrt((np.square(sigmas).sum(axis=2)).mean())),
        projection_z_std=z_std,
        projection_z_std_error=z_std_error,
        covered=options.covered,
        starts=options.starts,
        starts_converged=found,
        uncertainty="projection covariance per pixel, in three gauges",
        **pooled,
    )


if __name__ == "__main__":
    main()
