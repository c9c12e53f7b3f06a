"""The rig from the side, to scale, as SVG: panel, camera, its view, and what stands before it."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from udccal.arrangements import Arrangement, Board, Dark, FlatLight, Led, PanelPicture, Photograph
from udccal.mounting import nominal_pupil_mm, nominal_rotation
from udccal.rig import RigDescription

# Where nothing stands before the panel, and where the flat light does.
_NEAR_MM, _FLAT_MM = 300.0, 60.0
_CAMERA_MM = 45.0
_MARGIN = 0.05
_TEXT = 0.035  # of the drawing's larger side
_LINE = 'stroke="currentColor" fill="none" vector-effect="non-scaling-stroke"'

Places = Float[np.ndarray, "n 2"]


def side_view(rig: RigDescription, arrangement: Arrangement) -> str:
    """Draw the nominal rig with an arrangement.

    Args:
        rig: as built.
        arrangement: what stands before the camera.

    Returns:
        SVG in mm without a size of its own. Right is away from the panel, to the viewer; down is down. Lines have the
        colour of the text around; what a person sets up has the class ``wanted``.
    """
    height = rig.panel.rows * rig.panel.pitch_mm.value
    wanted, label = _wanted(rig, arrangement)
    reach = max(_NEAR_MM, float(wanted[:, 0].max()))
    view = _view(rig, reach)
    everything = np.concatenate([wanted, view, _camera(rig), [[0.0, 0.0], [0.0, height]]])
    low, high = everything.min(axis=0), everything.max(axis=0)
    size = float((high - low).max())
    low, high = low - _MARGIN * size, high + _MARGIN * size
    capped = isinstance(arrangement, Dark)
    lit = isinstance(arrangement, PanelPicture)
    parts = [
        f'<polygon class="view" points="{_points(view)}" fill="currentColor" fill-opacity="0.08"/>',
        f'<polygon class="camera" points="{_points(_camera(rig))}" fill="currentColor"/>',
        f'<line class="panel{" wanted" if lit else ""}" x1="0" y1="0" x2="0" y2="{height:.1f}" {_LINE} '
        f'stroke-width="{5 if lit else 2}"/>',
    ]
    if not (capped or lit):
        parts.append(f'<polyline class="wanted" points="{_points(wanted)}" {_LINE} stroke-width="6"/>')
        parts += [f'<circle class="wanted" cx="{x:.1f}" cy="{y:.1f}" r="{0.012 * size:.1f}"/>' for x, y in wanted[:1]]
    parts.append(
        f'<text x="{low[0]:.1f}" y="{high[1]:.1f}" font-size="{_TEXT * size:.1f}" fill="currentColor">{label}</text>'
    )
    box = " ".join(f"{value:.1f}" for value in (*low, *(high - low)))
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="{box}" role="img" aria-label="{label}">'
        f"{''.join(parts)}</svg>"
    )


def _wanted(rig: RigDescription, arrangement: Arrangement) -> tuple[Places, str]:
    """Return what a person sets up as (z, y) in mm, and a few words for it."""
    match arrangement:
        case Led(x_px, y_px, distance_mm):
            return _on_ray(rig, x_px, y_px, distance_mm)[None], f"LED, {distance_mm / 1000:g} m before the panel"
        case Board(spec):
            half = spec.columns * spec.square_mm / 2
            edges = np.array([[half, 0.0, 0.0], [half, spec.rows * spec.square_mm, 0.0]])
            turned = Rotation.from_rotvec(arrangement.rotation_vector).apply(edges) + arrangement.translation_mm
            return turned[:, [2, 1]], f"board, {turned[:, 2].mean() / 1000:.2f} m before the panel"
        case FlatLight():
            middle = (rig.camera.columns - 1) / 2
            ends = [_on_ray(rig, middle, row, _FLAT_MM) for row in (0.0, rig.camera.rows - 1.0)]
            return np.stack(ends), f"even light, {_FLAT_MM:.0f} mm before the panel"
        case Dark():
            return _camera(rig), "cap on the lens, panel off"
        case PanelPicture():
            return np.zeros((1, 2)), "panel lit, no other light"
        case Photograph(distance_mm=distance_mm):
            return np.array([[distance_mm, 0.0]]), f"scene, {distance_mm / 1000:g} m before the panel"


def _view(rig: RigDescription, reach_mm: float) -> Places:
    """Return the triangle that the camera sees, out to a distance from the panel."""
    pupil, middle = nominal_pupil_mm(rig)[[2, 1]], (rig.camera.columns - 1) / 2
    return np.stack([pupil, *(_on_ray(rig, middle, row, reach_mm) for row in (0.0, rig.camera.rows - 1.0))])


def _camera(rig: RigDescription) -> Places:
    """Return a box behind the pupil, turned as the camera is."""
    pupil, axis = nominal_pupil_mm(rig)[[2, 1]], nominal_rotation(rig)[[2, 1], 2]
    axis = axis / np.linalg.norm(axis)
    across = np.array([-axis[1], axis[0]]) * _CAMERA_MM / 2
    back = pupil - axis * _CAMERA_MM
    return np.stack([pupil + across, pupil - across, back - across, back + across])


def _on_ray(rig: RigDescription, x_px: float, y_px: float, distance_mm: float) -> Float[np.ndarray, "2"]:
    """Return (z, y) in mm at which a pixel's ray reaches a distance from the panel."""
    camera, pupil = rig.camera, nominal_pupil_mm(rig)
    middle = np.array([(camera.columns - 1) / 2, (camera.rows - 1) / 2])
    across, down = (np.array([x_px, y_px]) - middle) / rig.focal_px
    ray = nominal_rotation(rig) @ np.array([across, down, 1.0])
    place = pupil + ray * (distance_mm - pupil[2]) / max(float(ray[2]), 0.05)  # a grazing ray would leave the drawing
    return np.asarray(place[[2, 1]])


def _points(places: Places) -> str:
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in places)
