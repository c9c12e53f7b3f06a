"""Which orders a psf field needs: tried from a middle one, a degree at a time, by how likely each makes the data.

The criterion is -2 log of the evidence (fields, places and light integrated out by Laplace's method), plus the
logarithm of the number of samples for each precision that was tuned (Schwarz, "Estimating the dimension of a model",
Annals of Statistics 6, 1978).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from udccal.fitting.engine.least_squares import Solution
from udccal.fitting.engine.orders import Attempt, Choice, choose
from udccal.fitting.psf_stamps.equations import marginal_cov
from udccal.fitting.psf_stamps.likelihood import Scene, State
from udccal.fitting.psf_stamps.orders import Orders, coarse, orders_of, with_degrees, with_spacing
from udccal.fitting.psf_stamps.prior import by_degree, updated
from udccal.fitting.psf_stamps.rules import StampsRules
from udccal.fitting.psf_stamps.solve import Evidence, Laplace, improve, without_outliers
from udccal.models.fields import polynomial_terms

Found = Solution[State, Laplace]
Tried = Attempt[Found]

# The error of cubic splines falls with the fourth power of their spacing, what it costs in likelihood with the eighth.
_ERROR_POWER = 8
_ROUNDS = 30


def search(scene: Scene, rules: StampsRules, orders: Orders | None) -> Choice[Found]:
    """The orders, found unless they are given, and their fit.

    Raises:
        numpy.linalg.LinAlgError: when the equations are singular.
    """
    most = orders or _highest(scene, rules)
    state, tried = coarse(scene, rules, most), []
    if orders is not None:
        state = with_degrees(with_spacing(scene, state, orders.spacing_px), orders.warp, orders.image, rules)
        state = improve(scene, state, rules, rules.steps_to_end).place
    else:
        tried = _spacings(scene, _degrees(scene, state, rules, most), rules)
        state = choose(tried).best.fit.place
    final = attempt(scene, improve(scene, without_outliers(scene, state, rules), rules, rules.steps_to_end))
    return Choice(final, (*(t for t in tried if t.name != final.name), final))


def attempt(scene: Scene, found: Found, more: float = 0.0) -> Tried:
    """With its criterion; ``more`` log evidence than the equations have."""
    state = found.place
    criterion = _price(scene) * sum(len(own.flat) for own in state.precisions) - 2 * (found.equations.evidence + more)
    return Attempt(orders_of(state).name, state.numbers, criterion, found)


def _price(scene: Scene) -> float:
    """Of a precision that is tuned."""
    return float(np.log(scene.samples))


def _highest(scene: Scene, rules: StampsRules) -> Orders:
    """No more polynomials than half the stars."""

    def most(limit: int) -> int:
        return max(d for d in range(limit + 1) if d == 0 or 2 * polynomial_terms(d) <= len(scene.unit))

    return Orders(most(rules.highest_map), most(rules.highest_image), rules.spacings_px[0])


def _degrees(scene: Scene, state: State, rules: StampsRules, most: Orders) -> list[Tried]:
    """All that were tried, going from neighbour to neighbour until none is better."""
    best = attempt(scene, improve(scene, state, rules, rules.steps_to_judge + 1))
    tried, known = [best], {orders_of(state)}
    while True:
        own = orders_of(best.fit.place)
        steps = ((0, -1), (-1, 0), (-2, 0), (1, 0), (2, 0), (0, 1))
        near = [Orders(own.warp + w, own.image + i, own.spacing_px) for w, i in steps]
        near = [o for o in near if o not in known and 0 <= o.warp <= most.warp and 0 <= o.image <= most.image]
        widest = max((o.warp for o in near), default=own.warp)
        gains = expected_gains(scene, best.fit.place, widest, rules) if widest > own.warp else ()
        tried += [_judged(scene, best, o, gains, rules) for o in near]
        known.update(near)
        if (better := choose(tried).best) is best:
            return tried
        best = better


def _judged(scene: Scene, best: Tried, orders: Orders, gains: tuple[float, ...], rules: StampsRules) -> Tried:
    """A fit of these degrees, or what the curvature says of it, where that is beyond doubt.

    Maps are fitted neither where those that matter so much are left out, nor where they by far do not bring what they
    cost.
    """
    own = orders_of(best.fit.place)
    state = with_degrees(best.fit.place, orders.warp, orders.image, rules)
    wider = orders.warp - own.warp
    change = gains[wider - 1] if wider > 0 else -_loss(best.fit, orders.warp)
    # Of the evidence, half the price of each precision is what counts against it.
    cost = 0.5 * _price(scene) * len(scene.planes) * wider
    if change < (rules.worth_fitting * cost if wider > 0 else -rules.beyond_doubt):
        return attempt(scene, replace(best.fit, place=state), change)
    new = orders.warp + orders.image > own.warp + own.image
    return attempt(scene, improve(scene, state, rules, rules.steps_to_judge_new if new else rules.steps_to_judge))


def _spacings(scene: Scene, tried: list[Tried], rules: StampsRules) -> list[Tried]:
    """With the best degrees on denser nodes, as long as the last gain lets expect another that is worth it."""
    gain, first, *finer = np.inf, *rules.spacings_px
    for spacing in finer:
        best = choose(tried).best
        if gain * (finer[0] / first) ** _ERROR_POWER < rules.worth_finer:
            break
        state = without_outliers(scene, with_spacing(scene, best.fit.place, spacing), rules)
        tried = [*tried, attempt(scene, improve(scene, state, rules, rules.steps_to_judge))]
        gain = best.criterion - tried[-1].criterion
    return tried


@dataclass(frozen=True)
class MapCoefficients:
    """Coefficients of maps above some degree: where in the dense block, of which degree and colour, and values."""

    index: Int[np.ndarray, " n"]
    degree: Int[np.ndarray, " n"]
    colour: Int[np.ndarray, " n"]
    value: Float[np.ndarray, " n"]
    precision: Float[np.ndarray, " n"]

    @classmethod
    def above(cls, state: State, degree: int) -> MapCoefficients:
        """Of all colours."""
        start, columns = state.maps_from, []
        for plane, (field, own) in enumerate(zip(state.fields, state.precisions, strict=True)):
            group, flat = by_degree(own.warp, 4), np.ravel(field.warp)
            parts = start + np.arange(len(flat)), 1 + group, np.full(len(flat), plane), flat, own.warp[group]
            columns.append([part[1 + group > degree] for part in parts])
            start += len(flat) + np.size(field.lateral)
        return cls(*(np.concatenate(parts) for parts in zip(*columns, strict=True)))


def _loss(best: Found, degree: int) -> float:
    """Of log posterior when all higher degrees of the maps are held at zero."""
    dropped = MapCoefficients.above(best.place, degree)
    if not dropped.value.size:
        return 0.0
    return 0.5 * float(dropped.value @ np.linalg.solve(marginal_cov(best.equations.root, dropped.index), dropped.value))


def expected_gains(scene: Scene, state: State, highest: int, rules: StampsRules) -> tuple[float, ...]:
    """By how much the log evidence would rise with maps of each degree above the state's, up to ``highest``.

    From one expansion instead of a fit for each. To second order, what the data say of coefficients at zero is a
    Gaussian; a prior of precision L makes it raise the evidence by h' (Q + L)^-1 h / 2 - log |1 + L^-1 Q| / 2, where Q
    is the information that all other unknowns leave and h the gradient of the log likelihood. The precisions that raise
    it most follow without another look at the data.
    """
    own = orders_of(state)
    wider = with_degrees(state, highest, own.image, rules)
    found, new = Evidence(scene, rules).equations_at(wider), MapCoefficients.above(wider, own.warp)
    posterior = np.linalg.inv(marginal_cov(found.root, new.index))
    information, gradient = posterior - np.diag(new.precision), posterior @ found.mode[new.index]
    return tuple(_gain(new, information, gradient, new.degree <= d) for d in range(own.warp + 1, highest + 1))


def _gain(
    new: MapCoefficients,
    information: Float[np.ndarray, "n n"],
    gradient: Float[np.ndarray, " n"],
    among: Bool[np.ndarray, " n"],
) -> float:
    """With the likeliest precisions, one by degree and colour, of those ``among``; the others are held at zero."""
    information, gradient = information[np.ix_(among, among)], gradient[among]
    _, group = np.unique(new.degree[among] + 100 * new.colour[among], return_inverse=True)
    precision = new.precision[among]
    for _ in range(_ROUNDS):
        cov = np.linalg.inv(information + np.diag(precision))
        sums = [np.bincount(group, part)[group] for part in (1 / precision, np.diag(cov), (cov @ gradient) ** 2)]
        precision = updated(precision, *sums)
    posterior = information + np.diag(precision)
    volume = np.linalg.slogdet(posterior)[1] - np.log(precision).sum()
    return 0.5 * float(gradient @ np.linalg.solve(posterior, gradient) - volume)
