"""Does the model hold? Tests on the residuals of a bundle, and what the model's error adds to sigma.

Two ways to be wrong are told apart from chance. Views that disagree: each view alone would have the intrinsics a
little elsewhere, further than its noise explains (Cochran's Q, as in meta-analysis); the intrinsics without a view
then predict its corners worse than noise does. A pattern over the picture: residuals of neighbouring places in the
sensor, over all views, share a direction. Both statistics are exact for a linear model with normal noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from udccal.fitting.engine.tails import f_tail
from udccal.fitting.geometry.bundle_noise import covariance
from udccal.fitting.geometry.bundle_normal import INTRINSICS
from udccal.fitting.geometry.bundle_points import Points
from udccal.fitting.geometry.bundle_solve import Solved, linearised

# Chance alone flags one fit in a thousand, by either test.
FLAGGED_P = 1e-3
_CELLS = 6
_RANK = 1e-9


@dataclass(frozen=True)
class FTest:
    """A statistic over its degrees of freedom (1 when the model holds), and how often chance makes it as large."""

    ratio: float
    p_value: float

    @property
    def flagged(self) -> bool:
        """Whether chance is no explanation."""
        return self.p_value < FLAGGED_P


@dataclass(frozen=True)
class Evidence:
    """What the residuals say about the model.

    Attributes:
        pattern: residuals averaged over the cells of a 6 x 6 grid on the sensor, against independence.
        views: the intrinsics that each view prefers, against one set for all.
        held_out_rms_px: of points of a view against intrinsics from the other views, with the view's own pose.
        expected_rms_px: what that would be if the model held.
        pattern_px: size of the pattern per axis beyond noise; 0 unless flagged.
    """

    pattern: FTest
    views: FTest
    held_out_rms_px: float
    expected_rms_px: float
    pattern_px: float

    @property
    def variance_factor(self) -> float:
        """What the covariance is multiplied with: 1 unless the views disagree beyond chance (Birge, 1932)."""
        return max(self.views.ratio, 1.0) if self.views.flagged else 1.0


def weigh(
    solved: Solved, points: Points, free: Bool[np.ndarray, "9"], image_size: tuple[int, int], dof: float
) -> Evidence:
    """Test a solution whose points carry their scaled sigma; ``dof`` are the degrees of freedom behind that scale."""
    residuals, slopes = linearised(solved.bundle, points)
    use = points.used
    white = (residuals / points.sigma[:, None])[use]
    tall = (slopes / points.sigma[:, None, None])[use] * np.concatenate([free, np.ones(6)])
    view, image = points.view[use], points.image[use]
    cov = covariance(solved, free)
    views = _disagreement(white, tall, view, free, dof)
    pattern, size = _pattern(white, tall, view, image, points.sigma[use], cov, image_size, dof)
    held, expected = _held_out(white, tall, view, points.sigma[use], free)
    return Evidence(pattern, views, held, expected, size if pattern.flagged else 0.0)


def _reduced(
    white: np.ndarray, tall: np.ndarray, free: np.ndarray
) -> tuple[Float[np.ndarray, "k k"], Float[np.ndarray, " k"]]:
    """Information of one view on the free intrinsics once its pose is eliminated, and the slope of half its chi2."""
    flat, right = tall.reshape(-1, INTRINSICS + 6), white.ravel()
    lens, pose = flat[:, :INTRINSICS][:, free], flat[:, INTRINSICS:]
    lens = lens - pose @ np.linalg.lstsq(pose, lens, rcond=None)[0]
    return lens.T @ lens, lens.T @ right


def _per_view(
    white: np.ndarray, tall: np.ndarray, view: np.ndarray, free: np.ndarray
) -> list[tuple[Float[np.ndarray, "k k"], Float[np.ndarray, " k"]]]:
    """As ``_reduced``, for every view, in units that make the information of all views together alike in size."""
    parts = [_reduced(white[view == k], tall[view == k], free) for k in range(int(view.max()) + 1)]
    unit = 1 / np.sqrt(np.maximum(np.diag(sum(information for information, _ in parts)), 1e-300))
    return [(information * np.outer(unit, unit), slope * unit) for information, slope in parts]


def _disagreement(white: np.ndarray, tall: np.ndarray, view: np.ndarray, free: np.ndarray, dof: float) -> FTest:
    """Q = sum over views of slope^T information^+ slope: how far the views' own minima lie from the common one."""
    total, rank = 0.0, 0
    for information, slope in _per_view(white, tall, view, free):
        values, vectors = np.linalg.eigh(information)
        told = values > _RANK * max(values[-1], _RANK)
        total += float((((vectors.T @ slope)[told]) ** 2 / values[told]).sum())
        rank += int(told.sum())
    return _test(total, rank - int(free.sum()), dof)


