"""The priors' precisions set anew, from where a fit is and how sure it is of that."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from udccal.fitting.psf_stamps.posterior import Posterior
from udccal.fitting.psf_stamps.prior import Precisions, update, updated_image
from udccal.fitting.psf_stamps.state import State
from udccal.models.fields import polynomial_terms

_DRAWS = 16


def retuned(state: State, posterior: Posterior, rng: np.random.Generator) -> State:
    """The precisions set anew, given draws of the posterior."""
    nodes, border = posterior.draws(rng, _DRAWS)
    start = state.maps_from
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
