"""How a board differs from its description in all views alike: bow, twist, and squares that are longer one way.

Such a board biases the lens of every view, and the disagreement of the views does not hold that. Its numbers are tested
together (F-test), each in one step of the bundle with lens and poses free. Where they explain what the views disagree
on, they are fitted, and their uncertainty enters that of lens and poses.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import final

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from udccal.fitting.engine.gaussian import Prior
from udccal.fitting.engine.misfit import MisfitTest, f_test
from udccal.fitting.geometry.bundle import LENS, Free, Points, Solved, in_sigma, solve
from udccal.fitting.geometry.calibrated import disagreement

# Along the board's x and y: heights of its middle over its edges, height of a corner by twist, and a part of x.
_NAMES = ("a bow along x", "a bow along y", "a twist", "a stretch along x")
# Part of the information on a number that lens and poses leave, below which the views do not tell it.
_LEAST_SEEN = 1e-6
# Part of the views' disagreement that may be left where the board is what they disagreed on.
_LEFT = 0.2

Shape = Float[np.ndarray, "4"]


@final
@dataclass(frozen=True)
class BoardShape:
    """The numbers of a board in the order of ``_NAMES``, with their covariance, and the points on such a board."""

    values: Shape
    cov: Float[np.ndarray, "4 4"]
    points: Points

    def added_cov(self, solved: Solved, points: Points, free: Free) -> Float[np.ndarray, "n n"]:
        """What their uncertainty adds to the covariance of lens and poses."""
        slopes, by_shape, _ = _linearised(solved, points, free)
        moved = solved.equations.joint_cov() @ (slopes.T @ by_shape)
        return np.asarray(moved @ self.cov @ moved.T)

    def told(self) -> Iterator[str]:
        """Say which numbers are beyond three sigma."""
        sigma = np.sqrt(np.diag(self.cov))
        found = [
            f"{name} of {100 * value:+.3f} +- {100 * one:.3f} %"
            if k == 3
            else f"{name} of {value:+.3g} +- {one:.2g} in the board's unit"
            for k, (name, value, one) in enumerate(zip(_NAMES, self.values, sigma, strict=True))
            if abs(value) > 3 * one
        ]
        numbers = ", ".join(found) or "small ones together"
        yield f"In all views the board differs from its description: {numbers}. It was fitted; use a flat, stiff one."


def board_shape(solved: Solved, points: Points, free: Free, prior: Prior, dof: float) -> BoardShape | None:
    """The shape of a board that explains what the views disagree on, or None.

    Args:
        solved, points: the minimum with the board as described, sigmas included.
        free: intrinsics that are not held.
        prior: on the intrinsics.
        dof: degrees of freedom behind sigma.
    """
    if len(points.names) <= points.rules.least_views:
        return None
    values, cov, test = _step(solved, points, free, dof)
    if not test.found:
        return None
    described, before = points.board, disagreement(solved, points, free, dof)[0]
    for _ in range(3):
        points = replace(points, board=described + _by_shape(described) @ values)
        solved = solve(solved.place, points, free, prior)
        step, cov, _ = _step(solved, points, free, dof)
        values = values + step
    after = disagreement(solved, points, free, dof)[0]
    explained = not after.found or after.ratio - 1 < _LEFT * (before.ratio - 1)
    return BoardShape(values, cov * after.inflation, points) if explained else None


def _step(solved: Solved, points: Points, free: Free, dof: float) -> tuple[Shape, Float[np.ndarray, "4 4"], MisfitTest]:
    """One step of the four numbers with lens and poses free, its covariance, and a test of it."""
    slopes, by_shape, z = _linearised(solved, points, free)
    left = by_shape - slopes @ (solved.equations.joint_cov() @ (slopes.T @ by_shape))
    unit = np.maximum(np.linalg.norm(by_shape, axis=0), 1e-300)
    values, vectors = np.linalg.eigh(by_shape.T @ left / np.outer(unit, unit))
    seen = values > _LEAST_SEEN
    axes = vectors[:, seen] / unit[:, None]
    along = -(left @ axes).T @ z
    test = f_test(float((along**2 / values[seen]).sum()), int(seen.sum()), dof)
    return axes @ (along / values[seen]), (axes / values[seen]) @ axes.T, test


def _linearised(
    solved: Solved, points: Points, free: Free
) -> tuple[Float[np.ndarray, "samples n"], Float[np.ndarray, "samples 4"], Float[np.ndarray, " samples"]]:
    """Derivatives of the residuals in sigma by lens and all poses, and by the board's shape; the residuals."""
    z, jacobian = in_sigma(solved.place, points)
    poses, count = solved.place.poses, len(z)
    slopes = np.zeros((count, 2, LENS + poses.size))
    slopes[..., :LENS] = jacobian[..., :LENS] * free
    own = LENS + 6 * points.view[:, None] + np.arange(6)
    slopes[np.arange(count)[:, None, None], np.arange(2)[:, None], own[:, None]] = jacobian[..., LENS:]
    turned = Rotation.from_rotvec(poses[:, :3]).as_matrix()[points.view] @ _by_shape(points.board)
    by_shape = jacobian[..., LENS + 3 :] @ turned
    return slopes.reshape(2 * count, -1), by_shape.reshape(2 * count, -1), z.ravel()


def _by_shape(board: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points 3 4"]:
    """Derivatives of places on a board by its shape."""
    low, high = board[:, :2].min(axis=0), board[:, :2].max(axis=0)
    x, y = ((2 * board[:, :2] - low - high) / np.maximum(high - low, 1e-300)).T
    by = np.zeros((len(board), 3, 4))
    by[:, 2, :3] = np.stack([1 - x**2, 1 - y**2, x * y], axis=1)
    by[:, 0, 3] = x * (high - low)[0] / 2
    return by
