"""What a fit of stamps answers: kernels with their draws, estimates, and what is to be known of the fit itself."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.linalg import cho_solve

from udccal.fitting.psf_stamps.data import Stamps
from udccal.fitting.psf_stamps.likelihood import Weighted, expectation
from udccal.fitting.psf_stamps.log_prior import by_degree
from udccal.fitting.psf_stamps.outliers import listed
from udccal.fitting.psf_stamps.select import Selected
from udccal.fitting.psf_stamps.solve import Solved
from udccal.fitting.psf_stamps.start import reference
from udccal.fitting.psf_stamps.state import Scene, State
from udccal.fitting.psf_stamps.term import Draws, StampsPsf
from udccal.result import Diagnostic, Estimate, FitResult, FitStatus

_DRAWS = 192
# Reduced chi2: beyond the first, sigmas grow with it; beyond the second, this is no psf field.
_UNEXPLAINED, _POOR = 1.05, 2.0
_WINDOW_PX = 1.5  # of centroids, before the kernel's size is known


@dataclass(frozen=True)
class Verdict:
    """How a fit ended, and what to do about it; an empty note where nothing is to be done."""

    status: FitStatus
    note: str


def report(
    scene: Scene,
    stamps: Stamps,
    chosen: Selected,
    box: tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]],
    rng: np.random.Generator,
    bad: Verdict | None,
) -> FitResult[StampsPsf]:
    """The result of the fit ``chosen`` of stamps.

    Args:
        scene: the stamps' samples.
        stamps: as they were given.
        chosen: the fit.
        box: middle and half size of the field that stamps cover, in px.
        rng: for the draws that stand for the posterior.
        bad: what stood in the way of a fit, if anything.
    """
    solved = chosen.solved
    draws = _draws(solved, rng)
    parts = [expectation(scene, solved.state, plane)[0] for plane in range(len(scene.planes))]
    chi2 = float(sum((part.weight * part.residual**2).sum() for part in parts))
    samples = int(sum((part.weight > 0).sum() for part in parts))
    told = _told(scene, solved.state, draws, parts)
    chi2_dof = chi2 / max(samples - told, 1.0)
    term = _term(scene, stamps, solved, draws, box, float(np.sqrt(chi2_dof)) if chi2_dof > _UNEXPLAINED else 1.0)
    error = term.relative_l2(stamps.position_px.astype(np.float64), term.reference)
    size, spread = np.sqrt((error**2).mean(axis=0))
    maps, cov = _maps(solved, term.inflation)
    full = np.zeros((1 + len(maps), 1 + len(maps)))
    full[0, 0], full[1:, 1:] = spread**2, cov
    verdict = bad or _verdict(solved, chi2_dof)
    return FitResult(
        name="psf",
        term=term,
        status=verdict.status,
        estimates=(Estimate("kernel_relative_l2", float(size), float(spread), "1"), *maps),
        cov=full,
        chi2_dof=chi2_dof,
        samples=samples,
        candidates=chosen.candidates,
        diagnostics=_diagnostics(solved, told, term, parts, scene),
        notes=(verdict.note,) if verdict.note else (),
        outliers=listed(scene, solved.state),
    )


def _verdict(solved: Solved, chi2_dof: float) -> Verdict:
    if chi2_dof > _POOR:
        return Verdict(FitStatus.POOR_FIT, "Check the noise given, and that each stamp holds one point source.")
    if not solved.converged:
        return Verdict(
            FitStatus.NOT_CONVERGED, f"It was left after {solved.rounds} rounds; use more or brighter stamps."
        )
    return Verdict(FitStatus.CONVERGED, "")


def _draws(solved: Solved, rng: np.random.Generator) -> Draws:
    nodes, border = solved.posterior.draws(rng, _DRAWS)
    stars, planes = solved.state.flux_e.shape
    start, warp, lateral = solved.state.maps_from, [], []
    own = border[:start].reshape(stars, 2 + planes, -1)
    for field in solved.state.fields:
        middle = start + np.size(field.warp)
        end = middle + np.size(field.lateral)
        warp.append(border[start:middle])
        lateral.append(border[middle:end])
        start = end
    images = tuple(
        drawn.reshape(-1, len(field.nodes), drawn.shape[1]).transpose(1, 0, 2)
        for field, drawn in zip(solved.state.fields, nodes, strict=True)
    )
    return Draws(images, tuple(warp), tuple(lateral), own[:, :2], own[:, 2:])


def _told(scene: Scene, state: State, draws: Draws, parts: list[Weighted]) -> float:
    """How many numbers the data tell: all unknowns less what the priors hold of them."""
    held = 0.0
    for plane, (field, env, own) in enumerate(zip(state.fields, state.envelopes, state.precisions, strict=True)):
        degree = [d for d in range(field.image_degree + 1) for _ in range(d + 1)]
        a, b = own.image[degree].T
        terms, rows, columns = field.nodes.shape
        images = draws.nodes[plane].transpose(2, 0, 1).reshape(-1, terms, rows, columns)
        held += float((env.scaled(images) @ a + env.rough(images) @ b).mean())
        for drawn, precisions in ((draws.warp[plane], own.warp), (draws.lateral[plane], own.lateral)):
            held += float((by_degree(precisions, len(drawn)) @ drawn**2).mean())
    unknowns = sum(np.size(f.nodes) + np.size(f.warp) + np.size(f.lateral) for f in state.fields)
    # All light and all places together are held, not told.
    stars = state.centre_px.size + state.flux_e.size - 2 - len(scene.planes)
    return unknowns + stars - held


def _term(
    scene: Scene,
    stamps: Stamps,
    solved: Solved,
    draws: Draws,
    box: tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]],
    inflation: float,
) -> StampsPsf:
    _, rows, columns = stamps.values_e.shape
    first = reference(len(scene.planes))
    term = StampsPsf(
        fields=solved.state.fields,
        draws=draws,
        centre_px=box[0],
        half_px=box[1],
        rows=rows,
        columns=columns,
        window_px=_WINDOW_PX,
        reference=first,
        star_px=stamps.position_px.astype(np.float64),
        star_place_px=solved.state.centre_px,
        star_light_e=solved.state.flux_e,
        inflation=inflation,
    )
    # A Gaussian as wide as the kernel, by its noise-equivalent area of 4 pi sigma^2.
    kernel = term.predict(box[0][None], first)
    return replace(term, window_px=float(1 / np.sqrt(4 * np.pi * (kernel**2).sum())))


def _maps(solved: Solved, inflation: float) -> tuple[tuple[Estimate, ...], Float[np.ndarray, "n n"]]:
    """Coefficients of the maps, named by colour, element and degrees in x and y."""
    planes, start = len(solved.state.fields), solved.state.maps_from
    names, index, values = [], [], []
    for plane, field in enumerate(solved.state.fields):
        powers = [(i, d - i) for d in range(1, field.warp_degree + 1) for i in range(d, -1, -1)]
        prefix = "map" if planes == 1 else f"map_{'rgb'[plane]}"
        names += [f"{prefix}_{e}_{i}{j}" for i, j in powers for e in ("xx", "xy", "yx", "yy")]
        index.append(start + np.arange(np.size(field.warp)))
        values.append(np.asarray(field.warp).ravel())
        start += np.size(field.warp) + np.size(field.lateral)
    own = np.concatenate(index)
    columns = np.zeros((len(solved.posterior.root), len(own)))
    columns[own, np.arange(len(own))] = 1.0
    cov = inflation**2 * cho_solve((solved.posterior.root, True), columns)[own]
    pairs = zip(names, np.concatenate(values), np.sqrt(np.diag(cov)), strict=True)
    return tuple(Estimate(n, float(v), float(s), "1") for n, v, s in pairs), cov


def _diagnostics(
    solved: Solved, told: float, term: StampsPsf, parts: list[Weighted], scene: Scene
) -> tuple[Diagnostic, ...]:
    left = int(sum((plane.usable & k).sum() for plane, k in zip(scene.planes, solved.state.keep, strict=True)))
    beyond = left - int(sum((part.weight > 0).sum() for part in parts))
    return (
        Diagnostic("rounds", float(solved.rounds), "1"),
        Diagnostic("numbers_told_by_data", told, "1"),
        Diagnostic("log_evidence", solved.evidence, "1"),
        Diagnostic("clipped_samples", float(sum(plane.clipped.sum() for plane in scene.planes)), "1"),
        Diagnostic("samples_beyond_the_image", float(beyond), "1"),
        Diagnostic("centroid_window", term.window_px, "px"),
        Diagnostic("sigma_inflation", term.inflation, "1"),
    )
