"""The search for the orders of a psf field: from one image on wide nodes, to more images or denser nodes, by evidence.

The criterion is -2 log of the evidence (fields, places and light integrated out by Laplace's method), plus the
logarithm of the number of samples for each precision and each number of the images' strengths (Schwarz, "Estimating
the dimension of a model", Annals of Statistics 6, 1978). Maps need no search: precisions hold degrees that are absent.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import final

import numpy as np
from jaxtyping import Float

from udccal.fitting.engine.least_squares import Solution, SolverRules, Step, minimise
from udccal.fitting.engine.orders import Attempt, Choice, choose
from udccal.fitting.engine.robust import OutlierRule, robust_sigma
from udccal.fitting.psf_stamps.data import (
    Stamps,
    StampsRules,
    backgrounds,
    centroids,
    determined,
    edge_light,
    light_of,
)
from udccal.fitting.psf_stamps.equations import Laplace, laplace
from udccal.fitting.psf_stamps.field import PsfField, polynomials, taps
from udccal.fitting.psf_stamps.model_error import of_residuals, of_stars_left_out, placed, resized
from udccal.fitting.psf_stamps.probability import (
    ABSENT,
    FAR,
    HELD,
    State,
    envelope,
    expectation,
    faintest,
    grid_size,
    log_posterior,
    with_error,
)
from udccal.fitting.psf_stamps.strengths import settled
from udccal.models.fields import polynomial_terms

_LEAST_PART = 0.01  # of a step to the mode
WINDOW_PX = 1.6  # standard deviation of a Gaussian as wide as a star, before the kernel is known

Found = Solution[State, Laplace]


@final
@dataclass(frozen=True)
class Evidence:
    """The engine's problem: a step goes to the most probable state, and sets the precisions by empirical Bayes.

    Where ``follows``, the model error of samples is that of the nodes where a step has brought them.
    """

    stamps: Stamps
    rules: StampsRules
    follows: bool = False
    name: str = "psf field of stamps"

    def equations_at(self, place: State) -> Laplace:
        """Return the equations, of infinite cost where they are singular."""
        try:
            found = laplace(self.stamps, place)
        except np.linalg.LinAlgError:
            return Laplace(np.inf, 1, np.zeros(0), np.inf, np.zeros((0, 0)), (), np.zeros(0, dtype=bool), np.zeros(0))
        # The draws are the same every time, so that a descent ends.
        left = place.squares(found.draws(np.random.default_rng(0), self.rules.draws[0]))
        (_, expected), there = place.volume(), place.shifted(found.mode).squares()
        # Fellner and Schall: squares that the prior expects, less those that the data leave open, over those found;
        # no more than 30 times as much at once, and no more than that of an absent term. Most of a first image is
        # dark; these must not make its prior tighter than the kernel's size, or rings are lost.
        ratio = np.clip(np.maximum(expected - left, 1e-6 * expected) / np.maximum(there, 1e-300), 1 / 30, 30.0)
        most = np.full_like(ratio, ABSENT)
        most[: place.of_images.size].reshape(place.of_images.shape)[:, 0, 0] = 1.0
        most[FAR] *= self.stamps.values_e[0].size ** 2
        tuned = np.minimum(np.log(ratio), np.log(most / place.precisions))
        # Pedestal and background differ only where stars are of different brightness. Tuned, the precision of one would
        # rise until it is absent, and nothing would say that it could as well have been the other.
        tuned[HELD] = 0.0
        # Drop the factors, the largest arrays of a fit, so that memory never holds two of them.
        return replace(found, tuned=tuned, colours=())

    def moved(self, place: State, step: Step) -> State:
        """Return the state after a step of all unknowns, and of the logarithms of the precisions.

        The step is halved until the log posterior rises, which is known long before the evidence is.
        """
        least, part = log_posterior(self.stamps, place), 1.0
        while True:
            there = place.shifted(part * step.shared)
            if part < _LEAST_PART or log_posterior(self.stamps, there) > least + 0.1 * part * step.gain:
                there = with_error(self.stamps, there, there.model_error) if self.follows else there
                return replace(there, precisions=place.precisions * np.exp(part * step.own[0]))
            part *= 0.5


def improve(stamps: Stamps, state: State, rules: StampsRules, steps: int, follows: bool = False) -> Found:
    """Go to the most probable state nearby, in ``steps`` and one more at most; LinAlgError if singular at first."""
    # The last step's gain is more reliable than the next one's prediction, which ignores the precisions.
    evidence = max(rules.evidence, rules.evidence_of_nodes * float(state.kept.sum()))
    solver = SolverRules(
        iterations=steps,
        least_gain=0.1 * evidence,
        stalled_gain=2 * evidence,
        small_gain=evidence,
        first_damping=0.03,
        most_damping=0.1,
    )
    problem = Evidence(stamps, rules, follows)
    found = minimise(problem, state, solver)
    if not np.isfinite(found.equations.cost):
        raise np.linalg.LinAlgError("singular at the start")
    # Far from the mode, a step that nobody has tried may lead anywhere.
    if found.equations.gain >= rules.beyond_doubt:
        return found
    # Where precisions still move, steps to the mode may cost evidence although they are small.
    converged = bool(found.converged or found.equations.gain < evidence)
    return replace(found, place=problem.moved(found.place, found.equations.step(0.0)), converged=converged)


def without_outliers(stamps: Stamps, state: State, rules: StampsRules) -> State:
    """Leave out samples and stars that the model does not explain, and take back those that it does explain."""
    everything, out = replace(state, keep=np.ones_like(state.keep)), np.asarray(~state.keep.any(axis=1))
    if out.any():
        # Otherwise a star that was left out would be compared at its place and light of a coarse field.
        everything = placed(stamps, everything, out)
    # What the model does not describe, in most stars, is no hit.
    seen = expectation(stamps, with_error(stamps, everything, of_residuals(stamps, everything)))
    # Clipped samples are not tested: their errors have a bound on one side.
    used = (seen.weight > 0) & ~stamps.clipped
    z = np.where(used, seen.residual * np.sqrt(seen.weight), 0.0)
    # The same for samples at like distances from their star's centre: sharp cores move within a node's square.
    distance = np.linalg.norm(stamps.offset_px - everything.centre_px[:, None], axis=2).astype(int)
    for ring in range(distance.max() + 1):
        own = used & (distance == ring)
        z[own] /= max(1.0, robust_sigma(z[own]))
    keep = ~OutlierRule("samples", rules.outlier_sigma).off(z, used)
    kept, lost = stamps.known & keep, stamps.known & ~keep
    mean = np.where(kept, z**2, 0.0).sum(axis=1) / np.maximum(kept.sum(axis=1), 1)
    bad = mean > rules.star_ratio * np.median(mean)
    bad |= lost.sum(axis=1) > rules.star_lost * np.maximum(stamps.known.sum(axis=1), 1)
    return replace(everything, keep=keep & ~bad[:, None])


@final
@dataclass(frozen=True)
class Orders:
    """Orders that are given: degrees of the map, and of the polynomials that have an image each; spacing of nodes."""

    warp: int
    image: int
    spacing_px: float


def start(stamps: Stamps, rules: StampsRules, map_degree: int) -> State:
    """Return a state of the lowest orders: a round image of the stamps' size, behind a map that is none yet."""
    planes, spacing_px = len(stamps.by_plane), rules.spacings_px[0]
    y, x = (np.arange(n) - (n - 1) / 2 for n in grid_size(stamps.values_e.shape[1:], spacing_px, 1.1))
    image = np.exp(-0.5 * (y[:, None] ** 2 + x**2) * (spacing_px / WINDOW_PX) ** 2) + 1e-3
    nodes = np.tile(image / (image.sum() * spacing_px**2), (planes, 1, 1, 1))
    warp = np.zeros((planes, polynomial_terms(map_degree) - 1, 2, 2))
    # Lateral colour and pedestals of degree 2.
    lateral, pedestal = np.zeros((planes - 1, 5, 2)), np.zeros((planes, 6))
    field = PsfField(nodes, warp, lateral, np.ones((1, 1)), pedestal, spacing_px)
    background_e = backgrounds(stamps)
    # A background may be all of the edges' light; one too faint for these to show may still be as large as the noise.
    squares = np.array([edge_light(stamps) ** 2, background_e.var(axis=0).mean()])
    expected = np.maximum(squares, stamps.read_e**2) * [len(stamps.unit), 1]
    laterals, images = np.full(2 * planes - 2, rules.first_lateral), np.tile(rules.first_image[0], planes)
    maps = np.tile(([rules.first_map] * 2 + [rules.new_map] * map_degree)[:map_degree], planes)
    pedestals = (stamps.values_e[0].size / np.array([rules.most_pedestal, rules.first_pedestal])) ** 2
    precisions = np.concatenate([images, maps, laterals, pedestals, 1.0 / expected])
    centre_px, light_e = centroids(stamps, background_e, WINDOW_PX), light_of(stamps, background_e)
    size = envelope(nodes[:, 0], spacing_px, faintest(stamps, light_e, background_e))
    keep = np.ones_like(stamps.known)
    return State(
        field, centre_px, light_e, background_e, precisions, size, keep, np.zeros_like(size), np.zeros(keep.shape)
    )


