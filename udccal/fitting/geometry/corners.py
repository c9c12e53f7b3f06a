"""Inner corners of a ChArUco board in a raw mosaic, to a few hundredths of a pixel.

OpenCV's detector numbers the corners. A blurred saddle, fitted to the samples around each, then gives its place:

    I(u) = b + g . u + A erf(n1 . u / (sqrt(2) s1)) erf(n2 . u / (sqrt(2) s2)),

with u the offset from the corner and n1, n2 the unit normals of the two edges. Each edge has its own width, so that
blur along one direction (diffraction streaks) fits. Model and window are even about the corner: symmetric blur that
the model does not describe moves no corner.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import cv2
import numpy as np
from jaxtyping import Float, Int
from scipy.ndimage import convolve1d
from scipy.special import erf

from udccal.arrangements import BoardSpec
from udccal.board.charuco import board_points_mm, charuco_board
from udccal.cfa import cfa_named
from udccal.fitting.geometry.bundle import RULES, GeometryRules

Picture = Float[np.ndarray, "rows columns"]


def luminance(mosaic: Picture, variance: Picture) -> tuple[Picture, Picture]:
    """Grey picture of a black-and-white subject, and the variance of its samples before they were filtered.

    The four sites of the pattern are scaled to one mean and averaged with the filter (1 2 1) x (1 2 1) / 16. It gives
    each site one quarter at every pixel and is symmetric: that removes the pattern and moves no edge.
    """
    grey, spread = np.asarray(mosaic, dtype=np.float64).copy(), np.asarray(variance, dtype=np.float64).copy()
    total = max(float(grey.mean()), 1e-12)
    for site in cfa_named("RGGB").sites:  # Any pattern of 2 x 2 has these sites.
        gain = total / max(float(grey[site.samples].mean()), 1e-12)
        grey[site.samples] *= gain
        spread[site.samples] *= gain**2
    return _filtered(grey), spread


def _filtered(picture: Float[np.ndarray, "*stack rows columns"]) -> Float[np.ndarray, "*stack rows columns"]:
    taps = np.array([0.25, 0.5, 0.25])
    return np.asarray(convolve1d(convolve1d(picture, taps, axis=-2), taps, axis=-1), dtype=np.float64)


@final
@dataclass(frozen=True)
class BoardCorners:
    """Corners found: their numbers on the board, their places in the picture, and one sigma of these in px by noise."""

    ids: Int[np.ndarray, " n"]
    xy: Float[np.ndarray, "n 2"]
    sigma: Float[np.ndarray, " n"]


def detect_corners(mosaic: Picture, variance: Picture, spec: BoardSpec, rules: GeometryRules = RULES) -> BoardCorners:
    """Find a board's inner corners; the arrays are empty where there are none.

    Those out of the picture, moved away or without contrast are left out. Errors are those of ``charuco_board``.

    Args:
        mosaic: samples in any linear unit, their black level subtracted.
        variance: of single samples, in that unit squared.
        spec: the board.
        rules: which corners count.
    """
    grey, spread = luminance(mosaic, variance)
    ids, rough = _detect(grey, spec)
    if len(ids) < rules.least_corners:
        return BoardCorners(ids[:0], rough[:0], np.zeros(0))
    edges = _edges_px(board_points_mm(spec)[ids, :2], rough, spec.square_mm)
    # The window, of a square: clear of the markers, and of the next corners.
    reach = min(0.9 * np.sqrt(2.0) * (spec.square_mm - spec.marker_mm) / (2.0 * spec.square_mm), 0.4)
    radius = np.clip(reach * np.linalg.norm(edges, axis=2).min(axis=1), *rules.window_px)
    half = int(np.ceil(radius.max())) + 1
    base = np.clip(np.round(rough).astype(np.int64), half, np.array(grey.shape[::-1]) - half - 1)
    dy, dx = (a.ravel() for a in np.mgrid[-half : half + 1, -half : half + 1])
    where = (base[:, 1, None] + dy, base[:, 0, None] + dx)
    angles = np.arctan2(edges[..., 0], -edges[..., 1])
    start = np.concatenate([rough - base, angles, np.full((len(base), 2), np.log(1.5))], axis=1)
    place, saddles = _fitted(start, np.stack([dx, dy], axis=1).astype(np.float64), grey[where], radius)
    xy, sigma = base + place, saddles.noise_sigma(spread[where])
    misfit = np.sqrt(saddles.cost / np.maximum(saddles.weight.sum(-1) - 10, 1.0))
    inside = (base == np.round(rough)).all(axis=1)
    near = np.linalg.norm(xy - rough, axis=1) < np.maximum(radius / 2, 3.0)
    contrast = np.abs(saddles.contrast) > rules.least_contrast * misfit
    good = inside & near & contrast & (sigma < rules.worst_corner_sigma_px) & np.isfinite(xy).all(axis=1)
    return BoardCorners(ids[good], xy[good], sigma[good])


def _detect(grey: Picture, spec: BoardSpec) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, "n 2"]]:
    """OpenCV's detection on the picture and, for strong blur, on one of half its size; the one with more corners."""
    low, high = np.percentile(grey, [0.5, 99.5])
    picture = np.round(255.0 * np.clip((grey - low) / max(high - low, 1e-12), 0.0, 1.0)).astype(np.uint8)
    detector = cv2.aruco.CharucoDetector(charuco_board(spec))
    best = np.zeros(0, dtype=np.int64), np.zeros((0, 2))
    for shrink in (1, 2):
        small = picture if shrink == 1 else cv2.resize(picture, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        corners, ids, _, _ = detector.detectBoard(small)
        if ids is not None and len(ids) > len(best[0]):
            xy = (np.asarray(corners, dtype=np.float64).reshape(-1, 2) + 0.5) * shrink - 0.5
            best = np.asarray(ids, dtype=np.int64).reshape(-1), xy
        if len(best[0]) == (spec.columns - 1) * (spec.rows - 1):
            break
    return best


def _edges_px(
    board: Float[np.ndarray, "n 2"], image: Float[np.ndarray, "n 2"], square_mm: float
) -> Float[np.ndarray, "n 2 2"]:
    """The sides of a square to the right and down at each corner, as vectors in px."""
    homography, _ = cv2.findHomography(board, image, cv2.RANSAC, 5.0)
    ends = board[:, None] + square_mm / 2 * np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
    whole = np.eye(3) if homography is None else homography
    seen = cv2.perspectiveTransform(ends.reshape(-1, 1, 2), whole).reshape(-1, 4, 2)
    return np.asarray(seen[:, :2] - seen[:, 2:])


@final
@dataclass(frozen=True)
class _Saddles:
    """The model at shapes (px, py, angle1, angle2, log s1, log s2), each with its best linear part (b, gx, gy, A).

    ``jacobian`` has the derivatives by both, ``contrast`` is A. A sample's weight falls from 1 at a corner to 0 at its
    radius.
    """

    weight: Float[np.ndarray, "n m"]
    residual: Float[np.ndarray, "n m"]
    jacobian: Float[np.ndarray, "n m 10"]
    contrast: Float[np.ndarray, " n"]

    @classmethod
    def at(cls, shape: np.ndarray, offsets: np.ndarray, samples: np.ndarray, radius: np.ndarray) -> _Saddles:
        """Fit the linear parts; ``samples`` lie at the same ``offsets`` from a whole pixel near each corner."""
        u = offsets - shape[:, None, :2]
        weight = np.clip(1 - (u**2).sum(-1) / radius[:, None] ** 2, 0.0, None)
        normals = np.stack([np.cos(shape[:, 2:4]), np.sin(shape[:, 2:4])], axis=-1)
        tangents = np.stack([-normals[..., 1], normals[..., 0]], axis=-1)
        width = np.exp(shape[:, 4:6])[..., None]
        across = normals @ np.swapaxes(u, 1, 2) / width
        profile = erf(across / np.sqrt(2.0))
        design = np.stack([np.ones_like(samples), u[..., 0], u[..., 1], profile.prod(axis=1)], axis=-1)
        normal, right = _equations(weight, design, samples)
        linear = np.linalg.solve(normal + 1e-9 * np.eye(4), right)
        slope = linear[:, 3:] * np.sqrt(2 / np.pi) * np.exp(-(across**2) / 2) * profile[:, ::-1]
        position = -np.swapaxes(slope / width, 1, 2) @ normals - np.swapaxes(linear[:, 1:3], 1, 2)
        turn, grow = slope / width * (tangents @ np.swapaxes(u, 1, 2)), -slope * across
        parts = [position, np.swapaxes(turn, 1, 2), np.swapaxes(grow, 1, 2), design]
        return cls(weight, samples - (design @ linear)[..., 0], np.concatenate(parts, axis=-1), linear[:, 3, 0])

    @property
    def cost(self) -> Float[np.ndarray, " n"]:
        """Weighted sum of squares."""
        return (self.weight * self.residual**2).sum(axis=-1)

    def step(self, damping: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 6"]:
        """Damped Gauss-Newton step of the shape; the linear part follows by itself."""
        normal, right = _equations(self.weight, self.jacobian, self.residual)
        diagonal = np.einsum("nii->ni", normal)
        raised = damping[:, None] * diagonal + 1e-12 * diagonal.max(1, keepdims=True) + 1e-30
        return np.linalg.solve(normal + raised[:, :, None] * np.eye(10), right)[:, :6, 0]

    def noise_sigma(self, variance: Float[np.ndarray, "n m"]) -> Float[np.ndarray, " n"]:
        """One sigma by axis in px of the corners, from the samples' noise, the filter and the window's weights.

        Weighted least squares moves a corner by G = (J' W J)^-1 J' W per filtered sample: the covariance is a sandwich.
        """
        normal, _ = _equations(self.weight, self.jacobian, self.residual)
        weighted = np.swapaxes(self.jacobian * self.weight[..., None], 1, 2)
        moves = np.linalg.pinv(normal, hermitian=True)[:, :2] @ weighted
        side = int(np.sqrt(moves.shape[2]))
        by_sample = _filtered(moves.reshape(*moves.shape[:2], side, side)).reshape(moves.shape)
        return np.sqrt((by_sample**2 * variance[:, None]).sum(axis=(1, 2)) / 2)


def _equations(
    weight: Float[np.ndarray, "n m"], slopes: Float[np.ndarray, "n m p"], values: Float[np.ndarray, "n m"]
) -> tuple[Float[np.ndarray, "n p p"], Float[np.ndarray, "n p 1"]]:
    """Weighted normal equations of each corner."""
    weighted = np.swapaxes(slopes * weight[..., None], 1, 2)
    return weighted @ slopes, weighted @ values[..., None]


def _fitted(
    shape: Float[np.ndarray, "n 6"],
    offsets: Float[np.ndarray, "m 2"],
    samples: Float[np.ndarray, "n m"],
    radius: Float[np.ndarray, " n"],
) -> tuple[Float[np.ndarray, "n 2"], _Saddles]:
    """The places of all corners, from a start of their shapes, by damped steps; see ``_Saddles``."""
    saddles, damping = _Saddles.at(shape, offsets, samples, radius), np.full(len(shape), 1e-3)
    for _ in range(12):
        trial = shape + np.clip(saddles.step(damping), -1.0, 1.0)
        trial[:, 4:] = np.clip(trial[:, 4:], np.log(0.3), np.log(20.0))
        tried = _Saddles.at(trial, offsets, samples, radius)
        better = tried.cost < saddles.cost
        step = np.abs(trial - shape).max()
        shape = np.where(better[:, None], trial, shape)
        saddles = tried if better.all() else _Saddles.at(shape, offsets, samples, radius)
        if step < 1e-4:  # The next one would be its square.
            break
        damping = np.clip(np.where(better, damping / 5, damping * 10), 1e-9, 1e9)
    return shape[:, :2], saddles
