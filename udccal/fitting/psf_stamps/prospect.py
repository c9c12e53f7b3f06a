"""How much likelier maps of higher degrees would make the data, told from one step instead of a fit for each.

To second order, what the data say of coefficients that stand at zero is a Gaussian; with a prior of precision L it
raises the evidence by h' (Q + L)^-1 h / 2 - log |1 + L^-1 Q| / 2, where Q is the information that all other unknowns
leave and h the slope of the log likelihood. The precisions that raise it most follow without another look at the data.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.linalg import cho_solve

from udccal.fitting.psf_stamps.likelihood import look
from udccal.fitting.psf_stamps.log_prior import by_degree
from udccal.fitting.psf_stamps.orders import orders_of, with_degrees
from udccal.fitting.psf_stamps.prior import update
from udccal.fitting.psf_stamps.solve import Solved, step
from udccal.fitting.psf_stamps.state import Scene, State

_ROUNDS = 30


@dataclass(frozen=True)
class _New:
    """Coefficients that stand at zero.

    Attributes:
        index: in the border. degree, colour: of the coefficient.
        precision: of the prior. information, slope: Q and h.
    """

    index: Int[np.ndarray, " new"]
    degree: Int[np.ndarray, " new"]
    colour: Int[np.ndarray, " new"]
    precision: Float[np.ndarray, " new"]
    information: Float[np.ndarray, "new new"]
    slope: Float[np.ndarray, " new"]


def map_gains(scene: Scene, state: State, highest: int) -> tuple[float, ...]:
    """By how much the log evidence would rise with maps of each degree above the state's, up to ``highest``.

    Args:
        scene: the samples.
        state: the likeliest of its own degrees.
        highest: degree that is asked for.

    Raises:
        numpy.linalg.LinAlgError: when the equations are singular.
    """
    own = orders_of(state)
    wider = with_degrees(state, highest, own.image)
    solved, _ = step(scene, wider, look(scene, wider), np.random.default_rng(0))
    new = _new(wider, solved, own.warp)
    return tuple(_gain(new, new.degree <= degree) for degree in range(own.warp + 1, highest + 1))


def _new(state: State, solved: Solved, known: int) -> _New:
    """Coefficients of maps above the degree ``known``, after a step from ``state``."""
    start = state.maps_from
    index, degrees, colour, precision = [], [], [], []
    for plane, (field, own) in enumerate(zip(state.fields, state.precisions, strict=True)):
        size = np.size(field.warp)
        degree = by_degree(np.arange(1.0, field.warp_degree + 1), size).astype(int)
        new = np.flatnonzero(degree > known)
        index.append(start + new)
        degrees.append(degree[new])
        colour.append(np.full(len(new), plane))
        precision.append(by_degree(own.warp, size)[new])
        start += size + np.size(field.lateral)
    every, prior = np.concatenate(index), np.concatenate(precision)
    columns = np.zeros((len(solved.posterior.root), len(every)))
    columns[every, np.arange(len(every))] = 1.0
    told = np.linalg.inv(cho_solve((solved.posterior.root, True), columns)[every])
    slope = told @ solved.posterior.border[every]
    return _New(every, np.concatenate(degrees), np.concatenate(colour), prior, told - np.diag(prior), slope)


def _gain(new: _New, among: Bool[np.ndarray, " new"]) -> float:
    """With the likeliest precisions, one by degree and colour, of those ``among``; the others are held at zero."""
    information, slope = new.information[np.ix_(among, among)], new.slope[among]
    precision = new.precision[among]
    degree, colour = new.degree[among], new.colour[among]
    groups = [(degree == d) & (colour == c) for d in np.unique(degree) for c in np.unique(colour)]
    for _ in range(_ROUNDS):
        cov = np.linalg.inv(information + np.diag(precision))
        left, found = np.diag(cov), (cov @ slope) ** 2
        for own in groups:
            expected = float((1 / precision[own]).sum())
            precision[own] = update(precision[own][0], expected, float(left[own].sum()), float(found[own].sum()))
    told = information + np.diag(precision)
    volume = np.linalg.slogdet(told)[1] - np.log(precision).sum()
    return 0.5 * float(slope @ np.linalg.solve(told, slope) - volume)
