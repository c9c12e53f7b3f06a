"""psf: the numbers of diffraction, and the kernel at field points, against the Cramér–Rao bound.

Truths are drawn from the fit's prior, pictures have shot and read noise. The fit has the pictures and samples that the
default effort chooses of the eight shifts of each position; efficiency is of these, and "of all data" of all samples of
all pictures. (Of many positions, the default effort uses a part, too.) The pitch is held by the fit and has the rig's
tolerance as its sigma, so it has no efficiency and is left out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from tests.benchmarks.efficiency.trials import Trials
from tests.benchmarks.psf_kernels import kernel_and_slopes, light_and_slopes
from tests.scenes.psf import Picture, Scene, pictures, shots_of, small_scene
from udccal.effort import FitEffort
from udccal.fitting.engine.gaussian import Prior, cramer_rao, scaled_inverse
from udccal.fitting.psf.data import PsfRules, Shots
from udccal.fitting.psf.diffraction import fit_diffraction
from udccal.fitting.psf.kernel import WAVELENGTHS_NM, Evaluator, fit_lattice
from udccal.fitting.psf.problem import DiffractionProblem, kernel_of
from udccal.fitting.psf.samples import Samples, gather
from udccal.fitting.psf.start import choose_samples, start_model, start_prior
from udccal.numerics import in_float64
from udccal.rig import load_rig

_REALISATIONS = 100
_ITERATIONS = 60
# By name: index among the fit's global parameters.
_NUMBERS = {
    "column_open": 1,
    "row_open": 2,
    "depth_mm": 3,
    "pupil_diameter_mm": 4,
    "log_blur": 5,
    "blur_growth_radial": 6,
    "blur_growth_tangential": 7,
    "blur_red": 8,
    "blur_blue": 9,
    "depth_ratio": 10,
}
POINTS_PX = np.array([[350.0, 260.0], [700.0, 480.0]])
WINDOW = (17, 9)
# For differences, forward and backward.
_MOVE_PX = 1e-3
# (row, column) of the green kernel: peak, beside it, and on the series of orders.
SAMPLES = ((8, 4), (8, 5), (7, 4), (5, 4), (2, 4))


@dataclass(frozen=True)
class _Outcome:
    """Errors, sigmas and bounds of all parameters, then of all kernel samples relative to the peak."""

    error: Float[np.ndarray, " quantities"]
    sigma: Float[np.ndarray, " quantities"]
    bound: Float[np.ndarray, " quantities"]
    bound_of_all: Float[np.ndarray, " quantities"]


def trials(share: float) -> list[Trials]:
    """All realisations, by quantity."""
    scene = small_scene(positions=(3, 1), shifts=load_rig("lg55-aca2040").captures.psf_shifts, half=(14, 7))
    prior = start_prior(scene.rig, start_model(scene.rig, scene.geometry, scene.wire))
    outcomes = [_realisation(scene, prior, seed) for seed in range(max(round(_REALISATIONS * share), 3))]
    names = ("error", "sigma", "bound", "bound_of_all")
    error, sigma, bound, whole = (np.stack([getattr(o, name) for o in outcomes]) for name in names)

    def trials_of(name: str, of: slice) -> Trials:
        return Trials(f"psf/{name}", error[:, of], sigma[:, of], bound[:, of], bound_of_all=whole[:, of])

    numbers = [trials_of(name, slice(i, i + 1)) for i, name in enumerate(_NUMBERS)]
    return [*numbers, trials_of("kernel at field points", slice(len(_NUMBERS), None))]


@in_float64
def _realisation(scene: Scene, prior: Prior, seed: int) -> _Outcome:
    rng = np.random.default_rng(seed)
    cov = np.linalg.inv(prior.precision)
    theta = prior.mean + np.linalg.cholesky(cov) @ rng.standard_normal(len(cov))
    made = pictures(scene, theta, rng)
    start = start_model(scene.rig, scene.geometry, scene.wire)
    rules = replace(FitEffort().psf, close_px=scene.half, iterations=_ITERATIONS)
    shots = shots_of(scene, made, rng)
    chosen = _chosen_shots(shots, rules)
    fit = fit_diffraction(shots.pick(chosen), scene.geometry, start, prior, rules)
    evaluator = fit.problem.evaluator
    used = [picture for picture, one in zip(made, chosen, strict=True) if one]
    information = _information(scene, prior, theta, used, rules)
    of_all = _information(scene, prior, theta, made, replace(rules, far_fraction=1.0))
    true, slopes = _at_points(scene, evaluator, theta)
    found, fitted_slopes = _at_points(scene, evaluator, fit.theta)
    pick = np.array(list(_NUMBERS.values()))
    every = np.concatenate([np.eye(theta.size)[pick], slopes])
    stated = np.concatenate([np.eye(theta.size)[pick], fitted_slopes])
    return _Outcome(
        error=np.concatenate([(fit.theta - theta)[pick], found - true]),
        sigma=np.sqrt(np.einsum("qi,ij,qj->q", stated, fit.noise_cov, stated)),
        bound=cramer_rao(information, every),
        bound_of_all=cramer_rao(of_all, every),
    )


def _chosen_shots(shots: Shots, rules: PsfRules) -> Bool[np.ndarray, " shots"]:
    """``some_shots`` of positions of which none is held out: there are few here."""
    order = np.array([np.sum(shots.position[:k] == place) for k, place in enumerate(shots.position)])
    last = int(order.max())
    return np.isin(order, np.unique(np.linspace(0, last, rules.shifts).round().astype(int)))


def _at_points(
    scene: Scene, evaluator: Evaluator, theta: Float[np.ndarray, " p"]
) -> tuple[Float[np.ndarray, " samples"], Float[np.ndarray, "samples p"]]:
    """Samples of the green kernel relative to its peak, at all field points, and their slopes."""
    values, slopes = [], []
    for point in POINTS_PX:
        kernel, by = (np.asarray(part) for part in kernel_and_slopes(evaluator, theta, scene.geometry, point, *WINDOW))
        peak, peak_slope = kernel[1, 8, 4], by[:, 1, 8, 4]
        for row, column in SAMPLES[1:]:
            ratio = kernel[1, row, column] / peak
            values.append(ratio)
            slopes.append((by[:, 1, row, column] - ratio * peak_slope) / peak)
    return np.array(values), np.stack(slopes)


def _information(
    scene: Scene, prior: Prior, theta: Float[np.ndarray, " p"], made: list[Picture], rules: PsfRules
) -> Float[np.ndarray, "p p"]:
    """Return the information on the global parameters, with the prior's; each shot's own parameters are eliminated.

    Of the samples that ``rules`` choose.

    The light is Poisson distributed: its variance adds no information about the mean.
    """
    shots = shots_of(scene, made, np.random.default_rng(0))
    true = np.stack([picture.source_px for picture in made])
    shots = replace(shots, centre_px=true)
    evaluator = Evaluator(WAVELENGTHS_NM, fit_lattice(scene.half), True)
    total = prior.precision
    chosen = gather(shots, scene.geometry, choose_samples(shots, rules))
    problem = DiffractionProblem(chosen, evaluator, prior).with_overlaps(theta)
    kernels = [kernel_of(evaluator, theta, one) for one in problem.samples.each()]
    for position, kernel in enumerate(kernels):
        one = problem.samples.at(position)
        flux = np.stack([made[i].flux for i in one.index])
        by_global, by_local, light = _slopes(evaluator, theta, one, kernel, flux)
        weight = 1.0 / one.sensor_variance(light)
        own = np.einsum("snk,sn,snl->skl", by_local, weight, by_local)
        cross = np.einsum("snp,sn,snl->psl", by_global, weight, by_local)
        both = np.einsum("snp,sn,snq->pq", by_global, weight, by_global)
        total = total + both - np.einsum("psl,slm,qsm->pq", cross, scaled_inverse(own, 1e-14), cross)
    return total


def _slopes(
    evaluator: Evaluator,
    theta: Float[np.ndarray, " p"],
    one: Samples,
    kernel: Float[np.ndarray, "y x 3"],
    flux: Float[np.ndarray, "shots 3"],
) -> tuple[Float[np.ndarray, "shots n p"], Float[np.ndarray, "shots n l"], Float[np.ndarray, "shots n"]]:
    """Slopes of a position's samples by global parameters and by each shot's own, and the light of the samples."""
    shape = np.shape(one.rate)
    colour = np.asarray(one.colour)
    points = np.asarray(one.points).reshape(-1, 2)
    unit, by_theta = (
        np.asarray(part)
        for part in light_and_slopes(evaluator, theta, one.frame, points, np.ravel(one.density), one.disc_px)
    )
    light = np.einsum("snc,sc->sn", colour, flux)
    own = np.einsum("snc,snc->sn", unit.reshape(*shape, 3), colour)
    by_global = np.einsum("psnc,snc,sn->snp", by_theta.reshape(-1, *shape, 3), colour, light)
    moves = [
        one.unit_light(kernel, np.zeros((shape[0], 2)) + move)
        for move in _MOVE_PX * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
    ]
    by_move = np.stack([moves[0] - moves[1], moves[2] - moves[3]], axis=-1) / (2 * _MOVE_PX)
    moved = by_move * light[..., None]
    by_local = [moved, own[..., None] * colour, np.ones((*shape, 1))]
    return by_global, np.concatenate(by_local, axis=-1), own * light
