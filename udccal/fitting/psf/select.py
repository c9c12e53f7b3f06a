"""Which residual the kernel needs: tried order by order, judged at positions that were left out."""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from udccal.fitting.psf.free import PER_PX, fixed, image_of, movable, on_pixels, solve_free
from udccal.fitting.psf.residual import (
    Sources,
    Windows,
    loss_by_shot,
    make_windows,
    mismatch,
    normalised_errors,
    prior_spread,
    solve_residual,
)
from udccal.fitting.psf.shots import Shots
from udccal.fitting.result import Candidate
from udccal.models.fields import polynomial_terms

_MODEL_ERROR = 0.01
# On top of diffraction the residual may be this fraction of the kernel nearby; free, it may be all of it.
_BESIDE, _FREE = 0.1, 1.0
# A higher order must lower the held-out loss by this share, and by a standard error, to be worth its coefficients.
_WORTH = 0.02
# Beyond this mismatch of diffraction alone, an image without diffraction is tried too.
_DOUBTFUL = 0.05
_HIGHEST = 3
# Of places and light together with a free image, which change by less than this (px; relatively).
_ROUNDS, _FARTHEST = 2, 0.7


@dataclass(frozen=True)
class Selection:
    """The residual chosen, and how well it predicts.

    Attributes:
        degree: of the residual's polynomials, -1 for none.
        share: of diffraction, 1 or 0.
        image: the residual on pixels; a single zero for none.
        sources: every shot's place and light.
        held_out: relative L2 by colour at positions that were left out.
        chi2_dof: mean square of all samples' errors in units of their sigma, a model error of 1 % allowed for.
        samples: how many they are.
        candidates: what was tried.
    """

    degree: int
    share: float
    image: Float[np.ndarray, "terms 3 rows columns"]
    sources: Sources
    held_out: Float[np.ndarray, "3"]
    chi2_dof: float
    samples: int
    candidates: tuple[Candidate, ...]


@dataclass(frozen=True)
class _Trial:
    name: str
    degree: int
    share: float
    sources: Sources
    mismatch: Float[np.ndarray, "3"]
    loss: Float[np.ndarray, " places"]

    @property
    def criterion(self) -> float:
        """Minus twice the logarithm of the held-out likelihood per sample, but for a constant."""
        return float(self.loss.mean())

    @property
    def relative_l2(self) -> float:
        return float(np.sqrt((self.mismatch**2).mean()))

    def beats(self, other: _Trial) -> bool:
        """Whether it predicts what was held out better, beyond what the places held out leave in doubt."""
        gain = other.loss - self.loss
        doubt = float(gain.std(ddof=1) / np.sqrt(gain.size)) if gain.size > 1 else np.inf
        return float(gain.mean()) > max(doubt, _WORTH * other.criterion)


