"""The priors of all unknowns together: in the normal equations, and as a log density."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from udccal.fitting.psf_stamps.field import PlaneField
from udccal.fitting.psf_stamps.normal import Normal
from udccal.fitting.psf_stamps.prior import Envelope, Precisions, image_prior, log_det
from udccal.fitting.psf_stamps.state import State
from udccal.fitting.psf_stamps.stencil import stencil_of


def with_prior(normal: Normal, field: PlaneField, env: Envelope, precisions: Precisions) -> Normal:
    """The prior of the images added; to ``normal.sums`` in place."""
    terms, rows, columns = field.nodes.shape
    rough = stencil_of(env.roughness, (rows, columns))
    right = normal.right_nodes.reshape(-1, terms).copy()
    for term, own, roughly in image_prior(env, precisions.image):
        diagonal = normal.sums[..., term, term]
        diagonal += roughly * rough
        diagonal[:, 0, :, rough.shape[3] // 2] += own.reshape(rows, columns)
        flat = np.ravel(field.nodes[term])
        right[:, term] -= own * flat + roughly * (env.roughness @ flat)
    return replace(normal, right_nodes=right.ravel())


def border_prior(
    state: State, size: Float[np.ndarray, " border"]
) -> tuple[Float[np.ndarray, "border border"], Float[np.ndarray, " border"]]:
    """Precision of the border and its pull; what images could do as well (all light, all places) is held."""
    stars, planes = state.flux_e.shape
    own = np.zeros(len(size))
    values = np.zeros(len(size))
    start = state.maps_from
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
