"""The search for the orders of a psf field: from a middle one, a degree at a time, by evidence.

The criterion is -2 log of the evidence (fields, places and light integrated out by Laplace's method), plus the
logarithm of the number of samples for each precision that was tuned (Schwarz, "Estimating the dimension of a model",
Annals of Statistics 6, 1978).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import final

import numpy as np
from jaxtyping import Bool

from udccal.fitting.engine.gaussian import scaled_inverse
from udccal.fitting.engine.least_squares import Solution, SolverRules, Step, minimise
from udccal.fitting.engine.orders import Attempt, Choice, choose
from udccal.fitting.engine.robust import OutlierRule
from udccal.fitting.psf_stamps.data import Stamps, StampsRules, centroids, light_of
from udccal.fitting.psf_stamps.equations import Laplace, laplace, marginal_cov
from udccal.fitting.psf_stamps.field import PsfField
from udccal.fitting.psf_stamps.probability import State, envelope, expectation, grid_size
from udccal.models.fields import polynomial_terms

WINDOW_PX = 1.6  # standard deviation of a Gaussian as wide as a star, before the kernel is known

Found = Solution[State, Laplace]


@final
@dataclass(frozen=True)
class Evidence:
    """The engine's problem: a step goes to the most probable state, and sets the precisions by empirical Bayes."""

    stamps: Stamps
    rules: StampsRules
    name: str = "psf field of stamps"

    def equations_at(self, place: State) -> Laplace:
        """Return the equations, of infinite cost where they are singular."""
        try:
            found = laplace(self.stamps, place)
        except np.linalg.LinAlgError:
            return Laplace(np.inf, 1, np.zeros(0), np.inf, np.zeros((0, 0)), (), np.zeros(0))
        # The draws are the same every time, so that a descent ends.
        left = place.squares(found.draws(np.random.default_rng(0), self.rules.draws[0]))
        (_, expected), there = place.volume(), place.shifted(found.mode).squares()
        # Fellner and Schall: squares that the prior expects, less those that the data leave open, over those found;
        # no more than 30 times as much at once, and no more than 1e14, where a term is absent.
        ratio = np.clip(np.maximum(expected - left, 1e-6 * expected) / np.maximum(there, 1e-300), 1 / 30, 30.0)
        tuned = np.minimum(np.log(ratio), np.log(1e14 / place.precisions))
        # Drop the factors, the largest arrays of a fit, so that memory never holds two of them.
        return replace(found, tuned=tuned, colours=())

    def moved(self, place: State, step: Step) -> State:
        """Return the state after a step of all unknowns, and of the logarithms of the precisions."""
        return replace(place.shifted(step.shared), precisions=place.precisions * np.exp(step.own[0]))


def improve(stamps: Stamps, state: State, rules: StampsRules, steps: int) -> Found:
    """Go to the most probable state nearby, in ``steps`` and one more at most; LinAlgError if singular at first."""
    # The last step's gain is more reliable than the next one's prediction, which ignores the precisions.
    ends = dict(least_gain=0.0, stalled_gain=2 * rules.evidence, small_gain=rules.evidence)
    solver = SolverRules(iterations=steps, first_damping=0.03, most_damping=10.0, **ends)
    problem = Evidence(stamps, rules)
    found = minimise(problem, state, solver)
    if not np.isfinite(found.equations.cost):
        raise np.linalg.LinAlgError("singular at the start")
    return replace(found, place=problem.moved(found.place, found.equations.step(0.0)))


