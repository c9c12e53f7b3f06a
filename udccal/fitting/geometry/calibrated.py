"""The result of a bundle: lens, poses, tests of the model, and the covariance of the place where a ray lands.

Two model errors are tested against chance. Views may disagree: each view alone would put the intrinsics elsewhere,
further than its noise explains (Cochran's Q, as in meta-analysis). Residuals may have a pattern over the picture: those
of neighbouring places on the sensor, over all views, have a common direction. Both statistics are exact for a linear
model with normal noise.
"""

from __future__ import annotations

import enum
from collections.abc import Iterator
from dataclasses import dataclass
from typing import final

import cv2
import numpy as np
from jaxtyping import Bool, Float

from udccal.errors import FitError
from udccal.fitting.engine.gaussian import scaled_inverse
from udccal.fitting.engine.misfit import MisfitTest, clustered_cov, f_test
from udccal.fitting.geometry.bundle import LENS, GeometryRules, Intrinsics, Points, Solved, by_view, in_sigma, projected
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
class Evidence:
    """Tests of residuals averaged over cells of the sensor, and of the intrinsics that each view prefers.

    ``pattern_px`` is the size of the pattern per axis beyond noise; 0 unless found.
    """

    pattern: MisfitTest
    views: MisfitTest
    pattern_px: float

    @property
    def notes(self) -> Iterator[str]:
        """Sentences for a person about the model errors found."""
        if self.views.found:
            yield (
                f"The views disagree on the lens beyond their noise (ratio {self.views.ratio:.1f}, "
                f"p = {self.views.p_value:.1g}); sigma is that of views that differ so. Is the board flat?"
            )
        if self.pattern.found:
            yield (
                f"The residuals follow a pattern over the picture (p = {self.pattern.p_value:.1g}, about "
                f"{self.pattern_px:.3f} px): the lens bends rays in a way that no order has."
            )


@final
@dataclass(frozen=True)
class CalibratedViews:
    """Intrinsics and poses with their uncertainty, and the evidence for them.

    Attributes:
        intrinsics: the lens; distortion coefficients that the data do not ask for are 0, and not ``free``.
        poses: of the views in use, board to camera: rotation vector (rad), then translation (board's unit).
        cov: of the intrinsics as a vector, then 6 per view in use. The scale of the noise is estimated; where the views
            disagree beyond it, the variance of their disagreement is added.
        points: the finite points of all views in use; their sigma is the given one times the estimated scatter.
        residuals_px: projected minus seen, of these points.
        chi2_dof: scatter over the given sigma, squared; 1 where none was given.
        candidates: the orders of the distortion, by BIC.
        status: ``CONVERGED``, or the reason not to use this; ``notes`` say what to do.
        iterations: of the last solve with all distortions free.
        image_size: (columns, rows).
    """

    intrinsics: Intrinsics
    poses: Float[np.ndarray, "views 6"]
    cov: Float[np.ndarray, "n n"]
    points: Points
    residuals_px: Float[np.ndarray, "points 2"]
    free: tuple[bool, ...]
    chi2_dof: float
    candidates: tuple[Candidate, ...]
    evidence: Evidence
    status: FitStatus
    notes: tuple[str, ...]
    outliers: tuple[Outliers, ...]
    iterations: int
    image_size: tuple[int, int]

    @property
    def converged(self) -> bool:
        """Whether this can be used."""
        return self.status is FitStatus.CONVERGED

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
        slope = np.einsum("nai,ij->naj", by_turn, self.turn(gauge))
        slope[..., :LENS] += by_lens
        return np.einsum("nai,ij,nbj->nab", slope, self.cov, slope) + self.evidence.pattern_px**2 * np.eye(2)

    def turn(self, gauge: Gauge) -> Float[np.ndarray, "3 n"]:
        """Derivatives of the rays' rotation, in camera coordinates, by the intrinsics and poses."""
        turn = np.zeros((3, len(self.cov)))
        if gauge is Gauge.BOARDS:
            for view, pose in enumerate(self.poses):
                turn[:, LENS + 6 * view : LENS + 6 * view + 3] = _turn_by_vector(pose[:3]) / len(self.poses)
        elif gauge is Gauge.ALIGNED:
            lens, by_turn = self._ray_slopes(field_grid(self.image_size))
            turn[:, :LENS] = -np.linalg.lstsq(by_turn.reshape(-1, 3), lens.reshape(-1, LENS), rcond=None)[0]
        return turn

    def _ray_slopes(
        self, pixels: Float[np.ndarray, "rays 2"]
    ) -> tuple[Float[np.ndarray, "rays 2 9"], Float[np.ndarray, "rays 2 3"]]:
        """Derivatives of the places where rays land, by the intrinsics and by a small rotation of the rays."""
        lens = self.intrinsics
        rays = np.hstack([(pixels - lens.principal_point_px) / lens.focal_px, np.ones((len(pixels), 1))])
        with np.errstate(all="ignore"):  # Rays that do not come near are found below.
            for _ in range(40):  # Newton's method on the distortion.
                places, by = projected(lens.vector, rays)
                (xx, xy), (yx, yy) = np.moveaxis(by[:, :, LENS + 3 : LENS + 5], 0, -1)
                area, (dx, dy) = xx * yy - xy * yx, (pixels - places).T
                lost = ~((np.hypot(dx, dy) < 1e-7) & (area > 0))
                if not lost.any():
                    break
                rays[:, :2] += np.stack([yy * dx - xy * dy, xx * dy - yx * dx], axis=1) / area[:, None]
        if lost.any():
            x, y = pixels[lost][0]
            raise FitError(
                f"Expected pixels that a ray lands on, found ({x:g}, {y:g}) and {int(lost.sum()) - 1} more where the "
                "fitted distortion folds. Ask within the corners that were seen, or capture boards at the edges."
            )
        return by[:, :, :LENS], by[:, :, LENS : LENS + 3]