@dataclass(frozen=True)
class _Data:
    """Shots with what diffraction explains of them."""

    shots: Shots
    explained: Float[np.ndarray, "shots rows columns"]
    unit: Float[np.ndarray, "shots 2"]

    def windows(self, sources: Sources, degree: int, share: float, keep: Bool[np.ndarray, " shots"]) -> Windows:
        half = (self.shots.rate.shape[1] // 2, self.shots.rate.shape[2] // 2)
        shots, own = self.shots.pick(keep), sources.pick(keep)
        parts = (self.explained[keep], half, self.unit[keep], degree, _MODEL_ERROR, _per_px(share))
        return make_windows(shots, own, *parts)


def select_field(
    shots: Shots,
    sources: Sources,
    explained: Float[np.ndarray, "shots rows columns"],
    held_out: Bool[np.ndarray, " positions"],
    unit_positions: Float[np.ndarray, "positions 2"],
) -> Selection:
    """Try no residual, then residuals of rising degree while they help; if diffraction fails, do without it.

    Args:
        shots: all of them. sources: their places and light under the diffraction model.
        explained: per unit of light, what diffraction brings to every sample.
        held_out: positions left out while orders are compared.
        unit_positions: of all positions, scaled to about [-1, 1].
    """
    data = _Data(shots, explained, unit_positions[shots.position])
    test = held_out[shots.position]
    magnitude = _mean_kernel(data, sources)
    plain = _trial(data, sources, test, -1, 1.0, magnitude)
    trials = [plain, *_rising(data, sources, test, 1.0, magnitude, plain)]
    if plain.relative_l2 > _DOUBTFUL:
        free = _free_sources(data, sources, magnitude)
        trials += _rising(data, free, test, 0.0, magnitude, None)
    best = trials[0]
    for trial in trials[1:]:
        best = trial if trial.beats(best) else best
    every = np.ones(shots.count, dtype=bool)
    image = _solve(data, best.sources, every, best.degree, best.share, magnitude)
    errors = normalised_errors(data.windows(best.sources, max(best.degree, 0), best.share, every), best.share, image)
    return Selection(
        degree=best.degree,
        share=best.share,
        image=np.zeros((1, 3, 1, 1)) if best.degree < 0 else image if best.share else on_pixels(image),
        sources=best.sources,
        held_out=best.mismatch,
        chi2_dof=float(np.mean(errors**2)),
        samples=len(errors),
        candidates=tuple(Candidate(t.name, _size(t, shots), t.criterion, t is best) for t in trials),
    )


def _per_px(share: float) -> int:
    return 1 if share else PER_PX


def _size(trial: _Trial, shots: Shots) -> int:
    """Coefficients of a trial's image."""
    per_px = _per_px(trial.share)
    rows, columns = (per_px * (size - 1) + 1 for size in shots.rate.shape[1:])
    return 3 * rows * columns * polynomial_terms(trial.degree)


def _rising(
    data: _Data,
    sources: Sources,
    test: Bool[np.ndarray, " shots"],
    share: float,
    magnitude: np.ndarray,
    before: _Trial | None,
) -> list[_Trial]:
    """Degrees 0, 1, ... until one does not help; never more terms than positions to fit them to."""
    positions = len(np.unique(data.shots.position[~test]))
    trials: list[_Trial] = []
    for degree in range(_HIGHEST + 1):
        if polynomial_terms(degree) > positions:
            break
        trials.append(_trial(data, sources, test, degree, share, magnitude))
        if before is not None and not trials[-1].beats(before):
            break
        before = trials[-1]
    return trials


def _trial(
    data: _Data, sources: Sources, test: Bool[np.ndarray, " shots"], degree: int, share: float, magnitude: np.ndarray
) -> _Trial:
    image = _solve(data, sources, ~test, degree, share, magnitude)
    windows = data.windows(sources, max(degree, 0), share, test)
    error = mismatch(windows, share, image)
    loss = _by_place(loss_by_shot(windows, share, image), data.shots.position[test])
    kind = "diffraction" if share else "free image"
    name = kind if degree < 0 else f"{kind}, residual degree {degree}" if share else f"{kind}, degree {degree}"
    return _Trial(name, degree, share, sources, error, loss)


def _by_place(loss: Float[np.ndarray, " shots"], position: Int[np.ndarray, " shots"]) -> Float[np.ndarray, " places"]:
    """Means by position: pictures of one share what the model leaves out there. Of a single position, its pictures'."""
    places = np.unique(position)
    return np.array([loss[position == place].mean() for place in places]) if len(places) > 1 else loss


def _solve(
    data: _Data, sources: Sources, keep: Bool[np.ndarray, " shots"], degree: int, share: float, magnitude: np.ndarray
) -> Float[np.ndarray, "terms 3 node_rows node_columns"]:
    spread = prior_spread(magnitude, polynomial_terms(max(degree, 0)), _BESIDE if share else _FREE, _per_px(share))
    if degree < 0:
        return np.zeros_like(spread)
    windows = data.windows(sources, degree, share, keep)
    if share:
        return np.asarray(solve_residual(windows, jnp.asarray(share), jnp.asarray(spread)))
    scaled, _ = solve_free(windows, spread, fixed(windows), np.zeros_like(spread))
    return np.asarray(image_of(scaled, spread))


def _mean_kernel(data: _Data, sources: Sources) -> Float[np.ndarray, "3 rows columns"]:
    """How large the kernel is on average, by colour: data over light, smoothed across the mosaic."""
    colour = np.eye(3)[data.shots.channel] * (data.shots.weight > 0)[..., None]
    total = sources.flux.sum(axis=0) / max(len(sources.flux), 1)
    rate = np.abs(data.shots.rate - sources.background[:, None, None])
    summed = np.einsum("syx,syxc->cyx", rate, colour)
    count = np.einsum("syxc->cyx", colour)
    kernel = summed / np.maximum(count, 1) / np.maximum(np.abs(total), 1e-30)[:, None, None]
    return kernel / np.maximum(kernel.sum(axis=(1, 2), keepdims=True), 1e-30)


def _free_sources(data: _Data, sources: Sources, magnitude: np.ndarray) -> Sources:
    """Places and light when diffraction explains nothing: from the crops themselves, then along with the image."""
    shots = data.shots
    colour = np.eye(3)[shots.channel] * (shots.weight > 0)[..., None]
    light = np.einsum("syx,syxc->sc", shots.rate, colour)
    covered = np.einsum("cyx,syxc->sc", magnitude, colour)
    start = Sources(shots.centre_px, light / np.maximum(covered, 1e-6), np.zeros(shots.count))
    degree = 1 if polynomial_terms(1) <= len(np.unique(shots.position)) else 0
    spread = prior_spread(magnitude, polynomial_terms(degree), _FREE, PER_PX)
    every = np.ones(shots.count, dtype=bool)
    free, changed = start, np.zeros((shots.count, 5))
    windows = data.windows(free, degree, 0.0, every)
    scaled, _ = solve_free(windows, spread, fixed(windows), np.zeros_like(spread))
    for _ in range(_ROUNDS):
        own = movable(shots, free, windows, np.asarray(image_of(scaled, spread)), changed)
        scaled, found = solve_free(windows, spread, own, scaled)
        changed = np.clip(_within_positions(np.asarray(found), shots.position), -_FARTHEST, _FARTHEST)
        free = replace(start, place_px=start.place_px + changed[:, :2], flux=start.flux * (1.0 + changed[:, 2:]))
        windows = data.windows(free, degree, 0.0, every)
    return free


def _within_positions(
    values: Float[np.ndarray, "shots 5"], position: Int[np.ndarray, " shots"]
) -> Float[np.ndarray, "shots 5"]:
    """What differs among the shots of a position: what is common to them, a change of the image there does as well."""
    total = np.zeros((int(position.max()) + 1, values.shape[1]))
    np.add.at(total, position, values)
    return values - (total / np.maximum(np.bincount(position), 1)[:, None])[position]