def without_outliers(stamps: Stamps, state: State, rules: StampsRules) -> State:
    """Leave out samples and stars that the model does not explain, and take back those that it does explain."""
    everything, out = replace(state, keep=np.ones_like(state.keep)), np.asarray(~state.keep.any(axis=1))
    if out.any():
        # Otherwise a star that was left out would be compared at its place and light of a coarse field.
        everything = _placed(stamps, everything, out)
    seen = expectation(stamps, everything)
    # Clipped samples are not tested: their errors have a bound on one side.
    used = (seen.weight > 0) & ~stamps.clipped
    z = np.where(used, seen.residual * np.sqrt(seen.weight), 0.0)
    keep = ~OutlierRule("samples", rules.outlier_sigma).off(z, used)
    kept, lost = stamps.known & keep, stamps.known & ~keep
    mean = np.where(kept, z**2, 0.0).sum(axis=1) / np.maximum(kept.sum(axis=1), 1)
    bad = mean > rules.star_ratio * np.median(mean)
    bad |= lost.sum(axis=1) > rules.star_lost * np.maximum(stamps.known.sum(axis=1), 1)
    return replace(everything, keep=keep & ~bad[:, None])


def _placed(stamps: Stamps, state: State, stars: Bool[np.ndarray, " stars"]) -> State:
    """Fit some stars' places and light again, with the field held."""
    for _ in range(4):
        seen = expectation(stamps, state)
        by_light = seen.seen.jacobian[..., :1] * np.moveaxis(stamps.by_plane, 0, 2)
        jacobian = np.concatenate([seen.seen.jacobian[..., 1:3], by_light], axis=2)
        weighted = (jacobian * seen.weight[..., None]).transpose(0, 2, 1)
        step = (scaled_inverse(weighted @ jacobian) @ weighted @ seen.residual[..., None])[..., 0]
        centre, light = np.split(np.clip(step, -0.5, 0.5) * stars[:, None], [2], axis=1)
        state = replace(state, centre_px=state.centre_px + centre, light_e=state.light_e * np.exp(light))
    return state


@final
@dataclass(frozen=True)
class Orders:
    """Degrees of the map and of the images over the field, and spacing of nodes in px."""

    warp: int
    image: int
    spacing_px: float

    @classmethod
    def of(cls, state: State) -> Orders:
        """Return the orders of a state."""
        return cls(*state.field.degrees, state.field.spacing_px)

    @property
    def name(self) -> str:
        """Name in the table of candidates."""
        return f"map degree {self.warp}, image degree {self.image}, nodes every {self.spacing_px:g} px"


def start(stamps: Stamps, rules: StampsRules) -> State:
    """Return a state of the lowest orders: a round image of the stamps' size."""
    planes, spacing_px = len(stamps.by_plane), rules.spacings_px[0]
    y, x = (np.arange(n) - (n - 1) / 2 for n in grid_size(stamps.values_e.shape[1:], spacing_px, 1.1))
    image = np.exp(-0.5 * (y[:, None] ** 2 + x**2) * (spacing_px / WINDOW_PX) ** 2) + 1e-3
    nodes = np.tile(image / (image.sum() * spacing_px**2), (planes, 1, 1, 1))
    # Lateral colour of degree 2.
    field = PsfField(nodes, np.zeros((planes, 0, 2, 2)), np.zeros((planes - 1, 5, 2)), spacing_px)
    first = np.concatenate([np.tile(rules.first_image[0], planes), np.full(2 * planes - 2, rules.first_lateral)])
    centre_px, size = centroids(stamps, WINDOW_PX), envelope(nodes[:, 0], spacing_px)
    return State(field, centre_px, light_of(stamps), first, size, np.ones_like(stamps.known))


def coarse(stamps: Stamps, rules: StampsRules, most: Orders) -> State:
    """Fit places, light and a first field, with a model error for the parts that the model cannot describe yet."""
    state = start(stamps, rules)
    for warp, image, allowed in rules.coarse:
        state = replace(state.with_degrees(min(warp, most.warp), min(image, most.image), rules), model_error=allowed)
        state = without_outliers(stamps, state, rules) if warp else state
        state = improve(stamps, state, rules, 1).place
        state = replace(state, size=envelope(state.field.nodes[:, 0], state.field.spacing_px))
    state = state.with_spacing(stamps, rules.spacings_px[0])
    return without_outliers(stamps, replace(state, model_error=0.0), rules)


