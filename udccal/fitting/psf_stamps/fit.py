"""Fit a psf field to stamps of point sources: orders, places and light found along with it, and true error bars.

The data are arrays: stamps in electrons, each about one source, of a sensor without colours or of a raw mosaic.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.linalg import cho_solve

from udccal.errors import FitError
from udccal.fitting.psf_stamps.data import Stamps, split
from udccal.fitting.psf_stamps.normal import Weighted
from udccal.fitting.psf_stamps.orders import Orders
from udccal.fitting.psf_stamps.outliers import OUTLIER_SIGMA, STAR_RATIO
from udccal.fitting.psf_stamps.select import SPACINGS_PX, Selected, select
from udccal.fitting.psf_stamps.solve import Scene, Solved, State, by_degree, expectation
from udccal.fitting.psf_stamps.start import reference
from udccal.fitting.psf_stamps.term import Draws, StampsPsf
from udccal.fitting.result import Diagnostic, Estimate, FitResult, FitStatus, Outliers
from udccal.numerics import in_float64

_DRAWS = 192
_FEWEST_STARS = 4
# Stars with an unclipped core, at least so many; light over noise in the median stamp, at least so much.
_FEWEST_UNCLIPPED, _CORE_PX, _LEAST_SNR = 3, 1.5, 10.0
# Reduced chi2: beyond the first, sigmas grow with it; beyond the second, this is no psf field.
_UNEXPLAINED, _POOR = 1.05, 2.0
_SHOWN = 8
_WINDOW_PX = 1.5  # of centroids, before the kernel's size is known


@in_float64
def fit_psf_stamps(stamps: Stamps, orders: Orders | None = None, seed: int = 0) -> FitResult[StampsPsf]:
    """The psf field of stamps.

    Args:
        stamps: of at least four point sources; checked when they were made.
        orders: degrees and spacing of nodes; found by the data when left out.
        seed: of the draws that stand for the posterior.

    Returns:
        A result whose term predicts kernels and their sigma anywhere in the field. Its estimates are the relative L2
        error to be expected at the stamps' positions, and the coefficients of the map.

    Raises:
        FitError: when there are fewer than four stamps.
    """
    if len(stamps.values_e) < _FEWEST_STARS:
        raise FitError(f"Expected at least {_FEWEST_STARS} stamps, found {len(stamps.values_e)}. Cut more of them.")
    scene, box = _scene(stamps)
    bad = _unusable(scene)
    lowest = Orders(0, 0, SPACINGS_PX[0])
    try:
        chosen = select(scene, stamps, orders if bad is None else lowest)
    except np.linalg.LinAlgError:
        bad = _Verdict(FitStatus.NOT_CONVERGED, "The equations were singular; what is given is one psf for all places.")
        chosen = select(scene, stamps, lowest)
    return _result(scene, stamps, chosen, box, np.random.default_rng(seed), bad)


@dataclass(frozen=True)
class _Verdict:
    status: FitStatus
    note: str


def _scene(stamps: Stamps) -> tuple[Scene, tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]]:
    """The samples by colour, and middle and half size of the field that the stamps cover."""
    low, high = stamps.position_px.min(axis=0), stamps.position_px.max(axis=0)
    middle, half = (low + high) / 2.0, np.maximum((high - low) / 2.0, 1.0)
    return Scene(split(stamps), (stamps.position_px - middle) / half, stamps.read_e, stamps.clip_e), (middle, half)


def _unusable(scene: Scene) -> _Verdict | None:
    """What stands in the way of a fit, if anything."""
    for plane in scene.planes:
        light = (plane.value_e * plane.usable).sum(axis=1)
        noise = np.sqrt(np.maximum(light, 0.0) + plane.usable.sum(axis=1) * scene.read_e**2)
        snr = float(np.median(light / np.maximum(noise, 1e-300)))
        if snr < _LEAST_SNR:
            note = f"Light over noise of a stamp is {snr:.1f} in the median; at least {_LEAST_SNR:.0f} are needed."
            return _Verdict(FitStatus.TOO_DARK, note)
        core = np.abs(plane.offset_px).max(axis=2) <= _CORE_PX
        clear = int((~(plane.clipped & core).any(axis=1) & (plane.usable & core).any(axis=1)).sum())
        if clear < _FEWEST_UNCLIPPED:
            note = f"{clear} stamps have a core that is not clipped or missing; {_FEWEST_UNCLIPPED} are needed."
            return _Verdict(FitStatus.SATURATED, note)
    return None


def _result(
    scene: Scene,
    stamps: Stamps,
    chosen: Selected,
    box: tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]],
    rng: np.random.Generator,
    bad: _Verdict | None,
) -> FitResult[StampsPsf]:
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
        term=term,
        status=verdict.status,
        estimates=(Estimate("kernel_relative_l2", float(size), float(spread), "1"), *maps),
        cov=full,
        chi2_dof=chi2_dof,
        samples=samples,
        candidates=chosen.candidates,
        diagnostics=_diagnostics(solved, told, term, parts, scene),
        notes=(verdict.note,) if verdict.note else (),
        outliers=_outliers(scene, solved.state),
    )


def _verdict(solved: Solved, chi2_dof: float) -> _Verdict:
    if chi2_dof > _POOR:
        return _Verdict(FitStatus.POOR_FIT, "Check the noise given, and that each stamp holds one point source.")
    if not solved.converged:
        return _Verdict(
            FitStatus.NOT_CONVERGED, f"It was left after {solved.rounds} rounds; use more or brighter stamps."
        )
    return _Verdict(FitStatus.CONVERGED, "")


def _draws(solved: Solved, rng: np.random.Generator) -> Draws:
    nodes, border = solved.posterior.draws(rng, _DRAWS)
    stars, planes = solved.state.flux_e.shape
    own = border[: stars * (2 + planes)].reshape(stars, 2 + planes, -1)
    start, warp, lateral = stars * (2 + planes), [], []
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
    stars, planes = solved.state.flux_e.shape
    start = stars * (2 + planes)
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


def _outliers(scene: Scene, state: State) -> tuple[Outliers, ...]:
    stars = [k for k in range(len(scene.unit)) if not any(keep[k].any() for keep in state.keep)]
    places = []
    for plane, keep in zip(scene.planes, state.keep, strict=True):
        for star, sample in np.argwhere(plane.usable & ~keep):
            if star not in stars:
                x, y = plane.offset_px[star, sample]
                places.append(f"stamp {star}, {x:+.0f} px, {y:+.0f} px from its middle")
    out = []
    if places:
        rule = f"samples off by more than {OUTLIER_SIGMA:g} sigma of their noise under the model"
        out.append(Outliers(rule, len(places), tuple(places[:_SHOWN])))
    if stars:
        rule = (
            f"stamps whose mean square is over {STAR_RATIO:g} times the median's, or a fifth of whose samples are off"
        )
        out.append(Outliers(rule, len(stars), tuple(f"stamp {k}" for k in stars[:_SHOWN])))
    return tuple(out)
