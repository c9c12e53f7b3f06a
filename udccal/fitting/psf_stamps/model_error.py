"""The model error of a psf field: what is neither noise nor uncertainty, in light per pixel at the nodes of its images.

A field that follows the psf too coarsely, or that follows noise, leaves small residuals at the stars that it was fitted
to. Stars that it was not fitted to show its errors in full. A lobe far from the middle may change over the field while
the core does not. The error is therefore measured twice: near each node, and at all nodes of similar light together,
which shows smaller errors. The larger one counts.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int

from udccal.fitting.engine.gaussian import scaled_inverse
from udccal.fitting.engine.misfit import SIGNIFICANT, chi2_tail
from udccal.fitting.engine.robust import MAD_TO_SIGMA
from udccal.fitting.psf_stamps.data import Stamps, StampsRules
from udccal.fitting.psf_stamps.equations import changes_of_samples, laplace
from udccal.fitting.psf_stamps.field import Changes
from udccal.fitting.psf_stamps.probability import State, Weighted, expectation, laplacian

_NEAR_PX = 2.0  # size of the squares whose nodes are near each other
_FACTOR = 4.0  # within which nodes are of similar light

Nodes = Float[np.ndarray, "planes grid_rows grid_columns"]
Some = Float[np.ndarray, " some"]


def of_residuals(stamps: Stamps, state: State) -> Nodes:
    """Return the model error that a fit's own residuals show in most stars."""
    seen = expectation(stamps, state.without_error())
    variance = np.divide(1.0, seen.weight, out=np.zeros_like(seen.weight), where=seen.weight > 0)
    return _shown(stamps, state, seen.residual**2, variance, 1.0, _typical)


def of_stars_left_out(stamps: Stamps, state: State, rules: StampsRules) -> tuple[Nodes, float]:
    """Return the model error that stars show which are left out of a fit, a part at a time, and how far they are off.

    Their squares are compared with noise and the uncertainty of the others' field, both less what a star's own place
    and light take up. The model error is zero where these explain the squares; the second number is ``_surely_off``.
    """
    rng = np.random.default_rng(0)
    part = rng.permutation(len(stamps.unit)) % rules.parts
    square, variance, light = np.zeros((3, *stamps.known.shape))
    for own in range(rules.parts):
        out = part == own
        found = laplace(stamps, replace(state, keep=state.keep & ~out[:, None]))
        draws = found.draws(rng, rules.draws[0])
        Changes.of(state.field, len(out), draws).stars[out] = 0.0
        there = placed(stamps, state.shifted(found.mode).without_error(), out)
        seen = expectation(stamps, there)
        root = np.sqrt(seen.weight)[..., None]
        change = root * changes_of_samples(stamps, there.field, seen, draws)
        taken = np.linalg.qr(root * by_star(stamps, there, seen))[0]
        change -= taken @ (taken.transpose(0, 2, 1) @ change)
        every = 1.0 - (taken**2).sum(axis=2) + (change**2).mean(axis=2)
        square[out] = (seen.residual**2)[out]
        light[out] = (seen.mean_e - np.take_along_axis(there.background_e, stamps.plane, axis=1))[out]
        np.divide(every, seen.weight, out=variance, where=(seen.weight > 0) & out[:, None])
    shown = _shown(stamps, state, square, variance, SIGNIFICANT, _larger)
    return shown, _surely_off(square, variance, light, (variance > 0) & ~stamps.clipped)


def _surely_off(
    square: Float[np.ndarray, "stars samples"],
    variance: Float[np.ndarray, "stars samples"],
    light: Float[np.ndarray, "stars samples"],
    used: Bool[np.ndarray, "stars samples"],
) -> float:
    """Return the least error of stars that were left out, relative to their L2 norm, by three sigma of its scatter.

    Root mean square over stars, whatever their place: in the model error, stars for which the others extrapolate have
    little weight.
    """
    excess, scatter, norm = (
        np.where(used, each, 0.0).sum(axis=1) for each in (square - variance, variance**2, light**2)
    )
    seen = norm > 0
    if not seen.any():
        return 0.0
    ratio, spread = excess[seen] / norm[seen], 2 * scatter[seen] / norm[seen] ** 2
    weight = 1.0 / (spread + np.median(spread))
    least = np.average(ratio, weights=weight) - 3 * np.sqrt((weight**2 * spread).sum()) / weight.sum()
    return float(np.sqrt(max(least, 0.0)))


