"""Which orders a psf field needs: tried from a middle one, a degree at a time, by how likely each makes the data.

The criterion is -2 log of the evidence (fields, places and light integrated out by Laplace's method), plus the
logarithm of the number of samples for each precision that was tuned (Schwarz, "Estimating the dimension of a model",
Annals of Statistics 6, 1978).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import final

import numpy as np
import scipy.ndimage
from jaxtyping import Bool, Float

from udccal.fitting.engine.least_squares import Solution
from udccal.fitting.engine.orders import Attempt, Choice, choose
from udccal.fitting.psf_stamps.data import WINDOW_PX, Scene, StampsRules, centroids, light_of
from udccal.fitting.psf_stamps.equations import MapCoefficients, marginal_cov
from udccal.fitting.psf_stamps.field import PlaneField, warps
from udccal.fitting.psf_stamps.probability import Precisions, State, envelope, updated
from udccal.fitting.psf_stamps.solve import Evidence, Laplace, improve, without_outliers
from udccal.models.fields import polynomial_terms

Found = Solution[State, Laplace]
Tried = Attempt[Found]

# How many nodes there are changes by steps: an image's nodes do not move with every digit of a map.
_STEP = 3
# How far images reach beyond stamps: at the start; and at least and at most, once it is known how far maps look.
_REACH, _LEAST_REACH, _MOST_REACH = 1.1, 1.0, 1.7
_LATERAL_DEGREE = 2
# The error of cubic splines falls with the fourth power of their spacing, what it costs in likelihood with the eighth.
_ERROR_POWER = 8
_ROUNDS = 30


@final
@dataclass(frozen=True)
class Orders:
    """Degrees of the map and of the images over the field, and how many px lie between nodes."""

    warp: int
    image: int
    spacing_px: float

    @property
    def name(self) -> str:
        """For the table of candidates."""
        return f"map degree {self.warp}, image degree {self.image}, nodes every {self.spacing_px:g} px"


def orders_of(state: State) -> Orders:
    """Of a state."""
    field = state.fields[0]
    return Orders(field.warp_degree, field.image_degree, field.spacing_px)


def reference(planes: int) -> int:
    """The plane that places are of: green, where there are three."""
    return 1 if planes == 3 else 0


def coarse(scene: Scene, rules: StampsRules, most: Orders) -> State:
    """Places, light and a first field; what the model cannot follow yet is allowed for as an error of its own."""
    state = start(scene, rules)
    for warp, image, allowed in rules.coarse:
        state = replace(with_degrees(state, min(warp, most.warp), min(image, most.image), rules), model_error=allowed)
        state = without_outliers(scene, state, rules) if warp else state
        state = with_envelopes(improve(scene, state, rules, rules.coarse_steps).place)
    state = with_spacing(scene, state, rules.spacings_px[0])
    return without_outliers(scene, replace(state, model_error=0.0), rules)


def start(scene: Scene, rules: StampsRules) -> State:
    """A state of the lowest orders: a round image of the stamps' size."""
    spacing_px = rules.spacings_px[0]
    y, x = (np.arange(n) - (n - 1) / 2 for n in grid_size(scene.shape, spacing_px))
    image = np.exp(-0.5 * (y[:, None] ** 2 + x**2) * (spacing_px / WINDOW_PX) ** 2) + 1e-3
    image /= image.sum() * spacing_px**2
    fields, precisions = [], []
    for plane in range(len(scene.planes)):
        lateral = 0 if plane == reference(len(scene.planes)) else _LATERAL_DEGREE
        terms = polynomial_terms(lateral) - 1
        fields.append(PlaneField(image[None], np.zeros((0, 2, 2)), np.zeros((terms, 2)), 0, 0, lateral, spacing_px))
        first = np.array([rules.first_image[0]])
        precisions.append(Precisions(first, np.zeros(0), np.full(lateral, rules.first_lateral)))
    return State(
        fields=tuple(fields),
        centre_px=centroids(scene.planes, len(scene.unit)),
        flux_e=np.stack([light_of(plane, scene.read_e) for plane in scene.planes], axis=1),
        precisions=tuple(precisions),
        envelopes=(envelope(image, spacing_px),) * len(fields),
        keep=tuple(np.ones(plane.usable.shape, dtype=bool) for plane in scene.planes),
    )


