"""A profile's terms after a change of the camera's pose, of its gain and of the panel's brightness."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from udccal.fitting.wire.parameters import shape_vector, with_shape
from udccal.models.backscatter import Backscatter
from udccal.models.geometry import Geometry
from udccal.models.psf import PsfField
from udccal.models.wire import Wire

_POSE, _FOCAL = 6, 6


def moved_geometry(term: Geometry, change: Float[np.ndarray, "7"]) -> Geometry:
    """Return the term turned and refocused by a ``PoseChange``'s values."""
    turned = Rotation.from_rotvec(change[:3]) * Rotation.from_rotvec(np.asarray(term.rotation_rad, dtype=np.float64))
    focal = np.asarray(term.focal_px, dtype=np.float64) * np.exp(change[_FOCAL])
    return replace(term, rotation_rad=turned.as_rotvec(), focal_px=focal)


def moved_wire(term: Wire, change: Float[np.ndarray, "7"]) -> Wire:
    """Return the term at another pose: its geometry turns, and its own rotation stays."""
    shape = shape_vector(term)
    shape[3:_POSE] += change[3:_POSE]
    return with_shape(replace(term, geometry=moved_geometry(term.geometry, change)), shape)


def movement_mm(term: Wire, change: Float[np.ndarray, "7"], pitch_mm: float) -> Float[np.ndarray, "3"]:
    """Return the movement (x, y, z) of the entrance pupil in the panel's frame, in mm."""
    away = float(term.standoff_per_pitch) * np.expm1(change[3])
    return pitch_mm * np.array([change[4], change[5], -away])


def moved_backscatter(
    term: Backscatter, wire: Wire, change: Float[np.ndarray, "7"], level: Float[np.ndarray, "3"]
) -> Backscatter:
    """Return the term at another pose, with a panel that is ``level`` times as bright by camera colour."""
    pitch = float(term.pitch_mm)
    x, y, z = movement_mm(wire, change, pitch)
    return replace(
        term,
        geometry=moved_geometry(term.geometry, change),
        standoff_mm=np.asarray(term.standoff_mm) - z,
        emitters_px=np.asarray(term.emitters_px) - np.array([x, y]) / pitch,
        mask=np.asarray(term.mask) * level[:, None, None],
    )


def moved_psf(term: PsfField, change: Float[np.ndarray, "7"]) -> PsfField:
    """Return the term at another pose: rays turn, and the pupil's footprint lies elsewhere on the rows."""
    model = term.diffraction
    there = replace(
        model,
        offset_periods=np.asarray(model.offset_periods) + change[4:_POSE],
        standoff_per_pitch=np.asarray(model.standoff_per_pitch) * np.exp(change[3]),
    )
    return replace(term, geometry=moved_geometry(term.geometry, change), diffraction=there)
