"""What a bundle of views gives: intrinsics and poses with their uncertainty, and the evidence for them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from udccal.fitting.geometry.bundle_evidence import Evidence
from udccal.fitting.geometry.bundle_projection import Gauge, projection_covariance
from udccal.fitting.geometry.bundle_solve import Bundle
from udccal.result import Candidate, FitStatus, Outliers


@dataclass(frozen=True)
class CalibratedViews:
    """Intrinsics and poses with their uncertainty, and the evidence for them.

    A pose takes board coordinates to camera coordinates: rotation vector (rad), then translation (board's unit).

    Attributes:
        focal, centre: (fx, fy) and (cx, cy) in px.
        distortion: (k1, k2, p1, p2, k3); 0 where the data do not ask for it.
        poses: of the views in use.
        cov: of (fx, fy, cx, cy, k1, k2, p1, p2, k3, then 6 per view in use). The scale of the noise is estimated,
            and where the views disagree beyond it, what they disagree by is added.
        points_px: the finite points of all views in use one after another. residuals_px: projected minus these.
        view: whose points they are, counted over the views in use. index: their place in their view as given.
        used: which are not outliers.
        names: the views in use, by their place in what was given.
        sigma_px: of each point, as estimated: the sigma given times the scale of its scatter.
        free: which intrinsics were fitted.
        chi2_dof: scatter over the sigma given, squared; 1 where none was given.
        candidates: the orders of the distortion, by BIC.
        evidence: tests of the model.
        status: ``CONVERGED``, or why not to use this; ``notes`` say what to do.
        outliers: points left out.
        iterations: of the last solve with all distortions free.
        starts_agreeing: how many of the starts led to this minimum.
        image_size: (columns, rows).
    """

    focal: Float[np.ndarray, "2"]
    centre: Float[np.ndarray, "2"]
    distortion: Float[np.ndarray, "5"]
    poses: Float[np.ndarray, "views 6"]
    cov: Float[np.ndarray, "n n"]
    points_px: Float[np.ndarray, "points 2"]
    residuals_px: Float[np.ndarray, "points 2"]
    view: Int[np.ndarray, " points"]
    index: Int[np.ndarray, " points"]
    used: Bool[np.ndarray, " points"]
    names: tuple[int, ...]
    sigma_px: Float[np.ndarray, " points"]
    free: tuple[bool, ...]
    chi2_dof: float
    candidates: tuple[Candidate, ...]
    evidence: Evidence
    status: FitStatus
    notes: tuple[str, ...]
    outliers: tuple[Outliers, ...]
    iterations: int
    starts_agreeing: int
    image_size: tuple[int, int]

    @property
    def converged(self) -> bool:
        """Whether this can be used."""
        return self.status is FitStatus.CONVERGED

    @property
    def intrinsics(self) -> Float[np.ndarray, "9"]:
        """In the order of ``INTRINSIC_NAMES``."""
        return np.concatenate([self.focal, self.centre, self.distortion])

    @property
    def rms_px(self) -> float:
        """Root of the mean squared distance between seen and projected points, as OpenCV's calibrateCamera counts."""
        return float(np.sqrt((self.residuals_px[self.used] ** 2).sum(axis=1).mean()))

    def projection_covariance(
        self, pixels: Float[np.ndarray, "rays 2"], gauge: Gauge = Gauge.BOARDS
    ) -> Float[np.ndarray, "rays 2 2"]:
        """Covariance in px^2 of where the rays that the fit puts at these pixels land.

        A pattern that the residuals show beyond chance is an error of the model; its size is added.
        """
        bundle = Bundle(self.intrinsics, self.poses)
        cov = projection_covariance(bundle, self.cov, self.image_size, np.asarray(pixels, dtype=np.float64), gauge)
        return cov + self.evidence.pattern_px**2 * np.eye(2)
