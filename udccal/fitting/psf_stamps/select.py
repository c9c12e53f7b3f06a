"""Which orders a psf field needs: tried from a middle one, a degree at a time, by how likely each makes the data.

The criterion is -2 log of the marginal likelihood (fields, places and light integrated out by Laplace's method), plus
the logarithm of the number of samples for each precision that was tuned (Schwarz, "Estimating the dimension of a
model", Annals of Statistics 6, 1978).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve_triangular

from udccal.fitting.psf_stamps.data import Stamps
from udccal.fitting.psf_stamps.orders import Orders, orders_of, with_degrees, with_envelopes, with_spacing
from udccal.fitting.psf_stamps.outliers import without_outliers
from udccal.fitting.psf_stamps.prospect import map_gains
from udccal.fitting.psf_stamps.solve import Solved, improve
from udccal.fitting.psf_stamps.start import start
from udccal.fitting.psf_stamps.state import Scene, State
from udccal.models.fields import polynomial_terms
from udccal.result import Candidate

SPACINGS_PX = (1.0, 0.75, 0.5)
# The error of cubic splines falls with the fourth power of their spacing, what it costs in likelihood with the eighth:
# nodes are made denser again only where this share of the last gain would still be worth it.
_LEFT_OF_GAIN, _WORTH = (SPACINGS_PX[1] / SPACINGS_PX[0]) ** 8, 200.0
_HIGHEST_MAP, _HIGHEST_IMAGE = 4, 3
_ROUNDS_TO_JUDGE, _ROUNDS_TO_END = 3, 12
# Two rounds show whether a degree that comes new appears; one whose loss is beyond doubt needs no fit without it.
_ROUNDS_FOR_NEW, _BEYOND_DOUBT = 2, 200.0
# Maps are fitted where they would bring at least this share of what they cost.
_FAR_BELOW = 0.5


@dataclass(frozen=True)
class Selected:
    """The orders chosen, the fit of these, and what else was tried."""

    solved: Solved
    candidates: tuple[Candidate, ...]


@dataclass(frozen=True)
class _Trial:
    """Orders that were tried; the fit itself, which is large, is kept of the best alone."""

    orders: Orders
    numbers: int
    criterion: float


def select(scene: Scene, stamps: Stamps, orders: Orders | None) -> Selected:
    """Find the orders, unless they are given, and fit."""
    state = coarse(scene, stamps, orders)
    shape = stamps.values_e.shape[1:]
    if orders is not None:
        spaced = with_spacing(state, orders.spacing_px, shape, scene.unit)
        best = improve(scene, with_degrees(spaced, orders.warp, orders.image), _ROUNDS_TO_END)
        best = improve(scene, without_outliers(scene, best.state), _ROUNDS_TO_END, best.evidence)
        return Selected(best, _table(scene, best, []))
    best, tried = _degrees(scene, state)
    gain = np.inf
    for spacing in SPACINGS_PX[1:]:
        if gain * _LEFT_OF_GAIN < _WORTH:
            break
        finer = without_outliers(scene, with_spacing(best.state, spacing, shape, scene.unit))
        found = improve(scene, finer, _ROUNDS_TO_JUDGE)
        tried.append(_trial(scene, found))
        gain = criterion(scene, best) - tried[-1].criterion
        best = _slim(found) if gain > 0 else best
        del found
    best = improve(scene, without_outliers(scene, best.state), _ROUNDS_TO_END, best.evidence)
    return Selected(best, _table(scene, best, tried))


def coarse(scene: Scene, stamps: Stamps, orders: Orders | None) -> State:
    """Places, light and a first field; what the model cannot follow yet is allowed for as an error of its own."""
    most = highest(scene, orders)
    state = start(scene, stamps)
    for warp, image, allowed in ((0, 0, 0.3), (0, 0, 0.1), (2, 0, 0.05), (2, 1, 0.02)):
        degrees = with_degrees(state, min(warp, most.warp), min(image, most.image))
        state = replace(degrees, model_error=allowed)
        state = with_envelopes(improve(scene, without_outliers(scene, state) if warp else state, 2).state)
    state = with_spacing(state, SPACINGS_PX[0], stamps.values_e.shape[1:], scene.unit)
    return without_outliers(scene, replace(state, model_error=0.0))


def highest(scene: Scene, orders: Orders | None) -> Orders:
    """No more polynomials than half the stars."""
    if orders is not None:
        return orders
    stars = len(scene.unit)

    def most(limit: int) -> int:
        return max(d for d in range(limit + 1) if d == 0 or 2 * polynomial_terms(d) <= stars)

    return Orders(most(_HIGHEST_MAP), most(_HIGHEST_IMAGE), SPACINGS_PX[0])


def criterion(scene: Scene, solved: Solved) -> float:
    """Lower is better."""
    tuned = sum(p.image.size + p.warp.size + p.lateral.size for p in solved.state.precisions)
    return -2 * solved.evidence + tuned * _price(scene)


def _price(scene: Scene) -> float:
    """Of a precision that is tuned."""
    return float(np.log(sum(int(plane.usable.sum()) for plane in scene.planes)))


def _degrees(scene: Scene, state: State) -> tuple[Solved, list[_Trial]]:
    """The best degrees, going from neighbour to neighbour until none is better; and all that were tried."""
    most = highest(scene, None)
    best = _slim(improve(scene, state, _ROUNDS_TO_JUDGE + 1))
    tried = [_trial(scene, best)]
    while True:
        own, better = orders_of(best.state), best
        known = {(t.orders.warp, t.orders.image) for t in tried}
        near = [(own.warp + w, own.image + i) for w, i in ((0, -1), (-1, 0), (-2, 0), (1, 0), (2, 0), (0, 1))]
        pairs = [pair for pair in near if pair not in known and _within(pair, most)]
        widest = max((warp for warp, _ in pairs), default=own.warp)
        gains = map_gains(scene, best.state, widest) if widest > own.warp else ()
        for pair in pairs:
            found = _slim(_judged(scene, best, pair, gains))
            tried.append(_trial(scene, found))
            better = found if tried[-1].criterion < criterion(scene, better) else better
        if better is best:
            return best, tried
        best = better


def _slim(solved: Solved) -> Solved:
    """Without the factors of the nodes, the largest arrays of a fit: of a fit that is compared, none are asked for."""
    return replace(solved, posterior=replace(solved.posterior, colours=(), nodes=()))


def _within(pair: tuple[int, int], most: Orders) -> bool:
    return 0 <= pair[0] <= most.warp and 0 <= pair[1] <= most.image


def _judged(scene: Scene, best: Solved, pair: tuple[int, int], gains: tuple[float, ...]) -> Solved:
    """A fit of these degrees, left early where it is worse beyond doubt.

    Where maps that matter so much are left out, or maps are added that by far do not bring what they cost, what the
    curvature says of it takes the place of a fit.
    """
    own, state = orders_of(best.state), with_degrees(best.state, *pair)
    wider = pair[0] - own.warp
    change = gains[wider - 1] if wider > 0 else -_loss(best, pair[0])
    # Of the evidence, half the price of each precision is what counts against it.
    enough = _FAR_BELOW * 0.5 * _price(scene) * len(scene.planes) * wider if wider > 0 else -_BEYOND_DOUBT
    if change < enough:
        return replace(best, state=state, evidence=best.evidence + change, converged=False)
    rounds = _ROUNDS_FOR_NEW if sum(pair) > own.warp + own.image else _ROUNDS_TO_JUDGE
    return improve(scene, state, rounds, floor=best.evidence - _BEYOND_DOUBT)


def _loss(best: Solved, degree: int) -> float:
    """Of log posterior when all higher degrees of the maps are held at zero."""
    start = best.state.maps_from
    index, values = [], []
    for field in best.state.fields:
        flat = np.asarray(field.warp).ravel()
        dropped = np.arange(4 * (polynomial_terms(degree) - 1), len(flat))
        index.append(start + dropped)
        values.append(flat[dropped])
        start += len(flat) + np.size(field.lateral)
    own, value = np.concatenate(index), np.concatenate(values)
    if not own.size:
        return 0.0
    chosen = np.zeros((len(best.posterior.root), len(own)))
    chosen[own, np.arange(len(own))] = 1.0
    half = solve_triangular(best.posterior.root, chosen, lower=True)
    return 0.5 * float(value @ np.linalg.solve(half.T @ half, value))


def _trial(scene: Scene, solved: Solved) -> _Trial:
    return _Trial(orders_of(solved.state), _numbers(solved.state), criterion(scene, solved))


def _numbers(state: State) -> int:
    return sum(np.size(f.nodes) + np.size(f.warp) + np.size(f.lateral) for f in state.fields)


def _table(scene: Scene, chosen: Solved, tried: list[_Trial]) -> tuple[Candidate, ...]:
    """All candidates; the one chosen as it stands in the end."""
    last = _trial(scene, chosen)
    rows = [t for t in tried if t.orders != last.orders] + [last]
    return tuple(Candidate(t.orders.name, t.numbers, t.criterion, t is last) for t in rows)
