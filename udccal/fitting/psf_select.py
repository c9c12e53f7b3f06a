"""Which residual the kernel needs: tried order by order, judged at positions that were left out."""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from udccal.fitting.psf_residual import (
    Sources,
    Windows,
    make_windows,
    mismatch,
    prior_spread,
    refine_sources,
    solve_residual,
)
from udccal.fitting.psf_shots import Shots
from udccal.fitting.result import Candidate
from udccal.models.fields import polynomial_terms

_MODEL_ERROR = 0.01
# On top of diffraction the residual may be this fraction of the kernel nearby; free, it may be all of it.
_BESIDE, _FREE = 0.1, 1.0
# A higher order must lower the mismatch by this factor to be worth its coefficients.
_WORTH = 0.9
# Beyond this mismatch of diffraction alone, an image without diffraction is tried too.
_DOUBTFUL = 0.05
_HIGHEST = 3


@dataclass(frozen=True)
class Selection:
    """The residual chosen, and how well it predicts."""

    degree: int
    share: float
    image: Float[np.ndarray, "terms 3 rows columns"]
    sources: Sources
    held_out: Float[np.ndarray, "3"]
    candidates: tuple[Candidate, ...]


@dataclass(frozen=True)
class _Trial:
    name: str
    degree: int
    share: float
    sources: Sources
    mismatch: Float[np.ndarray, "3"]

    @property
    def criterion(self) -> float:
        return float(np.sqrt((self.mismatch**2).mean()))


@dataclass(frozen=True)
class _Data:
    """Shots with what diffraction explains of them."""

    shots: Shots
    explained: Float[np.ndarray, "shots rows columns"]
    unit: Float[np.ndarray, "shots 2"]

    def windows(self, sources: Sources, degree: int, keep: Bool[np.ndarray, " shots"]) -> Windows:
        half = (self.shots.rate.shape[1] // 2, self.shots.rate.shape[2] // 2)
        return make_windows(
            self.shots.pick(keep), sources.pick(keep), self.explained[keep], half, self.unit[keep], degree, _MODEL_ERROR
        )


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
    trials = [plain, *_rising(data, sources, test, 1.0, magnitude, plain.criterion)]
    if plain.criterion > _DOUBTFUL:
        free = _free_sources(data, sources, magnitude)
        trials += _rising(data, free, test, 0.0, magnitude, np.inf)
    best = trials[0]
    for trial in trials[1:]:
        best = trial if trial.criterion < _WORTH * best.criterion else best
    image = _solve(data, best.sources, np.ones(shots.count, dtype=bool), best.degree, best.share, magnitude)
    size = int(np.prod(shots.rate.shape[1:])) * 3
    candidates = tuple(Candidate(t.name, size * polynomial_terms(t.degree), t.criterion, t is best) for t in trials)
    return Selection(best.degree, best.share, image, best.sources, best.mismatch, candidates)


def _rising(
    data: _Data, sources: Sources, test: Bool[np.ndarray, " shots"], share: float, magnitude: np.ndarray, before: float
) -> list[_Trial]:
    """Degrees 0, 1, ... until one does not help; never more terms than positions to fit them to."""
    positions = len(np.unique(data.shots.position[~test]))
    trials: list[_Trial] = []
    for degree in range(_HIGHEST + 1):
        if polynomial_terms(degree) > positions:
            break
        trials.append(_trial(data, sources, test, degree, share, magnitude))
        if trials[-1].criterion > _WORTH * before:
            break
        before = trials[-1].criterion
    return trials


def _trial(
    data: _Data, sources: Sources, test: Bool[np.ndarray, " shots"], degree: int, share: float, magnitude: np.ndarray
) -> _Trial:
    image = _solve(data, sources, ~test, degree, share, magnitude)
    error = mismatch(data.windows(sources, max(degree, 0), test), share, image)
    kind = "diffraction" if share else "free image"
    name = kind if degree < 0 else f"{kind}, residual degree {degree}" if share else f"{kind}, degree {degree}"
    return _Trial(name, degree, share, sources, error)


def _solve(
    data: _Data, sources: Sources, keep: Bool[np.ndarray, " shots"], degree: int, share: float, magnitude: np.ndarray
) -> Float[np.ndarray, "terms 3 rows columns"]:
    shape = (polynomial_terms(max(degree, 0)), *magnitude.shape)
    if degree < 0:
        return np.zeros(shape)
    spread = prior_spread(magnitude, shape[0], _BESIDE if share else _FREE)
    windows = data.windows(sources, degree, keep)
    return np.asarray(solve_residual(windows, jnp.asarray(share), jnp.asarray(spread)))


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
    """Places and light when diffraction explains nothing: from the crops themselves, then from the image they give."""
    shots = data.shots
    colour = np.eye(3)[shots.channel] * (shots.weight > 0)[..., None]
    light = np.einsum("syx,syxc->sc", shots.rate, colour)
    covered = np.einsum("cyx,syxc->sc", magnitude, colour)
    free = Sources(shots.centre_px, light / np.maximum(covered, 1e-6), np.zeros(shots.count))
    every = np.ones(shots.count, dtype=bool)
    enough = polynomial_terms(1) <= len(np.unique(shots.position))
    for degree in (0, 1) if enough else (0,):
        image = _solve(data, free, every, degree, 0.0, magnitude)
        free = refine_sources(shots, free, data.windows(free, degree, every), image)
        free = replace(free, flux=free.flux * image[0].sum(axis=(1, 2)))
    return free
