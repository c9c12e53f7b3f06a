"""One psf field of given orders: fields, places, light and priors together, by Gauss and Newton's method.

Weights come from the model's own light (shot noise is that of the expectation, not of the sample), clipped samples
bring what a clipped normal tells, and every round the priors' precisions are set anew.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import log_ndtr

from udccal.fitting.iteration_log import LOG
from udccal.fitting.psf_stamps.blocks import Blocks
from udccal.fitting.psf_stamps.data import Plane
from udccal.fitting.psf_stamps.field import PlaneField, see
from udccal.fitting.psf_stamps.normal import Normal, Posterior, Weighted, border_maps, normal_equations, solve
from udccal.fitting.psf_stamps.prior import Envelope, Precisions, image_prior, log_det, update, updated_image
from udccal.models.fields import polynomial_terms

_DRAWS = 16
_HALVINGS = 6
# Converged when the next step would gain less than this in log likelihood, and the evidence changes less than that.
_GAIN, _EVIDENCE = 0.3, 1.0


@dataclass(frozen=True)
class Scene:
    """What does not change during a fit.

    Attributes:
        planes: samples by colour. unit: positions scaled to about [-1, 1].
        read_e, clip_e: of the samples' noise.
    """

    planes: tuple[Plane, ...]
    unit: Float[np.ndarray, "stars 2"]
    read_e: float
    clip_e: float


@dataclass(frozen=True)
class State:
    """Where a fit has come to.

    Attributes:
        fields: by colour. centre_px: of the stars, from their middle samples. flux_e: by star and colour.
        precisions, envelopes: of the priors, by colour.
        keep: samples that are not outliers, by colour.
        model_error: relative error of the model that is allowed for beside the noise, while it is still coarse.
    """

    fields: tuple[PlaneField, ...]
    centre_px: Float[np.ndarray, "stars 2"]
    flux_e: Float[np.ndarray, "stars planes"]
    precisions: tuple[Precisions, ...]
    envelopes: tuple[Envelope, ...]
    keep: tuple[Bool[np.ndarray, "stars _samples"], ...]
    model_error: float = 0.0


@dataclass(frozen=True)
class Solved:
    """A state, the posterior about it, and how likely the orders are."""

    state: State
    posterior: Posterior
    evidence: float
    log_likelihood: float
    converged: bool
    rounds: int


def expectation(scene: Scene, state: State, plane: int) -> tuple[Weighted, Float[np.ndarray, "stars samples"]]:
    """One colour's samples under the model, and their log likelihood.

    Shot noise and read noise r together are those of y + r^2 ~ Poisson(m + r^2) (Snyder et al., J. Opt. Soc. Am. A 10,
    1993), whose score (y - m) / (m + r^2) asks for nothing but the variance.
    """
    data, field = scene.planes[plane], state.fields[plane]
    seen = [np.asarray(part) for part in see(field, scene.unit, state.centre_px, data.offset_px)]
    value, slopes, first, down, across, inside = seen
    light = state.flux_e[:, plane, None]
    mean = light * value
    read = scene.read_e**2
    variance = np.maximum(mean, 0.0) + read  # expected light below zero has no shot noise
    known = data.usable & state.keep[plane] & inside
    below = np.where(mean < 0, mean * data.value_e - 0.5 * mean**2, 0.0) / read
    plain = (data.value_e + read) * np.log(variance / read) - np.maximum(mean, 0.0) + below
    if state.model_error:
        variance = variance + (state.model_error * np.abs(mean)) ** 2
    sigma = np.sqrt(variance)
    score, told = _clipped(np.where(data.clipped, (scene.clip_e - mean) / sigma, 0.0))
    residual = np.where(data.clipped, sigma * score / told, data.value_e - mean)
    weight = np.where(data.clipped, told, 1.0) / variance
    surely = log_ndtr(np.where(data.clipped, (mean - scene.clip_e) / sigma, 0.0))
    likelihood = np.where(known, np.where(data.clipped, surely, plain), 0.0)
    tap = (light[..., None] * down)[..., :, None] * across[..., None, :]
    own = np.concatenate([mean[..., None], light[..., None] * slopes], axis=2)
    parts = (np.where(known, residual, 0.0), np.where(known, weight, 0.0))
    return Weighted(first, tap.reshape(*mean.shape, -1), own, *parts, mean), likelihood


def _clipped(z: Float[np.ndarray, "*n"]) -> tuple[Float[np.ndarray, "*n"], Float[np.ndarray, "*n"]]:
    """Score and information of a unit normal's mean where it is known only to lie above z."""
    hazard = np.exp(-0.5 * z**2 - 0.5 * np.log(2 * np.pi) - log_ndtr(-z))
    return hazard, np.maximum(hazard * (hazard - z), 1e-12)