def placed(stamps: Stamps, state: State, stars: Bool[np.ndarray, " stars"]) -> State:
    """Fit some stars' places, light and background again, with the field held."""
    planes = state.light_e.shape[1]
    for _ in range(4):
        seen = expectation(stamps, state)
        jacobian = by_star(stamps, state, seen)
        weighted = (jacobian * seen.weight[..., None]).transpose(0, 2, 1)
        step = (scaled_inverse(weighted @ jacobian) @ weighted @ seen.residual[..., None])[..., 0] * stars[:, None]
        centre, light, background = np.split(step, [2, 2 + planes], axis=1)
        state = replace(
            state,
            centre_px=state.centre_px + np.clip(centre, -0.5, 0.5),
            light_e=state.light_e * np.exp(np.clip(light, -0.5, 0.5)),
            background_e=state.background_e + background if state.lit else state.background_e,
        )
    return state


def by_star(stamps: Stamps, state: State, seen: Weighted) -> Float[np.ndarray, "stars samples own"]:
    """Return derivatives of samples by (x, y), light by colour, and background by colour where there is one."""
    own = np.moveaxis(stamps.by_plane, 0, 2)
    parts = [seen.seen.jacobian[..., 1:3], seen.seen.jacobian[..., :1] * own, *([own] if state.lit else [])]
    return np.concatenate(parts, axis=2)


def _shown(
    stamps: Stamps,
    state: State,
    square: Float[np.ndarray, "stars samples"],
    variance: Float[np.ndarray, "stars samples"],
    chance: float,
    excess_of: Callable[[Some, Some], float],
) -> Nodes:
    """Return the model error by which squares of residuals exceed their variances, where chance is less likely.

    Samples of zero variance are not used.
    """
    used = (variance > 0) & ~stamps.clipped
    node = expectation(stamps, state).node[used]
    # Squares of an error that is as large as the light nearby; the measured one is relative to it.
    unit = (np.take_along_axis(state.light_e, stamps.plane, axis=1)[used] * state.size.ravel()[node]) ** 2
    square, variance, found = square[used], variance[used], np.zeros(state.size.size)
    for groups in _groups(state):
        own = groups.ravel()[node]
        order = np.argsort(own, kind="stable")
        for index in np.split(order, np.flatnonzero(np.diff(own[order])) + 1):
            excess = excess_of(square[index] / unit[index], variance[index] / unit[index])
            if excess > 0 and chi2_tail(float((square[index] / variance[index]).sum()), index.size) <= chance:
                here = groups.ravel() == own[index[0]]
                found[here] = np.maximum(found[here], np.sqrt(excess))
    return state.size * found.reshape(state.size.shape)


def _typical(square: Some, variance: Some) -> float:
    """Return the excess of most squares over their variances, by medians: hits have little weight."""
    return float(MAD_TO_SIGMA**2 * np.median(square) - np.median(variance))


def _larger(square: Some, variance: Some) -> float:
    """Return the excess of most squares, or of all of them if that is larger: an error may be that of a few stars.

    The mean over all is a step of maximum likelihood from no excess: stars at the edge, for which the others
    extrapolate, have little weight.
    """
    return max(_typical(square, variance), float(np.average(square - variance, weights=variance**-2.0)))


def _groups(state: State) -> tuple[Int[np.ndarray, "planes grid_rows grid_columns"], ...]:
    """Return numbers of the nodes' groups, whose errors are measured together: by place, and by light."""
    planes, *grid = state.size.shape
    y, x = (np.rint((np.arange(n) - (n - 1) / 2) * state.field.spacing_px / _NEAR_PX).astype(int) for n in grid)
    light = np.log(state.size.max(axis=(1, 2), keepdims=True) / state.size) / np.log(_FACTOR)
    plane = np.arange(planes)[:, None, None] * 10**6
    return plane + 1000 * (y[:, None] - y[0]) + (x - x[0]), plane + light.astype(int)


