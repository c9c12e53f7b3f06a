"""Choice of the kernel's residual and its width, with or without diffraction, by positions that were held out."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial, reduce
from typing import final

import numpy as np
from jaxtyping import Bool, Float

from udccal.fitting.engine.orders import Attempt, Choice, choose, held_out_beats, rising
from udccal.fitting.psf.data import (
    Crops,
    PsfRules,
    Shots,
    about_middle,
    held_out_positions,
)
from udccal.fitting.psf.held_out import Compared, compare
from udccal.fitting.psf.image import (
    FREE_PER_PX,
    Basis,
    Changes,
    Image,
    Magnitude,
    Sources,
    Windows,
    free_sources,
    make_windows,
    prior_sigma,
    solve_image,
)
from udccal.models.fields import polynomial_basis, polynomial_terms
from udccal.result import Candidate

Places = Float[np.ndarray, "positions 2"]


@final
@dataclass(frozen=True)
class Order:
    """A candidate for the residual.

    Attributes:
        degree: of its polynomials, -1 for none.
        free: True if it is the whole kernel, without diffraction.
        size: its prior standard deviation, as a fraction of the kernel nearby.
        model_error: included in the weights of solutions, see ``data.left_out``.
        reach: part of the window, about the source, that has a residual.
    """

    degree: int
    free: bool
    size: float
    model_error: float
    reach: float = 1.0

    @property
    def name(self) -> str:
        """Name in the table of candidates."""
        if self.degree < 0:
            return "diffraction"
        if self.free:
            return f"free image, degree {self.degree}"
        within = "" if self.reach == 1 else f" within {self.reach:g} of the window"
        return f"diffraction, residual degree {self.degree} of {100 * self.size:g} %{within}"

    @property
    def per_px(self) -> int:
        """Number of the image's nodes per pixel."""
        return FREE_PER_PX if self.free else 1

    def half(self, shots: Shots) -> tuple[int, int]:
        """Return (rows, columns) to either side of the source that have a residual, in pixels of these windows."""
        rows, columns = (round(self.reach * size) for size in shots.half)
        return rows, columns


@final
@dataclass(frozen=True)
class Trial:
    """An order at positions that it was not solved from: the samples there, and their loss by position."""

    order: Order
    sources: Sources
    compared: Compared
    loss: Float[np.ndarray, " places"]


@final
@dataclass(frozen=True)
class Selection:
    """The residual that was chosen.

    Attributes:
        trial: the chosen one of the ``candidates``.
        image: the residual on pixels, as wide as its order; a single zero for none.
        magnitude: the kernel's average size.
        everywhere: all shots by diffraction alone, or those held out where a residual has used the others.
    """

    trial: Trial
    candidates: tuple[Candidate, ...]
    image: Float[np.ndarray, "terms 3 rows columns"]
    magnitude: Float[np.ndarray, "3 window_rows window_columns"]
    everywhere: Compared