def merit(scene: Scene, state: State, like: tuple[Weighted, ...]) -> float:
    """Log posterior but for constants, with the variances that samples had before."""
    total = quadratic(state)
    for plane, (data, before) in enumerate(zip(scene.planes, like, strict=True)):
        value = np.asarray(see(state.fields[plane], scene.unit, state.centre_px, data.offset_px).value)
        # Clipped samples too: their working residuals and weights are those of the step to be judged.
        left = before.residual + before.mean - state.flux_e[:, plane, None] * value
        total -= 0.5 * float((before.weight * left**2).sum())
    return total


def improve(scene: Scene, state: State, rounds: int, seed: int = 0) -> Solved:
    """Rounds of steps and of the priors' precisions, until neither changes or there were so many."""
    before, number = -np.inf, 0
    while True:
        number += 1
        # The same draws in every round, so that rounds come to an end.
        solved, gain = step(scene, state, np.random.default_rng(seed))
        LOG.debug("psf field: round %d, evidence %.2f, gain %.3g", number, solved.evidence, gain)
        done = gain < _GAIN and abs(solved.evidence - before) < _EVIDENCE
        if done or number >= rounds:
            return replace(solved, converged=done, rounds=number)
        state, before = solved.state, solved.evidence
        del solved  # its factors are the largest arrays of a fit: not two of them at a time


def step(scene: Scene, state: State, rng: np.random.Generator) -> tuple[Solved, float]:
    """One step; and by how much it was expected to raise the log posterior."""
    maps = border_maps(state.fields, scene.unit)
    seen = [expectation(scene, state, p) for p in range(len(scene.planes))]
    normals = tuple(
        with_prior(normal_equations(f, scene.unit, w, m), f, e, q)
        for f, (w, _), m, e, q in zip(state.fields, seen, maps, state.envelopes, state.precisions, strict=True)
    )
    prior, pull = border_prior(state, np.sum([n.border.diagonal() for n in normals], axis=0))
    posterior = solve(normals, prior, pull)
    likelihood = float(sum(part.sum() for _, part in seen))
    gain = 0.5 * float(
        sum(n.right_nodes @ x for n, x in zip(normals, posterior.nodes, strict=True))
        + (pull + sum(n.right_border for n in normals)) @ posterior.border
    )
    evidence = likelihood + log_prior(state) - 0.5 * posterior.log_det + gain
    moved = _moved(scene, state, posterior, tuple(w for w, _ in seen))
    return Solved(retuned(moved, posterior, rng), posterior, evidence, likelihood, False, 1), gain


def with_prior(normal: Normal, field: PlaneField, env: Envelope, precisions: Precisions) -> Normal:
    """The prior of the images added."""
    terms = len(field.nodes)
    blocks = normal.nodes
    count, n = blocks.diagonal.shape[:2]
    per = n // terms
    diagonal = blocks.diagonal.reshape(count, per, terms, per, terms)
    below = blocks.below.reshape(count - 1, per, terms, per, terms)
    right = normal.right_nodes.reshape(-1, terms).copy()
    index = np.arange(per)
    for term, own, rough in image_prior(env, precisions.image):
        diagonal[:, :, term, :, term] += rough * env.roughness.diagonal
        below[:, :, term, :, term] += rough * env.roughness.below
        diagonal[:, index, term, index, term] += own.reshape(count, per)
        right[:, term] -= own * field.nodes[term].ravel() + rough * _times(env.roughness, field.nodes[term].ravel())
    return replace(normal, nodes=Blocks(blocks.diagonal, blocks.below), right_nodes=right.ravel())


