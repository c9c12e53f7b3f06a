"""More images for a field: how the residuals of a fit change with the position.

Coma, a ring that opens, or an order of diffraction that fades change a psf in a few ways, whatever the degree of the
polynomials that describe them. The most significant mixtures of all polynomials become strengths of new images; one
image for every polynomial would need several times as many nodes.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from udccal.fitting.psf_stamps.data import Stamps, StampsRules
from udccal.fitting.psf_stamps.field import polynomials, taps
from udccal.fitting.psf_stamps.probability import State, expectation
from udccal.models.fields import polynomial_terms


def with_more_images(stamps: Stamps, state: State, degree: int, rules: StampsRules) -> State:
    """Return the state with new images, which are zero; the same state where there is no room for more."""
    every, have = polynomials(stamps.unit, degree), state.field.strengths(stamps.unit)
    taken = np.linalg.qr(have)[0]
    free, left, _ = np.linalg.svd(every - taken @ (taken.T @ every), full_matrices=False)
    free = free[:, left > 1e-6]
    room = min(rules.images_at_once, rules.most_images - have.shape[1])
    if not free.size or room <= 0:
        return state
    score, information = _scores(stamps, state)
    # Of each polynomial and node: what residuals ask for, in units of its noise.
    z = (free.T @ score) / np.sqrt(np.maximum((free**2).T @ information, 1e-300))
    found, size, _ = np.linalg.svd(z, full_matrices=False)
    beyond = size**2 - np.median(size**2)
    count = int(np.clip((beyond > rules.image_beyond * beyond[0]).sum(), 1, room))
    strength = np.sqrt(len(free)) * free @ found[:, :count]
    old = np.zeros((have.shape[1], polynomial_terms(degree)))
    old[:, : state.field.mix.shape[1]] = state.field.mix
    return state.with_images(np.concatenate([old, np.linalg.lstsq(every, strength, rcond=None)[0].T]), rules)


def _scores(stamps: Stamps, state: State) -> tuple[Float[np.ndarray, "stars nodes"], Float[np.ndarray, "stars nodes"]]:
    """Return each star's derivatives of the log likelihood by the nodes of all colours, and their information."""
    seen, parts = expectation(stamps, state), []
    for own in stamps.by_plane:
        used = np.flatnonzero(seen.weight * own)
        onto, weight = taps(seen.seen, used, state.size.shape[1:]).T, seen.weight.ravel()[used]
        both = onto @ (weight * seen.residual.ravel()[used]), onto.power(2) @ weight
        parts.append([part.reshape(len(own), -1) for part in both])
    score, information = (np.concatenate(part, axis=1) for part in zip(*parts, strict=True))
    return score, information
