"""Sub-pixel position of chessboard corners: a blurred saddle fitted to the samples in a round window.

Model, with u the offset from the corner p and n1, n2 the unit normals of the two edges,

    I(u) = b + g . u + A erf(n1 . u / (sqrt(2) s1)) erf(n2 . u / (sqrt(2) s2)).

The two edges have their own widths, so blur along one direction only (diffraction streaks) fits. The model is even
about p and the window is centred on p, so blur that the model does not describe, but which is symmetric, moves nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import erf

from udccal.fitting.geometry.luminance import Luminance, filtered

_ROUNDS = 12
# Of half the step over what the saddle leaves of the samples: less is no corner.
_MIN_CONTRAST = 6.0
_WORST_SIGMA_PX = 1.0


@dataclass(frozen=True)
class Saddles:
    """Fitted corners, their sigma by noise; not ``ok``: out of the picture, moved away, or without contrast."""

    xy: Float[np.ndarray, "n 2"]
    sigma: Float[np.ndarray, " n"]
    ok: Bool[np.ndarray, " n"]


def fit_saddles(
    picture: Luminance,
    start: Float[np.ndarray, "n 2"],
    axes: Float[np.ndarray, "n 2 2"],
    radius: Float[np.ndarray, " n"],
) -> Saddles:
    """Place corners (Gauss-Newton with damping, all corners at once).

    Args:
        picture: grey, with the variance of its samples.
        start: rough corners in px, off by less than about half a radius.
        axes: per corner the two edge directions (rows), any length.
        radius: window radius per corner in px.
    """
    rows, columns = picture.grey.shape
    half = int(np.ceil(radius.max())) + 1
    base = np.round(start).astype(np.int64)
    inside = np.all((base >= half) & (base < np.array([columns - half, rows - half])), axis=1)
    base = np.clip(base, half, np.array([columns - half - 1, rows - half - 1]))
    samples, offsets = _windows(picture.grey, base, half)
    variance, _ = _windows(picture.variance, base, half)
    angles = np.arctan2(axes[..., 0], -axes[..., 1])
    shape = np.concatenate([start - base, angles, np.full((len(start), 2), np.log(1.5))], axis=1)
    damping = np.full(len(start), 1e-3)
    cost, linear = _evaluate(shape, samples, offsets, radius)[:2]
    for _ in range(_ROUNDS):
        step = _step(shape, linear, samples, offsets, radius, damping)
        trial = shape + np.clip(step, -1.0, 1.0)
        trial[:, 4:] = np.clip(trial[:, 4:], np.log(0.3), np.log(20.0))
        trial_cost, trial_linear = _evaluate(trial, samples, offsets, radius)[:2]
        better = trial_cost < cost
        shape = np.where(better[:, None], trial, shape)
        linear = np.where(better[:, None], trial_linear, linear)
        cost = np.where(better, trial_cost, cost)
        damping = np.clip(np.where(better, damping / 5, damping * 10), 1e-9, 1e9)
    sigma = _noise_sigma(shape, linear, variance, offsets, radius)
    misfit = np.sqrt(cost / np.maximum(_parts(shape, offsets, radius)[1].sum(-1) - 10, 1.0))
    xy = base + shape[:, :2]
    near = np.linalg.norm(xy - start, axis=1) < np.maximum(radius / 2, 3.0)
    contrast = np.abs(linear[:, 3]) > _MIN_CONTRAST * misfit
    ok = inside & near & contrast & (sigma < _WORST_SIGMA_PX)
    return Saddles(xy=xy, sigma=sigma, ok=ok & np.isfinite(xy).all(axis=1))


def _windows(
    picture: Float[np.ndarray, "rows columns"], base: Int[np.ndarray, "n 2"], half: int
) -> tuple[Float[np.ndarray, "n m"], Float[np.ndarray, "m 2"]]:
    span = np.arange(-half, half + 1)
    dy, dx = (a.ravel() for a in np.meshgrid(span, span, indexing="ij"))
    samples = picture[base[:, 1, None] + dy, base[:, 0, None] + dx]
    return samples, np.stack([dx, dy], axis=1).astype(np.float64)


def _parts(
    shape: Float[np.ndarray, "n 6"], offsets: Float[np.ndarray, "m 2"], radius: Float[np.ndarray, " n"]
) -> tuple[
    Float[np.ndarray, "n m 2"],
    Float[np.ndarray, "n m"],
    Float[np.ndarray, "n 2 2"],
    Float[np.ndarray, "n 2"],
    Float[np.ndarray, "n 2 m"],
]:
    """Offsets from the corner, window weights, and both edges' profiles with their arguments."""
    u = offsets[None] - shape[:, None, :2]
    r2 = (u**2).sum(-1) / radius[:, None] ** 2
    weight = np.clip(1 - r2, 0.0, None)
    normals = np.stack([np.cos(shape[:, 2:4]), np.sin(shape[:, 2:4])], axis=-1)
    width = np.exp(shape[:, 4:6])
    t = np.einsum("nmi,nki->nkm", u, normals) / width[..., None]
    return u, weight, normals, width, t