def _times(matrix: Blocks, vector: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    x = vector.reshape(len(matrix.diagonal), -1)
    out = np.einsum("bij,bj->bi", matrix.diagonal, x)
    out[1:] += np.einsum("bij,bj->bi", matrix.below, x[:-1])
    out[:-1] += np.einsum("bji,bj->bi", matrix.below, x[1:])
    return out.ravel()


def border_prior(
    state: State, size: Float[np.ndarray, " border"]
) -> tuple[Float[np.ndarray, "border border"], Float[np.ndarray, " border"]]:
    """Precision of the border and its pull; what images could do as well (all light, all places) is held."""
    stars, planes = state.flux_e.shape
    own = np.zeros(len(size))
    values = np.zeros(len(size))
    start = stars * (2 + planes)
    for field, precisions in zip(state.fields, state.precisions, strict=True):
        for numbers, per_degree in ((field.warp, precisions.warp), (field.lateral, precisions.lateral)):
            flat = np.asarray(numbers).ravel()
            own[start : start + len(flat)] = by_degree(per_degree, flat.size)
            values[start : start + len(flat)] = flat
            start += len(flat)
    held = np.zeros((2 + planes, len(size)))
    for j in range(2 + planes):
        index = j + (2 + planes) * np.arange(stars)
        # Stars that are left out altogether stay where they are.
        own[index] = np.where(size[index] > 0, 0.0, 1.0)
        held[j, index] = np.sqrt(size[index].mean()) * (size[index] > 0)
    return np.diag(own) + held.T @ held, -own * values


def by_degree(precisions: Float[np.ndarray, " degrees"], size: int) -> Float[np.ndarray, " size"]:
    """Precisions of coefficients, from those of their degrees."""
    terms = [degree for degree in range(1, len(precisions) + 1) for _ in range(degree + 1)]
    return np.repeat(precisions[np.array(terms, dtype=int) - 1], size // max(len(terms), 1))


def quadratic(state: State) -> float:
    """Log prior of the unknowns but for what depends on the precisions alone."""
    total = 0.0
    for field, env, precisions in zip(state.fields, state.envelopes, state.precisions, strict=True):
        nodes = np.asarray(field.nodes)
        degree = [d for d in range(field.image_degree + 1) for _ in range(d + 1)]
        a, b = precisions.image[degree].T
        total += float(a @ env.scaled(nodes) + b @ env.rough(nodes))
        for numbers, own in ((field.warp, precisions.warp), (field.lateral, precisions.lateral)):
            flat = np.asarray(numbers).ravel()
            total += float(by_degree(own, flat.size) @ flat**2)
    return -0.5 * total


def log_prior(state: State) -> float:
    """Log prior; constants that all orders share are left out."""
    total = quadratic(state)
    for field, env, precisions in zip(state.fields, state.envelopes, state.precisions, strict=True):
        total += 0.5 * log_det(env, precisions.image)
        for numbers, own in ((field.warp, precisions.warp), (field.lateral, precisions.lateral)):
            total += 0.5 * float(np.log(by_degree(own, np.size(numbers))).sum())
    return total


def _moved(scene: Scene, state: State, posterior: Posterior, seen: tuple[Weighted, ...]) -> State:
    """The state after the step, or after as large a part of it as makes the posterior likelier."""
    before = merit(scene, state, seen)
    for halving in range(_HALVINGS):
        share = 0.5**halving
        moved = shifted(state, [share * x for x in posterior.nodes], share * posterior.border)
        if merit(scene, moved, seen) >= before - 1e-9 * abs(before):
            return moved
    return state


def shifted(state: State, nodes: list[Float[np.ndarray, "_n"]], border: Float[np.ndarray, " border"]) -> State:
    """The state with changes added."""
    stars, planes = state.flux_e.shape
    own = border[: stars * (2 + planes)].reshape(stars, 2 + planes)
    start = own.size
    fields = []
    for field, change in zip(state.fields, nodes, strict=True):
        terms, rows, columns = field.nodes.shape
        warp, lateral = np.size(field.warp), np.size(field.lateral)
        fields.append(
            replace(
                field,
                nodes=field.nodes + change.reshape(rows, columns, terms).transpose(2, 0, 1),
                warp=field.warp + border[start : start + warp].reshape(-1, 2, 2),
                lateral=field.lateral + border[start + warp : start + warp + lateral].reshape(-1, 2),
            )
        )
        start += warp + lateral
    return replace(
        state,
        fields=tuple(fields),
        centre_px=state.centre_px + own[:, :2],
        flux_e=state.flux_e * np.exp(own[:, 2:]),
    )


def retuned(state: State, posterior: Posterior, rng: np.random.Generator) -> State:
    """The precisions set anew, given draws of the posterior."""
    nodes, border = posterior.draws(rng, _DRAWS)
    stars, planes = state.flux_e.shape
    start = stars * (2 + planes)
    out = []
    for field, env, precisions, drawn in zip(state.fields, state.envelopes, state.precisions, nodes, strict=True):
        terms, rows, columns = field.nodes.shape
        images = drawn.T.reshape(-1, rows, columns, terms).transpose(0, 3, 1, 2)
        image = updated_image(env, precisions.image, np.asarray(field.nodes), images)
        tuned = []
        for numbers, own in ((field.warp, precisions.warp), (field.lateral, precisions.lateral)):
            size = np.size(numbers)
            tuned.append(_updated_degrees(own, np.asarray(numbers).ravel(), border[start : start + size]))
            start += size
        out.append(Precisions(image, *tuned))
    return replace(state, precisions=tuple(out))


def _updated_degrees(
    precisions: Float[np.ndarray, " degrees"], values: Float[np.ndarray, " n"], draws: Float[np.ndarray, "n draws"]
) -> Float[np.ndarray, " degrees"]:
    out = precisions.copy()
    per_term = len(values) // max(polynomial_terms(len(precisions)) - 1, 1)
    start = 0
    for degree in range(1, len(precisions) + 1):
        own = slice(start, start + (degree + 1) * per_term)
        start = own.stop
        expected = (degree + 1) * per_term / precisions[degree - 1]
        left = float((draws[own] ** 2).mean(axis=1).sum())
        out[degree - 1] = update(precisions[degree - 1], expected, left, float((values[own] ** 2).sum()))
    return out