@final
@dataclass(frozen=True)
class _Orders:
    """All shots, their light by diffraction (``explained``, per unit of light), and the mean kernel's size."""

    shots: Shots
    explained: Crops
    basis: Basis
    magnitude: Magnitude
    test: Bool[np.ndarray, " shots"]
    rules: PsfRules

    def attempt(self, sources: Sources, order: Order) -> Attempt[Trial]:
        """Solve from all shots but those held out, and compare with these."""
        found = self.compared(sources, order, self.test)
        trial = Trial(order, sources, found, found.loss(self.shots.position[self.test]))
        rows, columns = (2 * order.per_px * size + 1 for size in order.half(self.shots))
        coefficients = 3 * rows * columns * polynomial_terms(order.degree)
        return Attempt(order.name, coefficients, float(trial.loss.mean()), trial)

    def compared(self, sources: Sources, order: Order, unseen: Bool[np.ndarray, " shots"]) -> Compared:
        """Solve from all shots but the ``unseen``, and compare with these."""
        windows = self._windows(sources, order)
        light = windows.pick(unseen).expected(self._solve(windows.pick(~unseen), order))
        return compare(self.shots.pick(unseen), windows.pick(unseen), light)

    def image(self, trial: Trial) -> Image:
        """Solve for the residual on pixels from all shots."""
        order = trial.order
        if order.degree < 0:
            return np.zeros((1, 3, 1, 1))
        image = self._solve(self._windows(trial.sources, order), order)[..., :: order.per_px, :: order.per_px]
        return about_middle(image, order.half(self.shots))

    def rising(self, sources: Sources, free: bool, allowed: float) -> tuple[Attempt[Trial], ...]:
        """Try rising degrees while they help, each with its best size; see ``engine.orders.rising``.

        There are never more terms than fitted positions. A degree's residuals give the next one's model error.
        """
        positions = len(np.unique(self.shots.position[~self.test]))
        sizes = (1.0,) if free else self.rules.residual_sizes

        def attempt(degree: int) -> Attempt[Trial]:
            nonlocal allowed
            orders = [Order(degree, free, size, allowed) for size in (sizes if degree >= 0 else (0.0,))]
            best = choose([self.attempt(sources, order) for order in orders]).best
            allowed = best.fit.compared.model_error
            return best

        degrees = range(0 if free else -1, self.rules.highest_degree + 1)
        return rising([partial(attempt, d) for d in degrees if polynomial_terms(d) <= positions], self.beats)

    def beats(self, one: Attempt[Trial], other: Attempt[Trial]) -> bool:
        """Return whether ``one`` lowers the held-out loss by more than it costs."""
        return held_out_beats(one.fit.loss, other.fit.loss, self.rules.worth)

    def narrowed(self, best: Attempt[Trial]) -> tuple[Attempt[Trial], ...]:
        """Try narrower residuals, up to the first that the whole window does not improve on; the last is chosen."""
        tried: list[Attempt[Trial]] = []
        for reach in self.rules.reaches:
            tried.append(self.attempt(best.fit.sources, replace(best.fit.order, reach=reach)))
            if not held_out_beats(best.fit.loss, tried[-1].fit.loss, self.rules.worth_of_room):
                return tuple(tried)
        return (*tried, best)

    def _windows(self, sources: Sources, order: Order) -> Windows:
        return make_windows(self.shots, sources, self.explained, self.basis, order.model_error, order.free)

    def _solve(self, windows: Windows, order: Order) -> Image:
        """Solve for the residual's image, which is 0 beyond its reach."""
        sigma = prior_sigma(self.magnitude, order.size, order.per_px)
        y, x = (np.abs(np.arange(nodes) - nodes // 2) for nodes in sigma.shape[1:])
        rows, columns = (order.per_px * half for half in order.half(self.shots))
        within = sigma * ((y <= rows)[:, None] & (x <= columns))
        sigmas = np.tile(within, (polynomial_terms(order.degree), 1, 1, 1))
        if order.degree < 0:
            return sigmas
        scaled, _ = solve_image(windows, sigmas, np.zeros_like(sigmas), Changes.none(windows.rate.shape))
        return windows.smoothed(scaled * sigmas)


def select_field(
    shots: Shots, sources: Sources, explained: Crops, unit_positions: Places, model_error: float, rules: PsfRules
) -> Selection:
    """Try no residual, then residuals of rising degree while they help; if diffraction fails, do without it.

    ``sources``, ``explained`` (light per unit) and ``model_error`` are those of diffraction; ``unit_positions`` are the
    field positions, scaled to about [-1, 1].
    """
    # The kernel's average size by colour, on samples that any picture has.
    colour = shots.colour * (shots.weight > 0)[..., None]
    rate = np.abs(shots.rate - sources.background[:, None, None])
    seen = np.maximum(colour.sum(axis=0), 1.0).transpose(2, 0, 1)
    magnitude = np.einsum("syx,syxc->cyx", rate, colour) / seen
    magnitude /= np.maximum(magnitude.sum(axis=(1, 2), keepdims=True), 1e-30)
    test = held_out_positions(shots.positions)[shots.position]
    basis = np.asarray(polynomial_basis(unit_positions, rules.highest_degree))[shots.position]
    orders = _Orders(shots, explained, basis, magnitude, test, rules)
    tried = orders.rising(sources, False, model_error)
    if np.sqrt((tried[0].fit.compared.relative_l2() ** 2).mean()) > rules.doubtful:
        # Places and light by an image of too low a degree take a part of what it lacks.
        terms = [polynomial_terms(degree) for degree in range(rules.highest_degree + 1)]
        most = max(count for count in terms if 2 * count <= max(shots.positions, 2))
        free = free_sources(shots, basis[:, :most], magnitude, rules)
        tried += orders.rising(free, True, rules.free_model_error)
    best = reduce(lambda best, one: one if orders.beats(one, best) else best, tried)
    if best.fit.order.degree >= 0 and not best.fit.order.free:
        narrower = orders.narrowed(best)
        tried, best = (*tried, *(one for one in narrower if one is not best)), narrower[-1]
    everywhere = best.fit.compared
    if best.fit.order.degree < 0:
        # Diffraction has few parameters: the shots that it was fitted to show its error as well as others do.
        everywhere = orders.compared(best.fit.sources, best.fit.order, np.ones_like(test))
    return Selection(best.fit, Choice(best, tried).candidates, orders.image(best.fit), magnitude, everywhere)