def coarse(stamps: Stamps, rules: StampsRules, map_degree: int) -> State:
    """Fit places, light and a map, with a model error for the parts that the model cannot describe yet."""
    state = start(stamps, rules, map_degree)
    for number, allowed in enumerate(rules.coarse):
        state = without_outliers(stamps, state, rules) if number > 1 else state
        state = improve(stamps, with_error(stamps, state, allowed * state.size), rules, 1, follows=True).place
        # Images cannot make up for nodes too wide for the kernel.
        narrow = state.field.spacing_px == rules.spacings_px[0] and state.width_px < rules.narrow_px
        state = state.with_spacing(stamps, rules.spacings_px[-2] if narrow else state.field.spacing_px, rules)
    return without_outliers(stamps, state.without_error(), rules)


def search(stamps: Stamps, rules: StampsRules, orders: Orders | None) -> Choice[Found]:
    """Search for the orders, unless they are given, and fit; raise LinAlgError when equations are singular."""
    # Degrees have at most half as many polynomials as there are stars, and the stars tell each of them.
    enough = [d for d in range(1, 9) if 2 * polynomial_terms(d) <= len(stamps.unit)]
    limit = max((d for d in enough if determined(stamps, d, rules.least_of_degree)), default=0)
    map_degree, image_degree = (min(limit, highest) for highest in rules.highest)
    if orders:
        state = coarse(stamps, rules, orders.warp).with_spacing(stamps, orders.spacing_px, rules)
        state = state.with_images(np.eye(polynomial_terms(orders.image)), rules)
        best = attempt(stamps, improve(stamps, state, rules, rules.steps_to_compare), rules)
        tried = [best]
    else:
        tried, best = _search_all(stamps, map_degree, image_degree, rules)
    # Others were compared without a model error and with the same samples left out; this fit does not compare.
    state = best.fit.place if orders else _denser(stamps, best.fit.place, rules)
    state = settled(stamps, without_outliers(stamps, state, rules))
    error, off = of_stars_left_out(stamps, state, rules)
    state = replace(with_error(stamps, state, error), left_out_off=off)
    found = improve(stamps, state, rules, rules.steps_to_end)
    final = replace(best, fit=replace(found, place=resized(stamps, found.place, rules)))
    return Choice(final, (*(t for t in tried if t is not best), final))


