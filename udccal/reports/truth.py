"""Compares a calibration of a simulated rig with its truth, as typed rows of numbers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from udccal.calibration import Calibration
from udccal.kernels import kernel_size
from udccal.models.geometry import Geometry, project
from udccal.numerics import in_float64
from udccal.quantities import quantity
from udccal.reports.maps import TermMaps
from udccal.reports.tables import Table, number, spread
from udccal.reports.true_values import true_values
from udccal.result import FitResult
from udccal.sessions.schema import TermName
from udccal.simulation.light import RigLight
from udccal.simulation.psf import kernels
from udccal.simulation.truth import RigTruth, pixels_to_directions

_CHANNELS = ("red", "green", "blue")
_RAY_GRID = 25
_ROTATIONS = 3


@dataclass(frozen=True)
class TruthRow:
    """One quantity of a term: its fitted value, its true value, and the error.

    ``fitted`` and ``truth`` are None for quantities that are a distance between two maps; ``sigma`` is None where the
    fit has none.
    """

    term: TermName
    quantity: str
    unit: str
    fitted: float | None
    truth: float | None
    error: float
    sigma: float | None


def true_maps(light: RigLight, like: TermMaps) -> TermMaps:
    """Return the simulated truth at the same places and for the same panel picture as ``like``."""
    return TermMaps(
        wire=light.wire,
        positions_px=like.positions_px,
        kernels=kernels(light.truth, like.positions_px, *kernel_size(light.truth.description)),
        picture=like.picture,
        seen_px=like.seen_px,
        backscatter=light.backscatterer.rate(like.picture),
    )


def compare_with_truth(
    calibration: Calibration, truth: RigTruth, fitted: TermMaps, true: TermMaps
) -> tuple[TruthRow, ...]:
    """Return every estimate whose truth the simulated rig has, and the errors of the terms' maps."""
    values = [
        TruthRow(true.term, one.name, one.unit, one.value, one.value - error, error, one.sigma or None)
        for true in true_values(truth)
        for one in calibration.result(true.term).estimates
        if one.name == true.name
        for error in (true.error_of(one.value),)
    ]
    ray = ray_error_px(calibration.geometry.term, truth)
    distances = (
        TruthRow("geometry", "rays, 95th percentile", "px", None, None, ray, None),
        _wire_distance(calibration.wire, fitted, true),
        *_psf_distances(fitted, true),
        _backscatter_distance(fitted, true),
    )
    order = [f.term for f in calibration.times]
    return tuple(sorted((*values, *distances), key=lambda row: order.index(row.term)))


def truth_table(rows: tuple[TruthRow, ...]) -> Table:
    """Return ``rows`` as a table of text."""
    text = tuple(
        (
            row.term,
            quantity(row.term, row.quantity).plain,
            "–" if row.fitted is None else number(row.fitted, row.sigma),
            "–" if row.truth is None else number(row.truth, row.sigma),
            number(row.error, abs(row.error)),
            spread(row.sigma),
            row.unit,
        )
        for row in rows
    )
    columns = ("term", "quantity", "fitted", "truth", "error", "sigma", "unit")
    return Table("Fitted against the simulated truth", columns, text, frozenset({2, 3, 4, 5}))


@in_float64
def ray_error_px(geometry: Geometry, truth: RigTruth) -> float:
    """Return the 95th percentile over the sensor of the fitted lens's projection errors of true rays, in px.

    Both lenses are compared in camera coordinates after the rotation that brings their rays closest (two descriptions
    of one lens may differ by a rotation that the pose absorbs; the tilt is compared on its own).
    """
    camera = truth.description.camera
    x, y = np.meshgrid(np.linspace(0, camera.columns - 1, _RAY_GRID), np.linspace(0, camera.rows - 1, _RAY_GRID))
    pixels = np.stack([x.ravel(), y.ravel()], axis=-1)
    rays = pixels_to_directions(truth.optics, pixels) @ truth.optics.R_panel_camera
    for _ in range(_ROTATIONS):  # the projection is almost linear in so small a rotation
        errors = np.asarray(project(geometry, rays)) - pixels
        rays = rays @ _rotation_against(rays, errors / np.asarray(geometry.focal_px)).T
    errors = np.asarray(project(geometry, rays)) - pixels
    return float(np.percentile(np.hypot(errors[:, 0], errors[:, 1]), 95))


def _rotation_against(rays: Float[np.ndarray, "n 3"], errors: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "3 3"]:
    """Return the small rotation of rays that removes the common part of errors in normalised image coordinates."""
    u, v = rays[:, 0] / rays[:, 2], rays[:, 1] / rays[:, 2]
    # d(u, v) of a rotation by (a, b, c) about x, y, z
    by_u = np.stack([-u * v, 1 + u**2, -v], axis=-1)
    by_v = np.stack([-(1 + v**2), u * v, u], axis=-1)
    design, wanted = np.concatenate([by_u, by_v]), -np.concatenate([errors[:, 0], errors[:, 1]])
    a, b, c = np.linalg.lstsq(design, wanted, rcond=None)[0]
    left, _, right = np.linalg.svd(np.array([[1.0, -c, b], [c, 1.0, -a], [-b, a, 1.0]]))
    return left @ right


def _wire_distance(result: FitResult, fitted: TermMaps, true: TermMaps) -> TruthRow:
    rms = 100.0 * float(np.sqrt(np.mean((fitted.wire / true.wire - 1.0) ** 2)))
    sigma = next((d.value for d in result.diagnostics if d.name == "wire_map_rms_sigma"), None)
    return TruthRow("wire", "map, RMS", "%", None, None, rms, sigma)


def _psf_distances(fitted: TermMaps, true: TermMaps) -> tuple[TruthRow, ...]:
    """Return the relative L2 error per colour, mean over places that were not captured."""
    difference = np.sum((fitted.kernels - true.kernels) ** 2, axis=(2, 3))
    relative = 100.0 * np.sqrt(difference / np.sum(true.kernels**2, axis=(2, 3)))
    return tuple(
        TruthRow("psf", f"unseen places, L2, {name}", "%", None, None, float(mean), None)
        for name, mean in zip(_CHANNELS, relative.mean(axis=0), strict=True)
    )


def _backscatter_distance(fitted: TermMaps, true: TermMaps) -> TruthRow:
    rms = float(np.sqrt(np.mean((fitted.backscatter - true.backscatter) ** 2)))
    share = 100.0 * rms / max(float(true.backscatter.max()), 1e-12)
    return TruthRow("backscatter", "unseen picture, RMS / peak", "%", None, None, share, None)
