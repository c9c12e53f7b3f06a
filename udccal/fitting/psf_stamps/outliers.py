"""Samples and stars that a psf field does not explain: found by a stated rule, and taken back once it does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from udccal.fitting.psf_stamps.likelihood import expectation
from udccal.fitting.psf_stamps.state import Scene, State
from udccal.result import Outliers

_SIGMA, _STAR_RATIO, _MEDIAN_OF_CHI2 = 5.0, 3.0, 0.455
_STEPS, _FARTHEST_PX = 4, 0.5
_SHOWN = 8


def without_outliers(scene: Scene, state: State) -> State:
    """The state without samples, and stars, that the model does not explain; those it does explain come back."""
    out = ~np.any([keep.any(axis=1) for keep in state.keep], axis=0)
    everything = replace(state, keep=tuple(np.ones_like(keep) for keep in state.keep))
    if out.any():
        # Left alone, a star that was out would be judged by the place and light it had when the field was coarse.
        everything = _placed(scene, everything, out)
        state = replace(everything, keep=state.keep)
    squares = [_squares(scene, everything, plane) for plane in range(len(scene.planes))]
    # Noise that is larger than stated makes no outliers of all: the residuals' own median sets the scale.
    used = np.concatenate([z2[plane.usable] for z2, plane in zip(squares, scene.planes, strict=True)])
    scale = max(float(np.median(used[used > 0])) / _MEDIAN_OF_CHI2, 1.0) if (used > 0).any() else 1.0
    keep = [z2 <= scale * _SIGMA**2 for z2 in squares]
    bad = _bad_stars(squares, keep, scene)
    return replace(state, keep=tuple(k & ~bad[:, None] for k in keep))


def listed(scene: Scene, state: State) -> tuple[Outliers, ...]:
    """What the state leaves out: the rules, how many, and the first places."""
    stars = [k for k in range(len(scene.unit)) if not any(keep[k].any() for keep in state.keep)]
    places = []
    for plane, keep in zip(scene.planes, state.keep, strict=True):
        for star, sample in np.argwhere(plane.usable & ~keep):
            if star not in stars:
                x, y = plane.offset_px[star, sample]
                places.append(f"stamp {star}, {x:+.0f} px, {y:+.0f} px from its middle")
    out = []
    if places:
        rule = f"samples off by more than {_SIGMA:g} sigma of their noise under the model"
        out.append(Outliers(rule, len(places), tuple(places[:_SHOWN])))
    if stars:
        rule = (
            f"stamps whose mean square is over {_STAR_RATIO:g} times the median's, or a fifth of whose samples are off"
        )
        out.append(Outliers(rule, len(stars), tuple(f"stamp {k}" for k in stars[:_SHOWN])))
    return tuple(out)


def _squares(scene: Scene, state: State, plane: int) -> Float[np.ndarray, "stars samples"]:
    """Of residuals in units of their sigma; 0 for clipped samples, which cannot be far off in one direction."""
    seen, _ = expectation(scene, state, plane)
    return np.where(scene.planes[plane].clipped, 0.0, seen.residual**2 * seen.weight)


def _bad_stars(
    squares: list[Float[np.ndarray, "stars _samples"]], keep: list[Bool[np.ndarray, "stars _samples"]], scene: Scene
) -> Bool[np.ndarray, " stars"]:
    """Stars whose mean square is far above that of the others, or most of whose light is left out."""
    used = [k & plane.usable for k, plane in zip(keep, scene.planes, strict=True)]
    total = sum((np.where(u, z2, 0.0).sum(axis=1) for u, z2 in zip(used, squares, strict=True)), np.zeros(1))
    count = sum((u.sum(axis=1) for u in used), np.zeros(1))
    lost = sum(((plane.usable & ~k).sum(axis=1) for k, plane in zip(keep, scene.planes, strict=True)), np.zeros(1))
    mean = total / np.maximum(count, 1)
    return (mean > _STAR_RATIO * np.median(mean)) | (lost > 0.2 * np.maximum(count + lost, 1))


def _placed(scene: Scene, state: State, stars: Bool[np.ndarray, " stars"]) -> State:
    """Some stars' places and light fitted anew, the field being as it is."""
    planes = len(scene.planes)
    for _ in range(_STEPS):
        normal = np.zeros((len(stars), 2 + planes, 2 + planes))
        right = np.zeros((len(stars), 2 + planes))
        for plane in range(planes):
            seen, _ = expectation(scene, state, plane)
            own = np.array([0, 1, 2 + plane])
            slopes = seen.slopes[..., [1, 2, 0]]
            normal[:, own[:, None], own] += np.einsum("ksi,ks,ksj->kij", slopes, seen.weight, slopes)
            right[:, own] += np.einsum("ksi,ks->ki", slopes, seen.weight * seen.residual)
        size = np.einsum("kii->ki", normal)
        normal += np.eye(2 + planes) * (1e-9 * size + (size <= 0))[:, None, :]
        move = np.where(stars[:, None], np.linalg.solve(normal, right[..., None])[..., 0], 0.0)
        move = np.clip(move, -_FARTHEST_PX, _FARTHEST_PX)
        state = replace(state, centre_px=state.centre_px + move[:, :2], flux_e=state.flux_e * np.exp(move[:, 2:]))
    return state