def _denser(stamps: Stamps, state: State, rules: StampsRules) -> State:
    """Return the field on denser nodes than the evidence prefers, half a pixel apart or less, where there is room.

    On the nodes that it prefers, a spline errs by up to 1 % at a sharp peak, at all places alike: four times what is
    stated. On denser ones the prior's smoothness holds what the data do not, so that error bars grow little. Several
    images have more to hold, and may have room for nodes in the middle only: they stay where denser nodes hardly change
    what is expected of the stars, and where stars are less likely with them, as the images do not reach far enough.
    """
    denser = [one for one in rules.spacings_px if one < min(state.field.spacing_px, rules.most_spacing_px)]
    if not denser:
        return state
    finer = improve(stamps, state.with_spacing(stamps, denser[0], rules), rules, rules.steps_to_compare).place
    if len(state.field.mix) == 1:
        return finer
    before, after = (expectation(stamps, one) for one in (state, finer))
    changed = float((before.weight * (after.mean_e - before.mean_e) ** 2).sum())
    return finer if changed > rules.worth_finer and after.log_likelihood > before.log_likelihood else state


def attempt(stamps: Stamps, found: Found, rules: StampsRules) -> Attempt[Found]:
    """Return a fit with its criterion."""
    state, gain = found.place, found.equations.gain
    # Far from the mode, what another step promises is worth no more than the last one gained, nor much at all.
    last = -0.5 * float(np.diff(found.history)[-1:].sum())
    evidence = found.equations.evidence - gain + min(gain, last, rules.beyond_doubt)
    images, terms = state.field.mix.shape
    tuned = len(state.precisions) + (images - 1) * (terms - 1)
    criterion = np.log(stamps.known.sum()) * tuned - 2 * evidence
    return Attempt(state.name, state.field.nodes.size + state.maps, float(criterion), found)


