"""psf_field, ours: stamps to a psf field through the public API, and the same from Bayer mosaics.

    python ours_psf_field.py --peers DIR [--seed 0] [--stars 60]

Prints a line of JSON for each, as the peers' scripts do. The first run, with compilation, is apart.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np

import udccal
from udccal.fitting.psf_stamps.data import Stamps, mosaic_channels
from udccal.fitting.psf_stamps.fit import fit_psf_stamps
from udccal.fitting.psf_stamps.term import StampsPsf
from udccal.result import FitResult

# Of red, green and blue: how much wider than green, light, and lateral colour at the field's edge (px).
SCALES, LIGHT, LATERAL_PX = (1.12, 1.0, 0.9), (0.6, 1.0, 0.7), (0.25, 0.0, -0.2)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--peers", type=Path, required=True, help="folder of works.py")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--stars", type=int, default=60)
    parser.add_argument("--reps", type=int, default=2, help="timed runs after the first")
    options = parser.parse_args()
    sys.path.insert(0, str(options.peers))
    import works

    mono(works, options)
    bayer(works, options)


def mono(works: ModuleType, options: argparse.Namespace) -> None:
    data = works.psf_field_data(options.seed, options.stars)
    stamps = Stamps(data["stamps"], data["ipos"], data["read"])
    test = data["test"]
    result, prediction, first, seconds = timed(works, lambda: answer(stamps, test, 0), options.reps)
    z = z_scores(result.term, test, 0, lambda x, y, dx, dy: works.psf_field_true(x, y, dx, dy))
    report(works, "udccal-stamps", result, first, seconds, z, works.psf_field_metrics(prediction, test))


def bayer(works: ModuleType, options: argparse.Namespace) -> None:
    stamps, test = mosaics(works, options.seed, options.stars)
    result, _, first, seconds = timed(works, lambda: answer(stamps, test, 1), options.reps)
    errors = {}
    for plane, colour in enumerate("rgb"):
        prediction = result.term.predict(test, plane)
        found = aligned(works, prediction, test, SCALES[plane])
        errors |= {f"err_median_{colour}": np.median(found), f"err_p95_{colour}": np.percentile(found, 95)}
    z = z_scores(result.term, test, 1, lambda x, y, dx, dy: scaled(works, x, y, SCALES[1], dx, dy))
    report(works, "udccal-stamps-bayer", result, first, seconds, z, errors)


def answer(stamps: Stamps, test: np.ndarray, plane: int) -> tuple[FitResult[StampsPsf], np.ndarray]:
    result = fit_psf_stamps(stamps)
    return result, result.term.predict(test, plane)


def timed(
    works: ModuleType, run: Callable[[], tuple[FitResult[StampsPsf], np.ndarray]], reps: int
) -> tuple[FitResult[StampsPsf], np.ndarray, float, float]:
    begun = time.perf_counter()
    result, prediction = run()
    first = time.perf_counter() - begun
    (result, prediction), seconds, _ = works.timed(run, reps)
    return result, prediction, first, seconds


def report(
    works: ModuleType, name: str, result: FitResult[StampsPsf], first: float, seconds: float, z: np.ndarray, found: dict
) -> None:
    chosen = next(candidate.name for candidate in result.candidates if candidate.chosen)
    works.emit(
        "psf_field", name, udccal.__version__, seconds, first_run_s=first, status=result.status.name, order=chosen,
        predicted=result.estimate("kernel_relative_l2").value, chi2_dof=result.chi2_dof, z_mean=z.mean(), z_std=z.std(),
        **found,
    )  # fmt: skip


def scaled(works: ModuleType, x: float, y: float, scale: float, dx: float = 0.0, dy: float = 0.0) -> np.ndarray:
    """The work's psf, wider by a factor: every sample asks for its own shift."""
    v, u = np.mgrid[: works.PSF_N, : works.PSF_N] - works.PSF_N // 2
    return works.psf_field_true(x, y, u - (u - dx) / scale, v - (v - dy) / scale) / scale**2


def mosaics(works: ModuleType, seed: int, stars: int) -> tuple[Stamps, np.ndarray]:
    """The work's stars through an RGGB mosaic: psfs of three widths, light by colour, lateral colour."""
    data = works.psf_field_data(seed, stars)
    rng = np.random.Generator(np.random.PCG64([313, seed]))
    channel = mosaic_channels("RGGB", data["ipos"], works.PSF_N, works.PSF_N)
    values = np.empty(channel.shape)
    for k, (x, y) in enumerate(data["pos"]):
        off = (data["pos"][k] / [works.W, works.H] - 0.5) * 2
        for plane in range(3):
            dx, dy = data["shift"][k] + LATERAL_PX[plane] * off
            light = LIGHT[plane] * data["flux"][k] * scaled(works, x, y, SCALES[plane], dx, dy)
            values[k][channel[k] == plane] = rng.poisson(light)[channel[k] == plane]
    values += data["read"] * rng.standard_normal(values.shape)
    return Stamps(values, data["ipos"], data["read"], channel=channel), data["test"]


def aligned(works: ModuleType, prediction: np.ndarray, test: np.ndarray, scale: float) -> np.ndarray:
    """Relative L2 error after the best shift and amplitude, as the work's own metric has it."""
    return np.array(
        [best_fit(kernel, lambda dx, dy, p=p: scaled(works, *p, scale, dx, dy))[1]
         for kernel, p in zip(prediction, test, strict=True)]
    )  # fmt: skip


def best_fit(kernel: np.ndarray, truth: Callable[[float, float], np.ndarray]) -> tuple[np.ndarray, float]:
    """The shift of the truth that fits a kernel best, and the relative L2 error that is left."""
    shift, h = np.zeros(2), 1e-3
    for _ in range(6):
        at = truth(*shift)
        slopes = [((truth(*(shift + h * e)) - at) / h).ravel() for e in np.eye(2)]
        design = np.stack([*slopes, -kernel.ravel()], axis=1)
        shift = shift + np.clip(np.linalg.lstsq(design, -at.ravel(), rcond=None)[0][:2], -0.4, 0.4)
    at = truth(*shift)
    amplitude = (kernel * at).sum() / (kernel * kernel).sum()
    return shift, float(np.linalg.norm(amplitude * kernel - at) / np.linalg.norm(at))


def z_scores(
    term: StampsPsf, test: np.ndarray, plane: int, truth: Callable[[float, float, float, float], np.ndarray]
) -> np.ndarray:
    """Errors of every pixel in units of sigma; the truth in the term's own convention."""
    errors = []
    for (x, y), kernel in zip(test, term.predict(test, plane), strict=True):
        errors.append(kernel - centred(term, lambda dx, dy, x=x, y=y: truth(x, y, dx, dy)))
    return np.array(errors) / term.sigma(test, plane)


def centred(term: StampsPsf, truth: Callable[[float, float], np.ndarray]) -> np.ndarray:
    """A true kernel that sums to 1 and whose centroid under the term's Gaussian vanishes."""
    v, u = np.mgrid[: term.rows, : term.columns] - np.array([term.rows // 2, term.columns // 2])[:, None, None]
    weight = np.exp(-0.5 * (u**2 + v**2) / term.window_px**2)
    shift = np.zeros(2)
    for _ in range(50):
        light = weight * truth(*shift)
        shift = shift - 1.5 * np.array([(u * light).sum(), (v * light).sum()]) / light.sum()
    kernel = truth(*shift)
    return kernel / kernel.sum()


if __name__ == "__main__":
    main()
