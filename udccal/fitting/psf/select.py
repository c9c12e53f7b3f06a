"""Which residual the kernel needs, how wide, and how far light reaches: judged at positions that were left out."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from udccal.fitting.psf.free import PER_PX, fixed, image_of, movable, on_pixels, solve_free
from udccal.fitting.psf.kernel_error import KernelError
from udccal.fitting.psf.residual import Sources, about_middle, prior_spread
from udccal.fitting.psf.shots import Shots
from udccal.fitting.psf.support import Support, choose_support
from udccal.fitting.psf.trial import BESIDE, FREE, Data, Order, Trial, attempt, solve
from udccal.models.fields import polynomial_terms
from udccal.result import Candidate

# Of a free image, until positions that were held out tell.
_FIRST_MODEL_ERROR = 0.01
# Beyond this mismatch of diffraction alone, an image without diffraction is tried too.
_DOUBTFUL = 0.05
_HIGHEST, _IN_VAIN = 3, 2
# Parts of the window that may be enough for a residual, the narrowest first.
_REACHES = (0.25, 0.5)
# Of places and light together with a free image, which change by less than this (px; relatively).
_ROUNDS, _FARTHEST = 2, 0.7


@dataclass(frozen=True)
class Selection:
    """The residual chosen, and how well it predicts.

    Attributes:
        degree: of the residual's polynomials, -1 for none.
        share: of diffraction, 1 or 0.
        image: the residual on pixels, as wide as it is needed; a single zero for none.
        sources: every shot's place and light.
        held_out: relative L2 by colour at positions that were left out, noise included.
        error: of the kernel at these positions, beside noise.
        support: how far they show its light.
        relative_l2: what that error makes of the kernel, mean over colours.
        chi2_dof: mean square of the errors of their samples in units of sigma, a model error included.
        samples: how many they are.
        candidates: what was tried.
    """

    degree: int
    share: float
    image: Float[np.ndarray, "terms 3 rows columns"]
    sources: Sources
    held_out: Float[np.ndarray, "3"]
    error: KernelError
    support: Support
    relative_l2: float
    chi2_dof: float
    samples: int
    candidates: tuple[Candidate, ...]


def select_field(
    shots: Shots,
    sources: Sources,
    explained: Float[np.ndarray, "shots rows columns"],
    held_out: Bool[np.ndarray, " positions"],
    unit_positions: Float[np.ndarray, "positions 2"],
    model_error: float,
) -> Selection:
    """Try no residual, then residuals of rising degree while they help; if diffraction fails, do without it.

    Args:
        shots: all of them. sources: their places and light under the diffraction model.
        explained: per unit of light, what diffraction brings to every sample.
        held_out: positions left out while orders are compared.
        unit_positions: of all positions, scaled to about [-1, 1].
        model_error: of diffraction alone, see ``psf.weights``.
    """
    magnitude = _mean_kernel(shots, sources)
    data = Data(shots, explained, unit_positions[shots.position], magnitude)
    test = held_out[shots.position]
    plain = attempt(data, sources, test, Order(-1, 1.0, 0.0, model_error))
    trials = [plain, *_rising(data, sources, test, 1.0, plain, plain.judged.model_error)]
    if plain.relative_l2 > _DOUBTFUL:
        free = _free_sources(data, sources)
        trials += _rising(data, free, test, 0.0, None, _FIRST_MODEL_ERROR)
    best = trials[0]
    for trial in trials[1:]:
        best = trial if trial.beats(best) else best
    if best.order.degree >= 0 and best.order.share:
        best, narrower = _narrowed(data, test, best)
        trials += narrower
    support = choose_support(best.judged)
    errors = best.judged.errors()
    size = shots.rate.shape[1:]
    return Selection(
        degree=best.order.degree,
        share=best.order.share,
        image=_image(data, best, support),
        sources=best.sources,
        held_out=best.mismatch,
        error=best.error,
        support=support,
        relative_l2=float(best.error.relative_l2(magnitude).mean()),
        chi2_dof=float(np.mean(errors**2)),
        samples=len(errors),
        candidates=tuple(Candidate(t.order.name, t.order.coefficients(*size), t.criterion, t is best) for t in trials),
    )


def _rising(
    data: Data,
    sources: Sources,
    test: Bool[np.ndarray, " shots"],
    share: float,
    before: Trial | None,
    model_error: float,
) -> list[Trial]:
    """Degrees 0, 1, ... until two in a row do not help, each with the freedom that predicts best.

    There are never more terms than positions to fit them to. Two, since what grows from one side of the field to the
    other has no mean. What was left out by the degree before is what the next one allows for.
    """
    positions = len(np.unique(data.shots.position[~test]))
    trials: list[Trial] = []
    useless = 0
    for degree in range(_HIGHEST + 1):
        if polynomial_terms(degree) > positions or useless == _IN_VAIN:
            break
        allowed = trials[-1].judged.model_error if trials else model_error
        tried = [
            attempt(data, sources, test, Order(degree, share, freedom, allowed))
            for freedom in (BESIDE if share else (FREE,))
        ]
        trials.append(min(tried, key=lambda trial: trial.criterion))
        helps = before is None or trials[-1].beats(before)
        before, useless = (trials[-1], 0) if helps else (before, useless + 1)
    return trials


def _narrowed(data: Data, test: Bool[np.ndarray, " shots"], best: Trial) -> tuple[Trial, list[Trial]]:
    """The narrowest residual that the whole window does not improve on, and those that were tried for it."""
    tried: list[Trial] = []
    for reach in _REACHES:
        tried.append(attempt(data, best.sources, test, replace(best.order, reach=reach)))
        if not best.needs_room_of(tried[-1]):
            return tried[-1], tried
    return best, tried


def _image(data: Data, best: Trial, support: Support) -> Float[np.ndarray, "terms 3 rows columns"]:
    """The residual from all shots: beside diffraction as wide as it is needed, alone as far as light was seen."""
    order = best.order
    if order.degree < 0:
        return np.zeros((1, 3, 1, 1))
    image = solve(data, best.sources, np.ones(data.shots.count, dtype=bool), order)
    image = image if order.share else on_pixels(image)
    return about_middle(image, order.half_px(*image.shape[2:]) if order.share else support.half_px)


def _mean_kernel(shots: Shots, sources: Sources) -> Float[np.ndarray, "3 rows columns"]:
    """How large the kernel is on average, by colour: data over light, smoothed across the mosaic."""
    colour = np.eye(3)[shots.channel] * (shots.weight > 0)[..., None]
    total = sources.flux.sum(axis=0) / max(len(sources.flux), 1)
    rate = np.abs(shots.rate - sources.background[:, None, None])
    summed = np.einsum("syx,syxc->cyx", rate, colour)
    count = np.einsum("syxc->cyx", colour)
    kernel = summed / np.maximum(count, 1) / np.maximum(np.abs(total), 1e-30)[:, None, None]
    return kernel / np.maximum(kernel.sum(axis=(1, 2), keepdims=True), 1e-30)


def _free_sources(data: Data, sources: Sources) -> Sources:
    """Places and light when diffraction explains nothing: from the crops themselves, then along with the image."""
    shots = data.shots
    colour = np.eye(3)[shots.channel] * (shots.weight > 0)[..., None]
    light = np.einsum("syx,syxc->sc", shots.rate, colour)
    covered = np.einsum("cyx,syxc->sc", data.magnitude, colour)
    start = Sources(shots.centre_px, light / np.maximum(covered, 1e-6), np.zeros(shots.count))
    degree = 1 if polynomial_terms(1) <= len(np.unique(shots.position)) else 0
    order = Order(degree, 0.0, FREE, _FIRST_MODEL_ERROR)
    spread = prior_spread(data.magnitude, order.terms, order.freedom, PER_PX)
    every = np.ones(shots.count, dtype=bool)
    free, changed = start, np.zeros((shots.count, 5))
    windows = data.windows(free, order, every)
    scaled, _ = solve_free(windows, spread, fixed(windows), np.zeros_like(spread))
    for _ in range(_ROUNDS):
        own = movable(shots, free, windows, np.asarray(image_of(scaled, spread)), changed)
        scaled, found = solve_free(windows, spread, own, scaled)
        changed = np.clip(_within_positions(np.asarray(found), shots.position), -_FARTHEST, _FARTHEST)
        free = replace(start, place_px=start.place_px + changed[:, :2], flux=start.flux * (1.0 + changed[:, 2:]))
        windows = data.windows(free, order, every)
    return free


def _within_positions(
    values: Float[np.ndarray, "shots 5"], position: Int[np.ndarray, " shots"]
) -> Float[np.ndarray, "shots 5"]:
    """What differs among the shots of a position: what is common to them, a change of the image there does as well."""
    total = np.zeros((int(position.max()) + 1, values.shape[1]))
    np.add.at(total, position, values)
    return values - (total / np.maximum(np.bincount(position), 1)[:, None])[position]
