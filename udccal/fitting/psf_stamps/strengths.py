"""Strengths of images: how stars correct those that a search found, and what they leave open.

A search takes strengths from noisy residuals, and fits hold them. Given the images, each star tells its own strengths,
with its place and light taken up, and polynomials make of these what they are elsewhere: most is left open at the
field's edge. What is in step with a strength that is there, nodes take up.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.linalg import cholesky, solve_triangular

from udccal.fitting.psf_stamps.data import Stamps, StampsRules
from udccal.fitting.psf_stamps.field import degree_of, polynomials
from udccal.fitting.psf_stamps.model_error import by_star
from udccal.fitting.psf_stamps.probability import State, expectation
from udccal.models.fields import polynomial_terms


@dataclass(frozen=True)
class _Free:
    """What stars tell of strengths' free parts; unknowns are numbered by free part, then by image from the second on.

    Attributes:
        parts: polynomials of the free parts, which are orthonormal at the stars.
        precision, score: second and first derivatives of the log likelihood.
        least: precision of the widest prior: all free parts together are as large as a strength.
    """

    parts: Float[np.ndarray, "terms free"]
    precision: Float[np.ndarray, "unknowns unknowns"]
    score: Float[np.ndarray, " unknowns"]
    least: float

    def mix(self, unknowns: Float[np.ndarray, "unknowns *k"]) -> Float[np.ndarray, "further terms *k"]:
        """Return the polynomials' coefficients of unknowns."""
        return np.einsum("pf,ft...->tp...", self.parts, unknowns.reshape(self.parts.shape[1], -1, *unknowns.shape[1:]))


def settled(stamps: Stamps, state: State) -> State:
    """Return the state with the likeliest strengths, under a prior whose width has the most evidence.

    Polynomials that the field does not need would only extrapolate the stars' noise to its edge. One degree more than
    the search allows may be needed there, and is part of what stars leave open.
    """
    wider = _with_degree(state)
    if (free := _free(stamps, wider)) is None:
        return state
    precisions, ways = np.linalg.eigh(free.precision)
    precisions, score = np.maximum(precisions, 0.0), ways.T @ free.score
    # The narrowest one holds strengths where they are, to a part in ten thousand.
    priors = free.least * 4.0 ** np.arange(14)[:, None]
    evidence = (np.log(priors / (precisions + priors)) + score**2 / (precisions + priors)).sum(axis=1)
    best = float(priors[np.argmax(evidence), 0])
    mix = np.array(wider.field.mix)
    mix[1:] += free.mix(ways @ (score / (precisions + best)))
    return replace(wider, field=replace(wider.field, mix=mix), strength_precision=best)


def _with_degree(state: State) -> State:
    """Return the state with room for one more degree in the strengths."""
    terms = state.field.mix.shape[1]
    more = polynomial_terms(degree_of(terms) + 1) - terms
    return replace(state, field=replace(state.field, mix=np.pad(state.field.mix, ((0, 0), (0, more)))))


def drawn_strengths(stamps: Stamps, state: State, rules: StampsRules) -> Float[np.ndarray, "coefficients k"]:
    """Draw what stars leave open of strengths, in the order of ``Changes.mix``, by the prior that settled them."""
    count = rules.draws[1]
    out = np.zeros((*np.shape(state.field.mix), count))
    if (free := _free(stamps, state)) is not None:
        prior = max(free.least, state.strength_precision / rules.strength_doubt)
        precision = free.precision + prior * np.eye(len(free.precision))
        normal = np.random.default_rng(2).standard_normal((len(precision), count))
        out[1:] = free.mix(solve_triangular(cholesky(precision, lower=True), normal, lower=True, trans=1))
    return out.reshape(-1, count)


def _free(stamps: Stamps, state: State) -> _Free | None:
    """Return what stars tell of strengths; None where there is one image, or no polynomial is free."""
    field, terms = state.field, state.field.mix.shape[1]
    every, have = polynomials(stamps.unit, degree_of(terms)), field.strengths(stamps.unit)
    (taken, root), further = np.linalg.qr(have), have.shape[1] - 1
    inside = taken.T @ every
    _, size, ways = np.linalg.svd(every - taken @ inside, full_matrices=False)
    ways = ways[size > 1e-6].T / size[size > 1e-6]
    parts = ways - np.transpose(field.mix) @ np.linalg.solve(root, inside @ ways)
    if not (further and parts.size):
        return None
    at_stars, (known, pull), unknowns = every @ parts, _of_stars(stamps, state), parts.shape[1] * further
    precision = np.einsum("sf,sg,stu->ftgu", at_stars, at_stars, known).reshape(unknowns, unknowns)
    return _Free(parts, precision, (at_stars.T @ pull).ravel(), parts.shape[1] / len(have))


def _of_stars(
    stamps: Stamps, state: State
) -> tuple[Float[np.ndarray, "stars further further"], Float[np.ndarray, "stars further"]]:
    """Return each star's information on the strengths of images other than the first, and its score."""
    seen, mix = expectation(stamps, state), np.asarray(state.field.mix)
    root = np.sqrt(seen.weight)[..., None]
    by_strength = np.zeros((*seen.weight.shape, len(mix) - 1))
    for image in range(1, len(mix)):
        # Light is linear in strengths, and the first polynomial is 1.
        more = mix.copy()
        more[image, 0] += 1.0
        there = replace(state, field=replace(state.field, mix=more))
        by_strength[..., image - 1] = expectation(stamps, there).mean_e - seen.mean_e
    by_strength *= root
    taken = np.linalg.qr(root * by_star(stamps, state, seen))[0]
    by_strength -= taken @ (taken.transpose(0, 2, 1) @ by_strength)
    of_stars = by_strength.transpose(0, 2, 1)
    return of_stars @ by_strength, (of_stars @ (root * seen.residual[..., None]))[..., 0]
