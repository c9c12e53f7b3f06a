"""What a term is without its data: nominal values to start from, an absent form, and what a session lacks for a fit.

A calibration uses the absent form, which does nothing, where a session has no steps for a term.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from udccal.fitting.backscatter.parameters import BackscatterRules
from udccal.fitting.noise.data import NoiseRules
from udccal.fitting.psf.data import PsfRules, group
from udccal.fitting.psf.start import start_model
from udccal.fitting.wire.parameters import ideal_wire, wire_start
from udccal.models.backscatter import Backscatter
from udccal.models.geometry import Geometry
from udccal.models.psf import PsfField
from udccal.models.wire import Wire
from udccal.mounting import nominal_pupil_mm, nominal_rotation
from udccal.rig import RigDescription
from udccal.sessions.schema import BoardSubject, DarkSubject, FlatSubject, LedSubject, PanelSubject, TermName
from udccal.sessions.store import Session


def nominal_geometry(rig: RigDescription) -> Geometry:
    """Return the geometry that a rig's description gives: no distortion, centred, at the nominal mounting.

    Args:
        rig: gives the focal length in px, the sensor's size, and the mounting (angles in degrees, lengths in mm).
    """
    return Geometry(
        focal_px=np.array([rig.focal_px, rig.focal_px]),
        principal_point_px=np.array([rig.camera.columns - 1, rig.camera.rows - 1]) / 2,
        distortion=np.zeros(5),
        rotation_rad=np.asarray(Rotation.from_matrix(nominal_rotation(rig)).as_rotvec(), dtype=np.float64),
        pupil_mm=nominal_pupil_mm(rig),
    )


def nominal_backscatter(
    geometry: Geometry, rig: RigDescription, mask: Float[np.ndarray, "3 a b"], step: int, window: int
) -> Backscatter:
    """Return a backscatter term with the rig's nominal dimensions; the fit starts from it.

    Args:
        geometry: gives the rays of the sensor's pixels.
        rig: gives the panel, the mounting, the pupil (all in mm) and the sensor.
        mask: rate of white on the grid of bins in e-/s, by camera colour.
        step: spacing of that grid in sensor px.
        window: number of panel pixels across the window that holds the footprints (odd).
    """
    panel = rig.panel
    return Backscatter(
        geometry=geometry,
        mask=mask,
        mix=np.eye(3),
        gamma=np.float64(panel.gamma.value),
        pitch_mm=np.float64(panel.pitch_mm.value),
        pupil_diameter_mm=np.float64(rig.pupil_diameter_mm),
        standoff_mm=np.float64(rig.mounting.standoff_mm.value),
        emitters_px=np.zeros((3, 2)),
        softness_px=np.float64(0.15),
        reflection=np.float64(0.5),
        reflection_mm=np.float64(2 * panel.glass_thickness_mm / panel.glass_index),
        columns=rig.camera.columns,
        rows=rig.camera.rows,
        cfa=rig.camera.cfa,
        step=step,
        window=window,
    )


def absent_wire(rig: RigDescription, geometry: Geometry) -> Wire:
    """Return a wire map that is 1 everywhere: the rig's panel, open all over, where ``geometry``'s rays meet it."""
    ideal = ideal_wire(geometry, wire_start(rig), np.zeros((0, 2)))
    return replace(ideal, row_open=np.float64(1.0), column_open=np.float64(1.0), depth_per_pitch=np.float64(0.0))


def absent_psf(rig: RigDescription, geometry: Geometry) -> PsfField:
    """Return a field whose kernel is a single pixel everywhere; the rig's nominal diffraction has the fraction 0."""
    middle, start = nominal_geometry(rig).principal_point_px, start_model(rig, geometry, absent_wire(rig, geometry))
    return PsfField(
        geometry=geometry,
        diffraction=replace(start, wavelengths_nm=np.linspace(400.0, 700.0, 4), spectrum=np.full((3, 4), 0.25)),
        diffraction_fraction=np.float64(0.0),
        residual=np.ones((1, 3, 1, 1)),
        centre_px=middle,
        half_px=middle,
        support_px=np.zeros(2),
        degree=0,
    )


def absent_backscatter(rig: RigDescription, geometry: Geometry) -> Backscatter:
    """Return a panel that sends no light back, with the nominal dimensions of panel and sensor of ``rig``."""
    step = min(rig.camera.columns, rig.camera.rows) // 2
    mask = np.zeros((3, rig.camera.rows // step, rig.camera.columns // step))
    term, nothing = nominal_backscatter(geometry, rig, mask, step, window=1), np.float64(0.0)
    return replace(term, softness_px=np.float64(0.2), reflection=nothing, reflection_mm=nothing)


def lacking(session: Session, term: TermName) -> str:
    """Return what the fit of a term cannot do without and the session does not have, in words; empty where nothing is.

    What was captured badly is not lacking: the fit says what is wrong with it.
    """
    steps = session.steps(term)
    shown, captured = [step.subject for step in steps], {step.id for step in steps}
    # A stack of frames at one exposure is no further exposure.
    flats, darks = (
        sum(isinstance(step.subject, kind) and not step.id.endswith("_stack") for step in steps)
        for kind in (FlatSubject, DarkSubject)
    )
    aims = np.array([(led.x_px, led.y_px) for led in shown if isinstance(led, LedSubject)]).reshape(-1, 2)
    roles = [picture.role for picture in shown if isinstance(picture, PanelSubject)]
    on_jig = any(isinstance(board, BoardSubject) and board.parallel_to_panel for board in shown)
    # What is needed, how many there are, and how many are needed.
    needed: dict[TermName, list[tuple[str, int, int]]] = {
        "noise": [("exposures of the even light", flats, NoiseRules().levels), ("exposures in the dark", darks, 2)],
        "geometry": [("a view of the board on the jig, parallel to the display", on_jig, 1)],
        "wire": [(step_id, step_id in captured, 1) for step_id in ("wire/flat", "wire/dark")],
        "psf": [("places of the LED", len(set(group(aims))), PsfRules().least_positions)],
        "backscatter": [
            ("backscatter/white", "white" in roles, 1),
            ("backscatter/dark", darks, 1),
            ("pictures beside the white one", len(roles) - roles.count("white"), BackscatterRules().fewest_pictures),
        ],
    }
    few = [one for one in needed[term] if one[1] < one[2]]
    return ", ".join(what if least == 1 else f"{least - seen} more {what}" for what, seen, least in few)