def resized(stamps: Stamps, state: State, rules: StampsRules) -> State:
    """Return the state with a larger size E where nodes of similar light have larger squares than the prior expects.

    One smoothness serves all light: darkness is smoother, and faint rings and orders of diffraction are as sharp as the
    core, so that error bars of these would be too small.
    """
    draws, by_light = laplace(stamps, state).draws(np.random.default_rng(0), rules.draws[0]), _groups(state)[1]
    # What is there, and the part that the data leave open: 1 is expected of a node together.
    squares, size = (_of_first_images(state, each) for each in (state.vector[:, None], draws)), state.size.copy()
    for plane, (there, left) in enumerate(zip(*squares, strict=True)):
        group = by_light[plane].ravel() - by_light[plane].min()
        known = np.maximum(np.bincount(group, 1.0 - left), 0.0)
        ratio = np.maximum((1.0 + np.bincount(group, there)) / (1.0 + known), 1.0)
        size[plane] *= np.sqrt(ratio[group]).reshape(size[plane].shape)
    return replace(state, size=size)


def _of_first_images(state: State, vectors: Float[np.ndarray, "unknowns k"]) -> Float[np.ndarray, "planes nodes"]:
    """Return mean squares of the first images' nodes, in units of what the prior expects of each."""
    root, counts = state.roots
    ends = np.cumsum(counts)[: state.of_images.size].reshape(state.of_images.shape)[:, 0, 1]
    parts, nodes = [], state.size[0].size
    for end, precisions in zip(ends, state.of_images[:, 0], strict=True):
        squares = ((root[end - 2 * nodes : end] @ vectors) ** 2).mean(axis=1)
        parts.append(precisions @ squares.reshape(2, nodes))
    return np.stack(parts)


def widen(state: State, draws: Float[np.ndarray, "unknowns k"], doubt: float) -> None:
    """Let draws scatter more, in place, by a variance of ``doubt`` at nodes that the prior alone determines.

    One smoothness serves all nodes. A single ring, or an order of diffraction at the edge, may leave it by more than a
    Gaussian lets it, as light that is spread over a few nodes only has heavier tails. Where data tell, they decide.
    """
    left = np.clip(_of_first_images(state, draws), 0.0, 1.0).reshape(state.size.shape)
    Changes.of(state.field, len(state.light_e), draws).nodes[:, 0] *= np.sqrt(1.0 + doubt * left)[..., None]


def add_model_error(state: State, draws: Float[np.ndarray, "unknowns k"]) -> None:
    """Add what the model does not describe to draws, in place: noise of nodes that gives kernels its model error."""
    nodes, count = Changes.of(state.field, len(state.light_e), draws).nodes, draws.shape[1]
    # The mean sum of squared weights of a cubic B-spline is 0.479 along an axis.
    rng = np.random.default_rng(1)
    nodes[:, 0] += state.model_error[..., None] / 0.479 * rng.standard_normal((*state.size.shape, count))
    # Where further images have no nodes, they may be as large as their prior, which the others set, or change in step
    # with the light where they have nodes: a star's light and the field's are told apart by neither.
    eigenvalues, left = laplacian(*state.size.shape[1:])[1], ~np.moveaxis(state.kept, 2, 0)
    first, total = state.field.nodes[:, 0], np.asarray(state.field.nodes).sum(axis=(2, 3))
    for image in np.flatnonzero(left.any(axis=(1, 2))):
        a, b = state.of_images[:, image].T[..., None]
        spread = np.sqrt((1.0 / (a + b * eigenvalues)).mean(axis=1))[:, None, None] * state.size * left[image]
        nodes[:, image] += spread[..., None] / 0.479 * rng.standard_normal((*spread.shape, count))
        in_step = (total[:, image] / total[:, 0])[:, None, None] * first * left[image]
        nodes[:, image] += in_step[..., None] * rng.standard_normal(count)
