"""The result of a bundle: lens, poses, tests of the model, and the covariance of the place where a ray lands.

Two model errors are tested against chance. Views may disagree: each view alone would put the intrinsics elsewhere,
further than its noise explains (Cochran's Q, as in meta-analysis). Residuals may have a pattern over the picture: those
of neighbouring places on the sensor, over all views, have a common direction. Both statistics are exact for a linear
model with normal noise.
"""

from __future__ import annotations

import enum
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import final

import cv2
import numpy as np
from jaxtyping import Float

from udccal.errors import FitError
from udccal.fitting.engine.misfit import MisfitTest, clustered_cov, f_test
from udccal.fitting.geometry.bundle import (
    LENS,
    BundleProblem,
    Free,
    Intrinsics,
    Points,
    Poses,
    Solved,
    in_sigma,
    projected,
)
from udccal.result import Candidate, FitStatus, Outliers


class Gauge(enum.Enum):
    """The frame to which a ray stays fixed while the calibration varies.

    A lens whose centre is a pixel off and a camera that is turned by as much see nearly the same. Compare Kogan,
    "Projection uncertainty" in the documentation of mrcal, whose choice is ``BOARDS``.
    """

    CAMERA = "the camera's axes as fitted: what centre and rotation can exchange shows in full"
    BOARDS = "the boards, on average over the views: the camera's axes turn with the poses"
    ALIGNED = "the rotation that brings the whole picture into its best agreement: the shape of the lens alone"


@final
@dataclass(frozen=True)
class CalibratedViews:
    """Intrinsics and poses with their uncertainty, and tests of them.

    Attributes:
        intrinsics: the lens; distortion coefficients that the data do not ask for are 0, and not ``free``.
        poses: of the views in use, board to camera: rotation vector (rad), then translation (board's unit).
        cov: of the intrinsics as a vector, then 6 per view in use. The scale of the noise is estimated; where the views
            disagree beyond it, the variance of their disagreement is added.
        points: the finite points of all views in use; their sigma is the given one times the estimated scatter.
        residuals_px: projected minus seen, of these points.
        chi2_dof: scatter over the given sigma, squared; 1 where none was given.
        candidates: the orders of the distortion, by BIC.
        disagreement: test of the intrinsics that each view prefers.
        pattern, pattern_px: test of residuals averaged over cells of the sensor; the size of their pattern per axis
            beyond noise, 0 unless found.
        status: ``CONVERGED``, or the reason not to use this; ``notes`` say what to do.
        iterations: of the last solve with all distortions free.
    """

    intrinsics: Intrinsics
    poses: Poses
    cov: Float[np.ndarray, "n n"]
    points: Points
    residuals_px: Float[np.ndarray, "points 2"]
    free: tuple[bool, ...]
    chi2_dof: float
    candidates: tuple[Candidate, ...]
    disagreement: MisfitTest
    pattern: MisfitTest
    pattern_px: float
    status: FitStatus
    notes: tuple[str, ...]
    outliers: tuple[Outliers, ...]
    iterations: int
    image_size: tuple[int, int]

    @property
    def rms_px(self) -> float:
        """Root mean square distance of seen from projected points in px, as OpenCV's calibrateCamera returns it."""
        return rms_px(self.residuals_px, self.points)

    def projection_covariance(
        self, pixels: Float[np.ndarray, "rays 2"], gauge: Gauge = Gauge.BOARDS
    ) -> Float[np.ndarray, "rays 2 2"]:
        """Covariance in px^2 of the places where rays land, which the fit puts at ``pixels`` (x, y).

        The pattern that the residuals show beyond chance is a model error, and is added.

        Raises:
            FitError: when the fitted distortion folds before a pixel, so that no ray lands there.
        """
        by_lens, by_turn = self._ray_slopes(np.asarray(pixels, dtype=np.float64))
        slope = by_turn @ self.turn(gauge)
        slope[..., :LENS] += by_lens
        return slope @ self.cov @ np.swapaxes(slope, 1, 2) + self.pattern_px**2 * np.eye(2)

    def turn(self, gauge: Gauge) -> Float[np.ndarray, "3 n"]:
        """Derivatives of the rays' rotation, in camera coordinates, by the intrinsics and poses."""
        if gauge is Gauge.BOARDS:
            return turn_with(self.poses, range(len(self.poses)))
        turn = np.zeros((3, len(self.cov)))
        if gauge is Gauge.ALIGNED:
            lens, by_turn = self._ray_slopes(field_grid(self.image_size))
            turn[:, :LENS] = -np.linalg.lstsq(by_turn.reshape(-1, 3), lens.reshape(-1, LENS), rcond=None)[0]
        return turn

    def _ray_slopes(
        self, pixels: Float[np.ndarray, "rays 2"]
    ) -> tuple[Float[np.ndarray, "rays 2 9"], Float[np.ndarray, "rays 2 3"]]:
        """Derivatives of the places where rays land, by the intrinsics and by a small rotation of the rays."""
        enough = cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 1000, 1e-9
        ideal = cv2.undistortPoints(pixels, *self.intrinsics.opencv, criteria=enough)
        places, by = projected(self.intrinsics.vector, cv2.convertPointsToHomogeneous(ideal).reshape(-1, 3))
        near = np.abs(places - pixels).max(axis=1) < 1e-6
        lost = ~near | (np.linalg.det(np.where(near[:, None, None], by[:, :, LENS + 3 : LENS + 5], 0.0)) <= 0)
        if lost.any():
            raise FitError(folded(pixels[lost]))
        return by[:, :, :LENS], by[:, :, LENS : LENS + 3]