def search(stamps: Stamps, rules: StampsRules, orders: Orders | None) -> Choice[Found]:
    """Search for the orders, unless they are given, and fit; raise LinAlgError when equations are singular."""
    # Degrees have at most half as many polynomials as there are stars.
    limit = max(d for d in range(9) if d == 0 or 2 * polynomial_terms(d) <= len(stamps.unit))
    warp, image = (min(limit, highest) for highest in rules.highest)
    most = orders or Orders(warp, image, rules.spacings_px[0])
    state, tried = coarse(stamps, rules, most), []
    if orders is not None:
        state = state.with_spacing(stamps, orders.spacing_px).with_degrees(orders.warp, orders.image, rules)
        found = improve(stamps, state, rules, rules.steps_to_end)
    else:
        tried = _spacings(stamps, _degrees(stamps, state, rules, most), rules)
        found = choose(tried).best.fit
    state = without_outliers(stamps, found.place, rules)
    if not (found.converged and np.array_equal(state.keep, found.place.keep)):
        found = improve(stamps, state, rules, rules.steps_to_end)
    final = attempt(stamps, found)
    return Choice(final, (*(t for t in tried if t.name != final.name), final))


def attempt(stamps: Stamps, found: Found, more: float = 0.0) -> Attempt[Found]:
    """Return a fit with its criterion; ``more`` adds to the equations' log evidence."""
    state = found.place
    criterion = np.log(stamps.known.sum()) * len(state.precisions) - 2 * (found.equations.evidence + more)
    return Attempt(Orders.of(state).name, state.field.nodes.size + len(state.maps), float(criterion), found)


def _degrees(stamps: Stamps, state: State, rules: StampsRules, most: Orders) -> list[Attempt[Found]]:
    """Return all fits of a search that goes from neighbour to neighbour until none is better."""
    best = attempt(stamps, improve(stamps, state, rules, rules.steps_to_compare + 1))
    tried, known = [best], {Orders.of(state)}
    while True:
        own = Orders.of(best.fit.place)
        steps = ((0, -1), (-1, 0), (-2, 0), (1, 0), (2, 0), (0, 1))
        near = [Orders(own.warp + w, own.image + i, own.spacing_px) for w, i in steps]
        near = [o for o in near if o not in known and 0 <= o.warp <= most.warp and 0 <= o.image <= most.image]
        tried += [_judged(stamps, best, o, rules) for o in near]
        known.update(near)
        if (better := choose(tried).best) is best:
            return tried
        best = better


def _judged(stamps: Stamps, best: Attempt[Found], orders: Orders, rules: StampsRules) -> Attempt[Found]:
    """Fit these degrees, or predict the fit by curvature if a map that matters beyond doubt is left out."""
    place, warp = best.fit.place, best.fit.place.field.warp
    dropped = np.arange(warp.size).reshape(warp.shape)[:, polynomial_terms(orders.warp) - 1 :].ravel()
    value, cov = place.maps[dropped], marginal_cov(best.fit.equations.root, place.maps_from + dropped)
    loss = 0.5 * float(value @ np.linalg.solve(cov, value))
    state = place.with_degrees(orders.warp, orders.image, rules)
    if loss > rules.beyond_doubt:
        return attempt(stamps, replace(best.fit, place=state), -loss)
    return attempt(stamps, improve(stamps, state, rules, rules.steps_to_compare))


def _spacings(stamps: Stamps, tried: list[Attempt[Found]], rules: StampsRules) -> list[Attempt[Found]]:
    """Try the best degrees on denser nodes, while the last gain predicts another that is large enough."""
    gain, first, *finer = np.inf, *rules.spacings_px
    for spacing in finer:
        best = choose(tried).best
        # The error of cubic splines falls with the spacing's fourth power, its cost in likelihood with the eighth.
        if gain * (finer[0] / first) ** 8 < rules.worth_finer:
            break
        state = without_outliers(stamps, best.fit.place.with_spacing(stamps, spacing), rules)
        tried = [*tried, attempt(stamps, improve(stamps, state, rules, rules.steps_to_end))]
        gain = best.criterion - tried[-1].criterion
    return tried