def _search_all(
    stamps: Stamps, map_degree: int, image_degree: int, rules: StampsRules
) -> tuple[list[Attempt[Found]], Attempt[Found]]:
    """Return all fits of a search for the orders, and the best one.

    With an image for every polynomial, images make up at the stars for whatever a map of the highest degree does, and
    beyond them nothing does: kernels there were off by 15 %, where 4 % were stated. A simpler map takes its place.
    """
    unlimited = rules.most_images + 1
    most = polynomial_terms(image_degree) if map_degree > 1 else unlimited
    tried = _neighbours(stamps, map_degree, image_degree, most, rules)
    best = choose(tried).best
    if len(best.fit.place.field.mix) < most:
        return tried, best
    simpler = _neighbours(stamps, map_degree - 1, image_degree, unlimited, rules)
    return [*tried, *simpler], choose(simpler).best


def _neighbours(stamps: Stamps, map_degree: int, degree: int, most: int, rules: StampsRules) -> list[Attempt[Found]]:
    """Return all fits of a search that adds images as long as they help, then makes nodes denser, and begins again.

    It ends where ``most`` images are best.
    """
    first = improve(stamps, coarse(stamps, rules, map_degree), rules, rules.steps_to_compare)
    best = attempt(stamps, first, rules)
    tried, gain = [best], np.inf
    while len(best.fit.place.field.mix) < most:
        state, known = best.fit.place, {one.name for one in tried}
        spacings = [one for one in rules.spacings_px if one < state.field.spacing_px]
        # The error of cubic splines falls with the spacing's fourth power, its cost in likelihood with the eighth.
        worth = spacings and gain * (spacings[0] / state.field.spacing_px) ** 8 > rules.worth_finer
        near, finer = with_more_images(stamps, state, degree, rules), False
        if near.name in known:
            if not worth:
                return tried
            near, finer = state.with_spacing(stamps, spacings[0], rules), True
        tried.append(attempt(stamps, improve(stamps, near, rules, rules.steps_to_compare), rules))
        gained = best.criterion - tried[-1].criterion
        gain = max(gained, 0.0) if finer else gain
        best = choose((best, tried[-1])).best
    return tried


def with_more_images(stamps: Stamps, state: State, degree: int, rules: StampsRules) -> State:
    """Return the state with new images, which are zero; the same state where there is no room for more.

    Coma, a ring that opens, or an order of diffraction that fades change a psf in a few ways, whatever the degree of
    the polynomials that describe them. The most significant mixtures of all polynomials in the residuals become
    strengths of new images; one image for every polynomial would need several times as many nodes.
    """
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