def rms_px(residuals_px: Float[np.ndarray, "points 2"], points: Points) -> float:
    """Root mean square distance of the points in use."""
    return float(np.sqrt((residuals_px[points.used] ** 2).sum(axis=1).mean()))


def field_grid(image_size: tuple[int, int]) -> Float[np.ndarray, "81 2"]:
    """9 x 9 pixels over the picture, 2 % away from its edges."""
    place = np.linspace(0.02, 0.98, 9)
    x, y = np.meshgrid(place * (image_size[0] - 1), place * (image_size[1] - 1))
    return np.stack([x.ravel(), y.ravel()], axis=1)


def turn_with(poses: Poses, views: Sequence[int]) -> Float[np.ndarray, "3 n"]:
    """Derivatives, by intrinsics and all poses, of the mean rotation of some views' boards in camera coordinates.

    It is the small rotation that follows the old one; the left Jacobian of SO(3) takes the rotation vectors to it.
    """
    turn = np.zeros((3, LENS + poses.size))
    for view in views:
        matrix, by = cv2.Rodrigues(np.ascontiguousarray(poses[view, :3]))
        small = by.reshape(3, 3, 3) @ matrix.T
        mine = slice(LENS + 6 * view, LENS + 6 * view + 3)
        turn[:, mine] = np.array([small[:, 2, 1], small[:, 0, 2], small[:, 1, 0]]) / len(views)
    return turn


def disagreement(solved: Solved, points: Points, free: Free, dof: float) -> tuple[MisfitTest, Float[np.ndarray, "n n"]]:
    """Test of the lenses that each view prefers, and a covariance that is wider where they disagree.

    The lens then has the spread that it has when one view after another is left out, and the poses follow. Its 95 %
    intervals hold 93 to 98 % where boards are bent or lenses move; with one factor for all (Birge, 1932) they hold 83
    to 99 %. Only its own view determines a pose. ``dof`` are the degrees of freedom behind sigma.
    """
    parts = [one.marginal() for one in BundleProblem(points, free).by_view(solved.place)]
    # Each view's information on the free intrinsics, its pose eliminated; all views together have the size 1.
    information, score = (np.array(part)[:, free] for part in zip(*parts, strict=True))
    unit = 1 / np.sqrt(np.maximum(np.einsum("kii->i", information[:, :, free]), 1e-300))
    units, among = np.outer(unit, unit), np.ix_(free, free)
    information, score = information[:, :, free] * units, score * unit
    # Cochran's Q: sum over views of score' information^+ score, the distances of the views' minima from the common one.
    values, vectors = np.linalg.eigh(information)
    seen = values > 1e-9 * np.maximum(values[:, -1:], 1e-9)
    along = np.einsum("kij,ki->kj", vectors, score)
    test = f_test(float((along[seen] ** 2 / values[seen]).sum()), int(seen.sum()) - len(unit), dof)
    lens = solved.equations.cov()
    if test.found:
        lens[among] = clustered_cov(lens[among] / units, score, information) * units
    return test, solved.equations.joint_cov(lens, test.inflation)


