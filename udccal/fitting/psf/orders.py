"""Which residual the kernel needs beside diffraction or without it, and how wide: by positions that were left out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import final

import numpy as np
from jaxtyping import Bool, Float

from udccal.fitting.engine.orders import Attempt, Choice, choose, held_out_beats, rising
from udccal.fitting.psf.data import Shots, held_out_positions
from udccal.fitting.psf.free import FREE_PER_PX, free_sources
from udccal.fitting.psf.held_out import Compared, KernelError, Support, choose_support, compare, kernel_error
from udccal.fitting.psf.image import (
    Sources,
    Windows,
    about_middle,
    image_of,
    make_windows,
    prior_sigma,
    solve_image,
)
from udccal.fitting.psf.start import PsfRules
from udccal.models.fields import polynomial_basis, polynomial_terms
from udccal.result import Candidate


@final
@dataclass(frozen=True)
class Order:
    """What residual there may be.

    Attributes:
        degree: of its polynomials, -1 for none.
        share: of diffraction, 1 or 0.
        size: its standard deviation beforehand, as a fraction of the kernel nearby.
        model_error: what solutions allow for, see ``psf.weights``.
        reach: of the window, so large a part has a residual, about the source.
    """

    degree: int
    share: float
    size: float
    model_error: float
    reach: float = 1.0

    @property
    def per_px(self) -> int:
        """Nodes of the image to a pixel."""
        return 1 if self.share else FREE_PER_PX

    @property
    def name(self) -> str:
        """For the table of candidates."""
        if self.degree < 0:
            return "diffraction"
        if not self.share:
            return f"free image, degree {self.degree}"
        within = "" if self.reach == 1 else f" within {self.reach:g} of the window"
        return f"diffraction, residual degree {self.degree} of {100 * self.size:g} %{within}"

    def half_px(self, half: tuple[int, int]) -> tuple[int, int]:
        """(rows, columns) to either side of the source that have a residual, in windows of this size."""
        return round(self.reach * half[0]), round(self.reach * half[1])

    def coefficients(self, half: tuple[int, int]) -> int:
        """Of the image for windows of this size."""
        rows, columns = (2 * self.per_px * size + 1 for size in self.half_px(half))
        return 3 * rows * columns * polynomial_terms(self.degree)


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
    """The residual chosen, and how well it predicts.

    Attributes:
        order: chosen, and ``candidates`` tried.
        image: the residual on pixels, as wide as it is needed; a single zero for none.
        sources: every shot's place and light.
        compared: what it expects of positions that were left out.
        held_out: its relative L2 error by colour there, noise included.
        error: of the kernel there, beside noise. relative_l2: what that makes of the kernel, mean over colours.
        support: how far these positions show its light.
    """

    order: Order
    candidates: tuple[Candidate, ...]
    image: Float[np.ndarray, "terms 3 rows columns"]
    sources: Sources
    compared: Compared
    held_out: Float[np.ndarray, "3"]
    error: KernelError
    relative_l2: float
    support: Support


@final
@dataclass(frozen=True)
class _Orders:
    """All shots with what diffraction ``explained`` of them per unit of light; ``magnitude`` of the mean kernel."""

    shots: Shots
    explained: Float[np.ndarray, "shots rows columns"]
    basis: Float[np.ndarray, "shots terms"]
    magnitude: Float[np.ndarray, "3 rows columns"]
    test: Bool[np.ndarray, " shots"]
    rules: PsfRules

    def attempt(self, sources: Sources, order: Order) -> Attempt[Trial]:
        """Solve from all shots but those held out, and compare with these."""
        windows = self._windows(sources, order)
        image = self._solve(windows.only(~self.test), order)
        found = compare(self.shots, windows, windows.expected(order.share, image), self.test)
        loss = found.loss(self.shots.position[self.test])
        trial = Trial(order, sources, found, loss)
        return Attempt(order.name, order.coefficients(self.shots.half), float(loss.mean()), trial)

    def image(self, trial: Trial, support: Support) -> Float[np.ndarray, "terms 3 rows columns"]:
        """The residual from all shots: beside diffraction as wide as it is needed, alone as far as light was seen."""
        order = trial.order
        if order.degree < 0:
            return np.zeros((1, 3, 1, 1))
        image = self._solve(self._windows(trial.sources, order), order)[: polynomial_terms(order.degree)]
        if order.share:
            return about_middle(image, order.half_px(self.shots.half))
        return about_middle(image[..., ::FREE_PER_PX, ::FREE_PER_PX], support.half_px)

    def rising(
        self, sources: Sources, share: float, sizes: Sequence[float], allowed: float, first: tuple[Attempt[Trial], ...]
    ) -> tuple[Attempt[Trial], ...]:
        """Rising degrees while they help, each of the size that predicts best; see ``engine.orders.rising``.

        There are never more terms than positions to fit them to. What one degree leaves out the next allows for.
        """
        positions = len(np.unique(self.shots.position[~self.test]))
        allowances = [allowed]

        def attempt(degree: int) -> Attempt[Trial]:
            orders = (Order(degree, share, size, allowances[-1]) for size in sizes)
            best = choose(self.attempt(sources, order) for order in orders).best
            allowances.append(best.fit.compared.model_error)
            return best

        degrees = [d for d in range(self.rules.highest_degree + 1) if polynomial_terms(d) <= positions]
        tried: list[Callable[[], Attempt[Trial]]] = [partial(lambda one: one, one) for one in first]
        return rising([*tried, *(partial(attempt, degree) for degree in degrees)], self.beats)

    def beats(self, one: Attempt[Trial], other: Attempt[Trial]) -> bool:
        """Whether it predicts what was held out better, by more than it costs."""
        return held_out_beats(one.fit.loss, other.fit.loss, self.rules.worth)

    def narrowed(self, best: Attempt[Trial]) -> tuple[Attempt[Trial], ...]:
        """Narrower residuals, up to the first that the whole window does not improve on; the last is the choice."""
        tried: list[Attempt[Trial]] = []
        for reach in self.rules.reaches:
            tried.append(self.attempt(best.fit.sources, replace(best.fit.order, reach=reach)))
            if not held_out_beats(best.fit.loss, tried[-1].fit.loss, self.rules.worth_of_room):
                return tuple(tried)
        return (*tried, best)

    def _windows(self, sources: Sources, order: Order) -> Windows:
        return make_windows(self.shots, sources, self.explained, self.basis, order.model_error, order.per_px)

    def _solve(self, windows: Windows, order: Order) -> Float[np.ndarray, "terms 3 node_rows node_columns"]:
        """The residual's image. Terms of higher degrees are there, too, without room: all orders compile to one."""
        sigma = prior_sigma(self.magnitude, order.size, order.per_px)
        y, x = (np.abs(np.arange(nodes) - nodes // 2) for nodes in sigma.shape[1:])
        half_rows, half_columns = (order.per_px * half for half in order.half_px(self.shots.half))
        room = (y <= half_rows)[:, None] & (x <= half_columns)
        terms = np.arange(self.basis.shape[1]) < polynomial_terms(order.degree)
        sigmas = terms[:, None, None, None] * (sigma * room)
        if order.degree < 0:
            return np.zeros_like(sigmas)
        scaled, _ = solve_image(windows, sigmas, order.share, None if order.share else np.zeros_like(sigmas))
        return np.asarray(image_of(scaled, sigmas, not order.share))


def select_field(
    shots: Shots,
    sources: Sources,
    explained: Float[np.ndarray, "shots rows columns"],
    unit_positions: Float[np.ndarray, "positions 2"],
    model_error: float,
    rules: PsfRules,
) -> Selection:
    """Try no residual, then residuals of rising degree while they help; if diffraction fails, do without it.

    Args:
        shots: all of them. sources: their places and light under the diffraction model.
        explained: per unit of light, what diffraction brings to every sample.
        unit_positions: of all positions, scaled to about [-1, 1].
        model_error: of diffraction alone, see ``psf.weights``.
        rules: see there.
    """
    magnitude = _mean_kernel(shots, sources)
    test = held_out_positions(shots.positions)[shots.position]
    basis = np.asarray(polynomial_basis(unit_positions, rules.highest_degree))[shots.position]
    orders = _Orders(shots, explained, basis, magnitude, test, rules)
    plain = orders.attempt(sources, Order(-1, 1.0, 0.0, model_error))
    tried = orders.rising(sources, 1.0, rules.residual_sizes, plain.fit.compared.model_error, (plain,))
    if np.sqrt((plain.fit.compared.relative_l2(shots.channel[test]) ** 2).mean()) > rules.doubtful:
        linear = polynomial_terms(1) if polynomial_terms(1) <= shots.positions else 1
        free = free_sources(shots, basis, linear, magnitude, rules.free_model_error)
        tried += orders.rising(free, 0.0, (1.0,), rules.free_model_error, ())
    best = tried[0]
    for attempt in tried[1:]:
        best = attempt if orders.beats(attempt, best) else best
    if best.fit.order.degree >= 0 and best.fit.order.share:
        narrower = orders.narrowed(best)
        tried, best = (*tried, *(one for one in narrower if one is not best)), narrower[-1]
    trial, channel = best.fit, shots.channel[test]
    support = choose_support(trial.compared)
    error = kernel_error(trial.compared, channel, trial.sources.pick(test))
    return Selection(
        order=trial.order,
        candidates=Choice(best, tried).candidates,
        image=orders.image(trial, support),
        sources=trial.sources,
        compared=trial.compared,
        held_out=trial.compared.relative_l2(channel),
        error=error,
        relative_l2=float(error.relative_l2(magnitude).mean()),
        support=support,
    )


def _mean_kernel(shots: Shots, sources: Sources) -> Float[np.ndarray, "3 rows columns"]:
    """How large the kernel is on average, by colour: data over light, smoothed across the mosaic."""
    colour = np.eye(3)[shots.channel] * (shots.weight > 0)[..., None]
    total = sources.flux.sum(axis=0) / max(len(sources.flux), 1)
    rate = np.abs(shots.rate - sources.background[:, None, None])
    summed = np.einsum("syx,syxc->cyx", rate, colour)
    kernel = (
        summed / np.maximum(colour.sum(axis=0).transpose(2, 0, 1), 1) / np.maximum(np.abs(total), 1e-30)[:, None, None]
    )
    return kernel / np.maximum(kernel.sum(axis=(1, 2), keepdims=True), 1e-30)