def with_degrees(state: State, warp: int, image: int, rules: StampsRules) -> State:
    """The state with other degrees: what is new starts at zero, what is dropped is forgotten."""
    fields, precisions = [], []
    for field, own in zip(state.fields, state.precisions, strict=True):
        nodes = _resized(field.nodes, polynomial_terms(image))
        maps = _resized(field.warp, polynomial_terms(warp) - 1)
        fields.append(replace(field, nodes=nodes, warp=maps, image_degree=image, warp_degree=warp))
        images = _resized(own.image, image + 1)
        for degree in range(len(own.image), image + 1):
            least = rules.new_image * images[degree - 1] if degree > 1 else np.zeros(2)
            images[degree] = np.maximum(rules.first_image[1], least)
        new = np.array([rules.first_map] * 2 + [rules.new_map] * warp)
        precisions.append(replace(own, image=images, warp=np.concatenate([own.warp, new[len(own.warp) :]])[:warp]))
    return replace(state, fields=tuple(fields), precisions=tuple(precisions))


def with_envelopes(state: State) -> State:
    """The state with priors that know the kernel's size as it is now."""
    return replace(state, envelopes=tuple(envelope(np.asarray(f.nodes[0]), f.spacing_px) for f in state.fields))


def with_spacing(scene: Scene, state: State, spacing_px: float) -> State:
    """The state on other nodes, which give the same images and reach as far as maps look."""
    fields, precisions = [], []
    inverse = np.concatenate([np.linalg.inv(np.asarray(warps(field, scene.unit))) for field in state.fields])
    reach = float(np.clip(np.abs(inverse).sum(axis=2).max(), _LEAST_REACH, _MOST_REACH))
    size = grid_size(scene.shape, spacing_px, reach)
    for field, own in zip(state.fields, state.precisions, strict=True):
        nodes = np.stack([_resampled(image, spacing_px / field.spacing_px, size) for image in field.nodes])
        fields.append(replace(field, nodes=nodes, spacing_px=spacing_px))
        # A squared Laplacian is a difference of fourth order; there are more nodes for what is as rough.
        ratio = spacing_px / field.spacing_px
        precisions.append(replace(own, image=own.image * ratio**2 * np.array([1.0, ratio**-4])))
    return with_envelopes(replace(state, fields=tuple(fields), precisions=tuple(precisions)))


def grid_size(shape: tuple[int, ...], spacing_px: float, reach: float = _REACH) -> tuple[int, int]:
    """Nodes that cover stamps, and by ``reach`` more where maps look beyond."""
    rows, columns = (_STEP * math.ceil(((size + 1) * reach / spacing_px + 3) / _STEP) for size in shape)
    return rows, columns


def _resized(values: Float[np.ndarray, "n *rest"], count: int) -> Float[np.ndarray, "count *rest"]:
    """The first ``count``, zeros where there were fewer."""
    out = np.zeros((count, *values.shape[1:]))
    out[: len(values)] = values[:count]
    return out


def _resampled(
    image: Float[np.ndarray, "rows columns"], ratio: float, grid: tuple[int, int]
) -> Float[np.ndarray, "grid_rows grid_columns"]:
    """On nodes ``ratio`` as far from each other."""
    grids = [(np.arange(n) - (n - 1) / 2) * ratio + (size - 1) / 2 for n, size in zip(grid, image.shape, strict=True)]
    # Coefficients to values at the new nodes, and these to coefficients.
    places = np.stack(np.meshgrid(*grids, indexing="ij"))
    values = scipy.ndimage.map_coordinates(image, places, order=3, mode="constant", prefilter=False)
    return np.asarray(scipy.ndimage.spline_filter(values, order=3, mode="mirror"))


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