def _held_out(
    white: np.ndarray, tall: np.ndarray, view: np.ndarray, sigma: np.ndarray, free: np.ndarray
) -> tuple[float, float]:
    """Root mean square of held-out residuals in px, and what it would be for noise alone."""
    parts = _per_view(white, tall, view, free)
    total = sum(information for information, _ in parts)
    own = np.bincount(view, (white**2).sum(axis=1))
    variance = np.bincount(view, sigma**2) / np.bincount(view)
    seen, expected = 0.0, 0.0
    for k, (information, slope) in enumerate(parts):
        others = np.linalg.pinv(total - information, rcond=1e-10, hermitian=True)
        step = others @ slope
        count = 2 * int((view == k).sum())
        # The slopes of all views cancel at the common minimum: without this view it moves by the step.
        seen += variance[k] * (own[k] + 2 * slope @ step + step @ information @ step)
        expected += variance[k] * (count - 6 + np.trace(information @ others))
    return float(np.sqrt(max(seen, 0.0) / len(white))), float(np.sqrt(max(expected, 0.0) / len(white)))


def _pattern(
    white: np.ndarray,
    tall: np.ndarray,
    view: np.ndarray,
    image: np.ndarray,
    sigma: np.ndarray,
    cov: np.ndarray,
    image_size: tuple[int, int],
    dof: float,
) -> tuple[FTest, float]:
    """Sums over the cells of a grid, against their covariance under the model, fitted parameters accounted for."""
    place = np.clip(image / np.array(image_size) * _CELLS, 0, _CELLS - 1).astype(np.int64)
    _, cell = np.unique(place[:, 1] * _CELLS + place[:, 0], return_inverse=True)
    count = np.bincount(cell)
    cells, views = len(count), int(view.max()) + 1
    sums = np.stack([np.bincount(cell, white[:, axis], cells) for axis in (0, 1)]).ravel()
    gathered = np.zeros((2, cells, len(cov)))
    for axis in (0, 1):
        np.add.at(gathered[axis][:, :INTRINSICS], cell, tall[:, axis, :INTRINSICS])
        for k in range(views):
            mine, columns = view == k, slice(INTRINSICS + 6 * k, INTRINSICS + 6 * k + 6)
            np.add.at(gathered[axis][:, columns], cell[mine], tall[mine, axis, INTRINSICS:])
    flat = gathered.reshape(2 * cells, -1)
    expected = np.diag(np.tile(count, 2).astype(np.float64)) - flat @ cov @ flat.T
    values, vectors = np.linalg.eigh(expected)
    told = values > 1e-6 * count.max()
    statistic = float(((vectors[:, told].T @ sums) ** 2 / values[told]).sum())
    found = _test(statistic, int(told.sum()), dof)
    # Mean over the points of the squared mean of their cell, less what noise makes of it.
    excess = float((sums**2 - np.diag(expected)) @ np.tile(1 / count, 2)) / (2 * len(white))
    return found, float(np.sqrt(max(excess, 0.0) * np.mean(sigma**2)))


def _test(statistic: float, rank: int, dof: float) -> FTest:
    """The scale of the noise is estimated: an F distribution.

    Its numerator is part of the residuals behind the scale, so that those are taken out of the denominator.
    """
    rest = dof - rank
    if rank < 1 or rest < 1 or not np.isfinite(statistic):
        return FTest(1.0, 1.0)
    within = max(dof - statistic, 1e-9) / rest
    ratio = statistic / rank / within
    return FTest(float(ratio), f_tail(ratio, rank, rest))
