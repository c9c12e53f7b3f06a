"""Points of a board that are off their description in all views alike, each its own way: no print is exact.

An F-test finds them. Their scatter then is the prior of random effects: each point moves to where it is likeliest, and
what stays uncertain of that enters the covariance of lens and poses (Robinson, Statistical Science 6, 1991).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import final

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from udccal.fitting.engine.gaussian import Prior
from udccal.fitting.engine.misfit import f_test
from udccal.fitting.geometry.bundle import LENS, Free, Points, Solved, in_sigma, solve

# Part of the information on a point that lens and poses leave, below which the views do not tell it.
_LEAST_SEEN = 1e-6
# Of the distance between neighbours: no print is off by more, but points in another order are.
_MOST_OFF = 0.1


@final
@dataclass(frozen=True)
class BoardPoints:
    """The points where they are likeliest.

    Attributes:
        scatter: their sigma along x and along y, in the board's unit.
        number: that of each view's point on the board.
    """

    scatter: float
    number: Int[np.ndarray, " points"]
    points: Points

    def added_cov(self, solved: Solved, points: Points, free: Free) -> Float[np.ndarray, "n n"]:
        """What their uncertainty adds to the covariance of lens and poses."""
        seen = _Seen.of(solved, points, free, self.number)
        moved = self.scatter * seen.moved
        return np.asarray(moved.T @ np.linalg.solve(seen.likely(self.scatter), moved))

    def told(self) -> Iterator[str]:
        """Say how far they are off."""
        yield (
            f"In all views alike, points of the board are off their description by {self.scatter:.2g} in the board's "
            "unit (RMS along each axis). They were fitted; use a better print, or give the points as measured."
        )


@final
@dataclass(frozen=True)
class _Seen:
    """What residuals in sigma say of places (x, y) on the board, point after point.

    ``right`` is minus half the gradient of chi-squared; ``information`` is half its Hessian, with lens and poses free;
    ``moved`` is how lens and poses follow, in units of the gradient.
    """

    right: Float[np.ndarray, " m"]
    information: Float[np.ndarray, "m m"]
    moved: Float[np.ndarray, "m n"]

    @classmethod
    def of(cls, solved: Solved, points: Points, free: Free, number: Int[np.ndarray, " points"]) -> _Seen:
        """At a minimum."""
        z, jacobian = in_sigma(solved.place, points)
        turn = Rotation.from_rotvec(solved.place.poses[:, :3]).as_matrix()[points.view]
        by_point, count = jacobian[..., LENS + 3 :] @ turn[..., :2], int(number.max()) + 1
        across = np.swapaxes(by_point, 1, 2)

        def of_points(values: Float[np.ndarray, "points 2 k"]) -> Float[np.ndarray, "count 2 k"]:
            total = np.zeros((count, *values.shape[1:]))
            np.add.at(total, number, values)
            return total

        cross = np.zeros((count, 2, LENS + solved.place.poses.size))
        cross[..., :LENS] = of_points(across @ (jacobian[..., :LENS] * free))
        by_pose = LENS + 6 * points.view[:, None] + np.arange(6)
        cross[number[:, None, None], np.arange(2)[:, None], by_pose[:, None]] = across @ jacobian[..., LENS:]
        flat = cross.reshape(2 * count, -1)
        moved = flat @ solved.equations.joint_cov()
        information = -moved @ flat.T
        at = np.arange(count)
        information.reshape(count, 2, count, 2)[at, :, at] += of_points(across @ by_point)
        return cls(-of_points(across @ z[..., None]).ravel(), information, moved)

    def likely(self, scatter: float) -> Float[np.ndarray, "m m"]:
        """The information in units of the ``scatter``, with that as a prior."""
        return scatter**2 * self.information + np.eye(len(self.right))

    def scatter(self, dof: float) -> tuple[float, float]:
        """The points' sigma by moments, and the noise without it, over sigma; (0, 1) where chance explains it."""
        values, vectors = np.linalg.eigh(self.information)
        seen = values > _LEAST_SEEN * values[-1]
        square, rank = float(((vectors[:, seen].T @ self.right) ** 2 / values[seen]).sum()), int(seen.sum())
        if not f_test(square, rank, dof).found:
            return 0.0, 1.0
        noise = max(dof - square, 1e-9) / (dof - rank)
        return float(np.sqrt(max(square - rank * noise, 0.0) / values[seen].sum())), float(np.sqrt(noise))


def board_points(solved: Solved, points: Points, free: Free, prior: Prior, dof: float) -> BoardPoints | None:
    """The places of a board's points where they are off in all views alike, or None.

    Args:
        solved, points: the minimum with the board as described, sigmas included.
        free: intrinsics that are not held.
        prior: on the intrinsics.
        dof: degrees of freedom behind sigma.
    """
    if len(points.names) <= points.rules.least_views:
        return None
    described = points.board
    each, number = np.unique(described, axis=0, return_inverse=True)
    number = number.ravel()
    seen = _Seen.of(solved, points, free, number)
    (scatter, noise), off = seen.scatter(dof), np.zeros(len(seen.right))
    if not 0.0 < scatter < _MOST_OFF * float(np.median(KDTree(each).query(each, k=2)[0][:, 1])):
        return None
    points = points.scaled(np.full(len(points.names), noise))
    for _ in range(4):
        place = (scatter * off).reshape(-1, 2)[number]
        points = replace(points, board=described + np.pad(place, ((0, 0), (0, 1))))
        solved = solve(solved.place, points, free, prior)
        seen = _Seen.of(solved, points, free, number)
        # In units of the scatter, from the points as described.
        right = scatter * (seen.right + scatter * seen.information @ off)
        off = np.linalg.solve(seen.likely(scatter), right)
    return BoardPoints(scatter, number, points)