def _evaluate(
    shape: Float[np.ndarray, "n 6"],
    samples: Float[np.ndarray, "n m"],
    offsets: Float[np.ndarray, "m 2"],
    radius: Float[np.ndarray, " n"],
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 4"], Float[np.ndarray, "n m"], Float[np.ndarray, "n m"]]:
    """Cost per corner with the linear part (b, g, A) at its best, that linear part, residuals and window weights."""
    u, weight, _, _, t = _parts(shape, offsets, radius)
    profile = erf(t / np.sqrt(2.0))
    design = np.stack([np.ones_like(samples), u[..., 0], u[..., 1], profile[:, 0] * profile[:, 1]], axis=-1)
    normal = np.einsum("nmi,nm,nmj->nij", design, weight, design) + 1e-9 * np.eye(4)
    right = np.einsum("nmi,nm,nm->ni", design, weight, samples)
    linear = np.linalg.solve(normal, right[..., None])[..., 0]
    residual = samples - np.einsum("nmi,ni->nm", design, linear)
    return (weight * residual**2).sum(-1), linear, residual, weight


def _jacobian(
    shape: Float[np.ndarray, "n 6"],
    linear: Float[np.ndarray, "n 4"],
    offsets: Float[np.ndarray, "m 2"],
    radius: Float[np.ndarray, " n"],
) -> tuple[Float[np.ndarray, "n m 10"], Float[np.ndarray, "n m"]]:
    """Derivative of the model by (px, py, angle1, angle2, log s1, log s2, b, gx, gy, A), and the window weights."""
    u, weight, normals, width, t = _parts(shape, offsets, radius)
    profile = erf(t / np.sqrt(2.0))
    slope = np.sqrt(2 / np.pi) * np.exp(-(t**2) / 2)
    other = profile[:, ::-1]
    common = linear[:, 3, None, None] * slope * other
    position = -np.einsum("nkm,nki->nmi", common / width[..., None], normals) - linear[:, None, 1:3]
    tangents = np.stack([-normals[..., 1], normals[..., 0]], axis=-1)
    turn = common * np.einsum("nmi,nki->nkm", u, tangents) / width[..., None]
    grow = -common * t
    design = [np.ones_like(t[:, 0]), u[..., 0], u[..., 1], profile[:, 0] * profile[:, 1]]
    return np.concatenate(
        [position, np.moveaxis(turn, 1, 2), np.moveaxis(grow, 1, 2), np.stack(design, axis=-1)], axis=-1
    ), weight


def _step(
    shape: Float[np.ndarray, "n 6"],
    linear: Float[np.ndarray, "n 4"],
    samples: Float[np.ndarray, "n m"],
    offsets: Float[np.ndarray, "m 2"],
    radius: Float[np.ndarray, " n"],
    damping: Float[np.ndarray, " n"],
) -> Float[np.ndarray, "n 6"]:
    """Damped Gauss-Newton step of the shape; the linear part follows by itself."""
    jacobian, weight = _jacobian(shape, linear, offsets, radius)
    residual = _evaluate(shape, samples, offsets, radius)[2]
    normal = np.einsum("nmi,nm,nmj->nij", jacobian, weight, jacobian)
    diagonal = np.einsum("nii->ni", normal)
    normal = normal + (damping[:, None] * diagonal + 1e-12 * diagonal.max(1, keepdims=True) + 1e-30)[
        :, :, None
    ] * np.eye(10)
    right = np.einsum("nmi,nm,nm->ni", jacobian, weight, residual)
    return np.linalg.solve(normal, right[..., None])[:, :6, 0]


def _noise_sigma(
    shape: Float[np.ndarray, "n 6"],
    linear: Float[np.ndarray, "n 4"],
    variance: Float[np.ndarray, "n m"],
    offsets: Float[np.ndarray, "m 2"],
    radius: Float[np.ndarray, " n"],
) -> Float[np.ndarray, " n"]:
    """One sigma by axis in px that the samples' noise gives, through the filter and the window's weights.

    Least squares of weights W moves a corner by G = (J' W J)^-1 J' W per filtered sample: the covariance is a sandwich.
    """
    jacobian, weight = _jacobian(shape, linear, offsets, radius)
    normal = np.einsum("nmi,nm,nmj->nij", jacobian, weight, jacobian)
    moves = np.einsum("nip,nmp,nm->nim", np.linalg.pinv(normal, hermitian=True)[:, :2], jacobian, weight)
    side = int(np.sqrt(len(offsets)))
    by_sample = filtered(moves.reshape(*moves.shape[:2], side, side)).reshape(moves.shape)
    return np.sqrt(np.einsum("nim,nm->n", by_sample**2, variance) / 2)