def rms_px(residuals_px: Float[np.ndarray, "points 2"], points: Points) -> float:
    """Root mean square distance of the points in use."""
    return float(np.sqrt((residuals_px[points.used] ** 2).sum(axis=1).mean()))


def field_grid(image_size: tuple[int, int]) -> Float[np.ndarray, "81 2"]:
    """9 x 9 pixels over the picture, 2 % away from its edges."""
    place = np.linspace(0.02, 0.98, 9)
    x, y = np.meshgrid(place * (image_size[0] - 1), place * (image_size[1] - 1))
    return np.stack([x.ravel(), y.ravel()], axis=1)


def _turn_by_vector(vector: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """The left Jacobian of SO(3): a change of the rotation vector to the small rotation that follows the old one."""
    matrix, by = cv2.Rodrigues(np.ascontiguousarray(vector))
    small = by.reshape(3, 3, 3) @ matrix.T
    return np.array([small[:, 2, 1], small[:, 0, 2], small[:, 1, 0]])


def weigh(
    solved: Solved,
    points: Points,
    free: Bool[np.ndarray, "9"],
    image_size: tuple[int, int],
    dof: float,
    rules: GeometryRules,
) -> tuple[Evidence, Float[np.ndarray, "n n"]]:
    """Tests of a solution, and its covariance, widened where the views disagree; ``dof`` are those behind sigma."""
    z, jacobian = in_sigma(solved.place, points)
    jacobian = jacobian * np.concatenate([free, np.ones(6)])
    matrix, right = by_view(z, jacobian, points)
    own = scaled_inverse(matrix[:, LENS:, LENS:], 1e-14)
    carried = -own @ matrix[:, LENS:, :LENS]
    # Each view's information on the free intrinsics, its pose eliminated; all views together have the size 1.
    information = (matrix[:, :LENS, :LENS] + matrix[:, :LENS, LENS:] @ carried)[:, free][:, :, free]
    score = (right[:, :LENS] + np.einsum("kji,kj->ki", carried, right[:, LENS:]))[:, free]
    unit = 1 / np.sqrt(np.maximum(np.einsum("kii->i", information), 1e-300))
    information, score = information * np.outer(unit, unit), score * unit
    views, cov = _disagreement(information, score, dof), solved.equations.joint_cov()
    pattern, size = _pattern(z, jacobian, points, cov, image_size, dof, rules.pattern_cells)
    if views.found:
        lens = solved.equations.cov()[np.ix_(free, free)] / np.outer(unit, unit)
        spread = np.zeros((LENS, LENS))
        spread[np.ix_(free, free)] = (clustered_cov(lens, score, information) - lens) * np.outer(unit, unit)
        cov = _widened(cov, spread, carried, own * (views.inflation - 1))
    return Evidence(pattern, views, size if pattern.found else 0.0), cov


def _widened(
    cov: Float[np.ndarray, "n n"],
    spread: Float[np.ndarray, "9 9"],
    carried: Float[np.ndarray, "views 6 9"],
    own: Float[np.ndarray, "views 6 6"],
) -> Float[np.ndarray, "n n"]:
    """The covariance with the spread of the lens, carried to the poses, and an addition to each pose's own part.

    The spread is that of the lens when one view after another is left out. Its 95 % intervals hold 93 to 98 % where
    boards are bent or lenses move; with one factor for all (Birge, 1932) they hold 83 to 99 %. Only its own view
    determines a pose.
    """
    along = np.vstack([np.eye(LENS), carried.reshape(-1, LENS)])
    wide = cov + along @ spread @ along.T
    for view, block in enumerate(own):
        mine = slice(LENS + 6 * view, LENS + 6 * view + 6)
        wide[mine, mine] += block
    return wide


def _disagreement(information: np.ndarray, score: np.ndarray, dof: float) -> MisfitTest:
    """Cochran's Q: sum over views of score' information^+ score, the distances of the views' minima from the common."""
    values, vectors = np.linalg.eigh(information)
    seen = values > 1e-9 * np.maximum(values[:, -1:], 1e-9)
    along = np.einsum("kij,ki->kj", vectors, score)
    total = float((along[seen] ** 2 / values[seen]).sum())
    return f_test(total, int(seen.sum()) - score.shape[1], dof)


def _pattern(
    z: np.ndarray,
    jacobian: np.ndarray,
    points: Points,
    cov: np.ndarray,
    image_size: tuple[int, int],
    dof: float,
    cells: int,
) -> tuple[MisfitTest, float]:
    """Test of sums over the cells of a grid by their covariance under the model, and the pattern's size in px.

    ``group_means_test`` does not serve here: the fit absorbs most of a smooth pattern, so that means of cells scatter
    far less than those of independent residuals. The covariance of the sums accounts for that.
    """
    place = np.clip(points.image / np.array(image_size) * cells, 0, cells - 1).astype(np.int64)
    cell = np.where(points.used, place[:, 1] * cells + place[:, 0], -1)
    inside = np.equal.outer(np.unique(cell[points.used]), cell).astype(np.float64)
    count, sums = np.repeat(inside.sum(axis=1), 2), (inside @ z).ravel()
    whole = np.zeros((len(z), 2, len(cov)))
    whole[:, :, :LENS] = jacobian[:, :, :LENS]
    columns = LENS + 6 * points.view[:, None, None] + np.arange(6)
    np.put_along_axis(whole, np.repeat(columns, 2, axis=1), jacobian[:, :, LENS:], axis=2)
    gathered = np.tensordot(inside, whole, 1).reshape(len(sums), -1)
    expected = np.diag(count) - gathered @ cov @ gathered.T
    values, vectors = np.linalg.eigh(expected)
    seen = values > 1e-6 * count.max()
    found = f_test(float(((vectors[:, seen].T @ sums) ** 2 / values[seen]).sum()), int(seen.sum()), dof)
    # Mean over the points of the squared mean of their cell, less the part that noise has in it.
    excess = float(((sums**2 - np.diag(expected)) / count).sum() / count.sum())
    return found, float(np.sqrt(max(excess, 0.0) * np.mean(points.sigma[points.used] ** 2)))


def status_of(
    solved: Solved, cov: Float[np.ndarray, "n n"], off_px: float, image_size: tuple[int, int], rules: GeometryRules
) -> tuple[FitStatus, tuple[str, ...]]:
    """Whether the views determine the lens, with residuals of RMS ``off_px``; else what to capture."""
    if off_px > rules.no_corners_px:
        return FitStatus.POOR_FIT, (
            f"Expected corners within {rules.no_corners_px:g} px of the fitted lens, found {off_px:.3g} px (RMS): no "
            "lens puts these board points there. Check that the points of each view are in the order of the board's.",
        )
    sigma, lens = Intrinsics.of(np.sqrt(np.diag(cov))), Intrinsics.of(solved.place.intrinsics)
    by_focal = float(np.max(sigma.focal_px / np.abs(lens.focal_px)))
    by_centre = float(np.max(sigma.principal_point_px)) / image_size[0]
    if max(by_focal, by_centre) > rules.most_uncertain:
        what = "focal length" if by_focal > by_centre else "centre of the picture"
        return FitStatus.TOO_FEW_DATA, (
            f"The views do not determine the {what} (one sigma is {min(max(by_focal, by_centre), 99.0):.0%}). "
            "Lean the board by 20 to 40 degrees, another way in each view, and let it fill the picture.",
        )
    if not solved.converged:
        return FitStatus.NOT_CONVERGED, ("Check that the points of each view are in the order of the board's.",)
    return FitStatus.CONVERGED, ()


def remarks(
    points: Points, scales: Float[np.ndarray, " views"], evidence: Evidence, by_prior: bool, rules: GeometryRules
) -> Iterator[str]:
    """What a person should know of a fit that can be used; ``scales`` are the views' scatter."""
    if by_prior:
        yield (
            "The views alone do not determine the whole lens: what is known beforehand gives part of it, and every "
            "distortion coefficient stays free within that. Lean the board another way in each view to know more."
        )
    relative = scales / np.median(scales)
    loud = [f"{points.names[k]} ({relative[k]:.1f} x)" for k in np.flatnonzero(relative > rules.loud_view)]
    if loud:
        yield f"Views that scatter more than the median view, and count for less: {', '.join(loud)}."
    yield from evidence.notes
