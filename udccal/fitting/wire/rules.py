"""The constants of a wire fit, and the rig as built, where it starts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

from udccal.rig import RigDescription


@final
@dataclass(frozen=True)
class WireRules:
    """The constants of a wire fit.

    Attributes:
        samples: pixels of the joint fit; time grows with it, the map's sigma falls with its square root.
        search_share, shape_share: of these, for the search of the shape and for its first full fit.
        search_harmonics: the strongest are enough for the search.
        least_samples: pixels that a flat must have.
        most_clipped: part of the flat's pixels that may be clipped.
        headroom_sigma: single frames must stay so far below saturation, or their average is bent.
        rotation_sigma_rad: how far the geometry's own rotation may be off.
        widening: the rig's tolerances are bounds on a careful build; the prior's sigma is so many of them.
        amplitude_sigma, field_sigma: prior of amplitudes beside the pupil's, and of relative changes of its transform.
        least_amplitude: relative size from which harmonics are fitted; the others are part of the map's sigma.
        least_counted: relative size from which they count there.
        strong, middle: relative sizes from which a harmonic may have many or few corrections to the round pupil.
        smooth_degree: highest total degree of the shading; up to ``always_smooth`` it is not asked for.
        scan_range: of stand-off and of pupil, relative to the rig description: two lengths that are divided, 20 % off.
        scan_periods: step of the scan, in periods at the edge of the field.
        scan_z: the same in radians of z, the argument of the pupil's transform.
        places: most of the scan's places that are looked into.
        rival: minus twice the log posterior; places that differ by less may change their order with more pixels.
        unfinished: the same after the first steps only.
        doubtful_variance: residual variance beyond which amplitudes that no pupil explains are tried, of
            ``free_harmonics`` harmonics up to ``free_degree`` over the sensor.
        least_gain: chi-squared that rows must explain; chance does not reach a third of it in 300 trials.
        worst_variance: structure that the model lacks, as strong as shot noise and PRNU together.
        doubted_sigma: beyond so many prior sigmas the rig description is doubted.
    """

    samples: int = 300_000
    search_share: float = 1 / 15
    shape_share: float = 1 / 6
    search_harmonics: int = 24
    least_samples: int = 4000
    most_clipped: float = 0.05
    headroom_sigma: float = 5.0
    rotation_sigma_rad: float = 0.04
    widening: float = 2.0
    amplitude_sigma: float = 0.05
    field_sigma: float = 0.5
    least_amplitude: float = 3e-5
    least_counted: float = 1e-6
    strong: float = 2e-3
    middle: float = 2e-4
    smooth_degree: int = 8
    always_smooth: int = 4
    scan_range: tuple[float, float] = (0.64, 1.56)
    scan_periods: float = 0.06
    scan_z: float = 0.8
    places: int = 5
    rival: float = 60.0
    unfinished: float = 400.0
    doubtful_variance: float = 1.15
    free_harmonics: int = 3
    free_degree: int = 3
    least_gain: float = 100.0
    worst_variance: float = 2.0
    doubted_sigma: float = 3.0


@final
@dataclass(frozen=True)
class WireStart:
    """The rig as built, lengths in panel periods. Tolerances are absolute but those of stand-off and pupil."""

    standoff_per_pitch: float
    standoff_tolerance: float
    footprint_per_pitch: float
    pupil_tolerance: float
    row_open: float
    row_tolerance: float
    column_open: float
    column_tolerance: float
    depth_per_pitch: float
    depth_tolerance: float


def wire_start(rig: RigDescription) -> WireStart:
    """Start values of a rig description."""
    panel, lens, standoff = rig.panel, rig.lens, rig.mounting.standoff_mm
    pitch, depth = panel.pitch_mm.value, panel.depth_mm
    pitch_tolerance = panel.pitch_mm.tolerance / pitch
    lens_tolerance = lens.focal_mm.tolerance / lens.focal_mm.value + lens.f_number.tolerance / lens.f_number.value
    return WireStart(
        standoff_per_pitch=standoff.value / pitch,
        standoff_tolerance=standoff.tolerance / standoff.value + pitch_tolerance,
        # The beam narrows a little from the pupil to the panel on its way to the focus distance.
        footprint_per_pitch=rig.pupil_diameter_mm * (1 - standoff.value / lens.focus_mm) / pitch,
        pupil_tolerance=lens_tolerance + pitch_tolerance,
        row_open=panel.row_open.value,
        row_tolerance=panel.row_open.tolerance,
        column_open=panel.column_open.value,
        column_tolerance=panel.column_open.tolerance,
        depth_per_pitch=depth.value / pitch,
        depth_tolerance=depth.tolerance / pitch,
    )
