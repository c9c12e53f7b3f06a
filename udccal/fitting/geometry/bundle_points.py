"""Views of a board as a calibration sees them: checked, without what cannot be used, and padded for the solver."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from udccal.result import Outliers

# Four points hold a homography; two more tell whether it is the right one.
MIN_POINTS = 6
# Where no sigma is given all points count alike; the scatter of the residuals then sets the scale.
DEFAULT_SIGMA_PX = 0.1
# Across to along: points closer to one line than this hold no pose.
_LINE = 1e-3
_MOST_PLACES = 20


@dataclass(frozen=True)
class Points:
    """Points of all usable views one after another.

    Attributes:
        board: on the board, any unit of length. image: in px. sigma: of each coordinate in px.
        view: whose point it is, counted over the usable views. index: its place in its view as given.
        used: whether it takes part in the fit.
        names: the usable views by their place in what was given.
    """

    board: Float[np.ndarray, "points 3"]
    image: Float[np.ndarray, "points 2"]
    sigma: Float[np.ndarray, " points"]
    view: Int[np.ndarray, " points"]
    index: Int[np.ndarray, " points"]
    used: Bool[np.ndarray, " points"]
    names: tuple[int, ...]

    def scaled(self, factor: Float[np.ndarray, " views"]) -> Points:
        """With the sigma of each view's points multiplied by that view's factor."""
        return replace(self, sigma=self.sigma * factor[self.view])

    def without(self, views: Bool[np.ndarray, " views"]) -> Points:
        """Without these views; the others move up."""
        stay = ~views[self.view]
        number = np.cumsum(~views) - 1
        names = tuple(name for name, gone in zip(self.names, views, strict=True) if not gone)
        parts = (self.board[stay], self.image[stay], self.sigma[stay], number[self.view[stay]])
        return Points(*parts, self.index[stay], self.used[stay], names)

    def place(self, point: int) -> str:
        """A point by its view and its number there, as given."""
        return f"view {self.names[self.view[point]]}, point {self.index[point]}"


@dataclass(frozen=True)
class Gathered:
    """Points of the usable views, what was left out of them, and sentences about that."""

    points: Points
    outliers: tuple[Outliers, ...]
    notes: tuple[str, ...]


@dataclass(frozen=True)
class Blocks:
    """The points view by view, padded with points of weight zero to sizes that recur.

    A solver compiled for one size serves all that are padded to it. ``row`` and ``column`` say where each point went.
    """

    board: Float[np.ndarray, "views points 3"]
    image: Float[np.ndarray, "views points 2"]
    weight: Float[np.ndarray, "views points"]
    row: Int[np.ndarray, " all"]
    column: Int[np.ndarray, " all"]


def gather(board: Sequence[np.ndarray], image: Sequence[np.ndarray], sigmas: Sequence[np.ndarray] | None) -> Gathered:
    """Take every finite point of every view that holds a pose; arguments as for ``calibrate_views``."""
    outliers, notes, seen = [], [], []
    parts: list[tuple[np.ndarray, ...]] = []
    lost: list[str] = []
    for number, (points, pixels) in enumerate(zip(board, image, strict=True)):
        own = np.full(len(pixels), DEFAULT_SIGMA_PX) if sigmas is None else np.asarray(sigmas[number], dtype=float)
        part = tuple(np.asarray(a, dtype=np.float64) for a in (points, pixels, own))
        good = np.isfinite(part[0]).all(axis=1) & np.isfinite(part[1]).all(axis=1) & np.isfinite(own) & (own > 0)
        lost += [f"view {number}, point {k}" for k in np.flatnonzero(~good)]
        complaint = _complaint(part[0][good], part[1][good], [parts[k] for k in range(len(parts))])
        if complaint:
            notes.append(f"View {number} is left out: {complaint}")
            continue
        parts.append((*(a[good] for a in part), np.flatnonzero(good)))
        seen.append(number)
    if lost:
        outliers.append(Outliers("not a finite position with a positive sigma", len(lost), tuple(lost[:_MOST_PLACES])))
    return Gathered(_joined(parts, tuple(seen)), tuple(outliers), tuple(notes))


def _complaint(board: np.ndarray, image: np.ndarray, before: list[tuple[np.ndarray, ...]]) -> str:
    """Why a view cannot be used; empty when it can."""
    if len(board) < MIN_POINTS:
        return f"expected at least {MIN_POINTS} points, found {len(board)}. Bring more of the board into the picture."
    for points, what in ((board, "on the board"), (image, "in the picture")):
        spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
        if spread[1] <= _LINE * spread[0]:
            return f"its points lie on one line {what} and hold no pose. Show at least two rows of corners."
    if any(np.array_equal(image, other[1]) and np.array_equal(board, other[0]) for other in before):
        return "it repeats another view to the last digit, and so adds nothing. Capture every view anew."
    return ""


def _joined(parts: list[tuple[np.ndarray, ...]], names: tuple[int, ...]) -> Points:
    empty = (np.zeros((0, 3)), np.zeros((0, 2)), np.zeros(0), np.zeros(0, dtype=np.int64))
    board, image, sigma, index = (np.concatenate(same) for same in zip(empty, *parts, strict=True))
    counts = np.array([len(part[0]) for part in parts], dtype=np.int64)
    view = np.repeat(np.arange(len(parts)), counts)
    return Points(board, image, sigma, view, index.astype(np.int64), np.ones(len(board), dtype=bool), names)


def blocks(points: Points) -> Blocks:
    """View by view, with weight 1 / sigma for points in use and 0 for others."""
    counts = np.bincount(points.view, minlength=len(points.names))
    views, most = bucket(len(points.names)), bucket(int(counts.max()))
    column = np.concatenate([np.arange(count) for count in counts])
    # Padding repeats a point of the view: it projects as well as others do, whatever the pose.
    first = np.concatenate([[0], np.cumsum(counts)[:-1]])
    board = np.tile(points.board[0], (views, most, 1))
    image = np.zeros((views, most, 2))
    weight = np.zeros((views, most))
    board[: len(counts)] = points.board[first][:, None]
    board[points.view, column] = points.board
    image[points.view, column] = points.image
    weight[points.view, column] = points.used / points.sigma
    return Blocks(board, image, weight, points.view, column)


def bucket(count: int) -> int:
    """The smallest of 4, 6, 8, 12, 16, 24, 32, ... that is not below ``count``."""
    size = 4
    while size < count:
        size = size * 3 // 2 if size & (size - 1) == 0 else size * 4 // 3
    return size