def residual_pattern(solved: Solved, points: Points, size: tuple[int, int], dof: float) -> tuple[MisfitTest, float]:
    """Test of sums over the cells of a grid by their covariance under the model, and the size in px of what it found.

    ``group_means_test`` does not serve here: the fit absorbs most of a smooth pattern, so that means of cells scatter
    far less than those of independent residuals. The covariance of the sums accounts for that.
    """
    (z, jacobian), cell = in_sigma(solved.place, points), points.cells(size)
    inside = np.equal.outer(np.unique(cell[points.used]), cell) * points.used.astype(np.float64)
    count, sums = np.repeat(inside.sum(axis=1), 2), (inside @ z).ravel()
    slopes = np.zeros((len(inside), 2, LENS + solved.place.poses.size))
    for view in range(len(points.names)):
        mine = points.view == view
        part = np.tensordot(inside[:, mine], jacobian[mine], 1)
        slopes[..., :LENS] += part[..., :LENS]
        slopes[..., LENS + 6 * view : LENS + 6 * view + 6] = part[..., LENS:]
    flat = slopes.reshape(len(sums), -1)
    expected = np.diag(count) - flat @ solved.equations.joint_cov() @ flat.T
    values, vectors = np.linalg.eigh(expected)
    seen = values > 1e-6 * count.max()
    test = f_test(float(((vectors[:, seen].T @ sums) ** 2 / values[seen]).sum()), int(seen.sum()), dof)
    # Mean over the points of the squared mean of their cell, less the part that noise has in it.
    excess = test.found * float(((sums**2 - np.diag(expected)) / count).sum() / count.sum())
    return test, float(np.sqrt(max(excess, 0.0) * np.mean(points.sigma[points.used] ** 2)))


def folded(pixels: Float[np.ndarray, "n 2"]) -> str:
    """What is told of pixels on which no ray lands."""
    x, y = pixels[0]
    return (
        f"Expected pixels that a ray lands on, found ({x:g}, {y:g}) and {len(pixels) - 1} more where the fitted "
        "distortion folds. Ask within the corners that were seen, or capture boards at the edges."
    )


def judged(found: CalibratedViews, scales: Float[np.ndarray, " views"], by_prior: bool) -> CalibratedViews:
    """With a status that says whether the views determine the lens, and notes; ``scales`` are the views' scatter."""
    status, advice = _status(found)
    return replace(found, status=status, notes=(*found.notes, *advice, *_remarks(found, scales, by_prior)))


def _status(found: CalibratedViews) -> tuple[FitStatus, tuple[str, ...]]:
    rules = found.points.rules
    order = "Check that the points of each view are in the order of the board's."
    if found.rms_px > rules.no_corners_px:
        return FitStatus.POOR_FIT, (
            f"Expected corners within {rules.no_corners_px:g} px of the fitted lens, found {found.rms_px:.3g} px "
            f"(RMS): no lens puts these board points there. {order}",
        )
    width = found.image_size[0]
    sigma = np.sqrt(np.diag(found.cov))[:4] / [*np.abs(found.intrinsics.focal_px), width, width]
    if sigma.max() > rules.most_uncertain:
        what = "focal length" if sigma.argmax() < 2 else "centre of the picture"
        return FitStatus.TOO_FEW_DATA, (
            f"The views do not determine the {what} (one sigma is {min(sigma.max(), 99.0):.0%}). "
            "Lean the board by 20 to 40 degrees, another way in each view, and let it fill the picture.",
        )
    return found.status, () if found.status is FitStatus.CONVERGED else (order,)


def _remarks(found: CalibratedViews, scales: Float[np.ndarray, " views"], by_prior: bool) -> Iterator[str]:
    """What a person should know of a fit that can be used."""
    if by_prior:
        yield (
            "The views alone do not determine the whole lens: what is known beforehand gives part of it, and every "
            "distortion coefficient stays free within that. Lean the board another way in each view to know more."
        )
    relative = scales / np.median(scales)
    loud = [
        f"{found.points.names[k]} ({relative[k]:.1f} x)"
        for k in np.flatnonzero(relative > found.points.rules.loud_view)
    ]
    if loud:
        yield f"Views that scatter more than the median view, and count for less: {', '.join(loud)}."
    if found.disagreement.found:
        yield (
            f"The views disagree on the lens beyond their noise (ratio {found.disagreement.ratio:.1f}, "
            f"p = {found.disagreement.p_value:.1g}); sigma is that of views that differ so. "
            "What all views have in common is not in it: the lens may be off by more. Is the board flat?"
        )
    if found.pattern.found:
        yield (
            f"The residuals follow a pattern over the picture (p = {found.pattern.p_value:.1g}, about "
            f"{found.pattern_px:.3f} px): the lens bends rays in a way that no order has."
        )
