"""The inputs of a wire fit: its constants, the rig as built, and the harmonics that its panel can show."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float

from udccal.fitting.engine.least_squares import SolverRules
from udccal.models.geometry import Geometry
from udccal.models.wire import HIGHEST_ORDER, Wire
from udccal.rig import RigDescription

# Weakly determined parameters may creep on for ever: the descent ends at a tenth of a sigma, or when steps stall.
SOLVER = SolverRules(least_gain=1e-2, stalled_gain=0.1)


@final
@dataclass(frozen=True)
class WireRules:
    """The constants of a wire fit.

    Attributes:
        samples: pixels of the joint fit; time grows with it, the map's sigma falls with its square root.
        search_part, shape_part: parts of ``samples`` for the search of the shape and for its first full fit.
        search_harmonics: number of the strongest harmonics, which are enough for the search.
        least_samples: fewest pixels of a flat.
        most_clipped: part of the flat's pixels that may be clipped.
        headroom_sigma: distance of single frames from saturation; with less, their average is not linear.
        rotation_sigma_rad: prior sigma of the rotation about the geometry's own.
        widening: the prior's sigma in units of the rig's tolerances, which are bounds of a careful build.
        amplitude_sigma, field_sigma: prior sigma of free amplitudes, and of relative changes of the pupil's transform.
        least_amplitude: relative size from which harmonics are fitted; the others are part of the map's sigma.
        least_counted: relative size from which the others count there.
        strong: relative sizes from which a harmonic may have many or few corrections to the round pupil.
        smooth_degrees: of the shading: those up to the first are always fitted, those up to the second if supported.
        scan_range: of stand-off and of pupil, relative to the rig description: a quotient of lengths, each 20 % off.
        scan_steps: of the stand-off in periods at the edge of the field, and of the pupil in radians of z, the
            argument of its transform.
        places: most places of the scan from which descents start.
        sharpness: of the openings' edges, to try; see ``with_harmonics``.
        rival: difference in minus twice the log posterior below which places may change their order with more pixels.
        unfinished: the same difference after the first steps.
        doubtful_variance: residual variance beyond which free amplitudes, which no pupil explains, are tried.
        free: number of harmonics with free amplitudes, and their degree over the sensor.
        least_gain: chi-squared that rows must explain; chance does not reach a third of it in 300 trials.
        worst_variance: residual variance beyond which the fit is poor: model error as strong as shot noise and PRNU.
        doubted_sigma: deviation in prior sigmas beyond which the rig description is doubted.
    """

    samples: int = 300_000
    search_part: float = 1 / 15
    shape_part: float = 1 / 6
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
    strong: tuple[float, float] = (2e-3, 2e-4)
    smooth_degrees: tuple[int, int] = (4, 8)
    scan_range: tuple[float, float] = (0.64, 1.56)
    scan_steps: tuple[float, float] = (0.06, 0.8)
    places: int = 5
    sharpness: tuple[float, ...] = (1.0, 0.5, 0.0)
    rival: float = 60.0
    unfinished: float = 400.0
    doubtful_variance: float = 1.15
    free: tuple[int, int] = (3, 3)
    least_gain: float = 100.0
    worst_variance: float = 2.0
    doubted_sigma: float = 3.0


@final
@dataclass(frozen=True)
class WireStart:
    """The rig as built, lengths in panel periods. Tolerances of stand-off and pupil are relative, others absolute."""

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
    """The start values of a wire fit by a rig's panel, lens and stand-off."""
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


@final
@dataclass(frozen=True)
class Harmonics:
    """Whole numbers (n, m), and the bound of each one's relative amplitude, largest first."""

    orders: Float[np.ndarray, "harmonics 2"]
    bounds: Float[np.ndarray, " harmonics"]


def possible_harmonics(start: WireStart, least: float = WireRules.least_amplitude, below: float = np.inf) -> Harmonics:
    """Harmonics whose relative amplitude has a bound from ``least`` (by default the fitted ones') to ``below``.

    The bound is the slits' times the envelope of 2 J1(z) / z, z = pi D kappa / pitch, for a round pupil.
    """
    orders = np.arange(HIGHEST_ORDER + 1.0)
    m, n = (part.ravel() for part in np.meshgrid(orders, np.concatenate([-orders[:0:-1], orders]), indexing="ij"))
    n, m = n[(m > 0) | (n > 0)], m[(m > 0) | (n > 0)]
    z = np.pi * start.footprint_per_pitch * np.hypot(n, m)
    size = np.where((n != 0) & (m != 0), 0.5, 1.0) * np.minimum(1.0, 2 * np.sqrt(2 / np.pi) / z**1.5)
    for order, opening in ((m, start.row_open), (np.abs(n), start.column_open)):
        slit = np.minimum(2.0 / (np.pi * np.maximum(order, 1) * opening), 2.0 * (1 - opening) / opening)
        size = size * np.where(order == 0, 1.0, slit)
    found = [i for i in np.argsort(-size, kind="stable") if least <= size[i] < below]
    return Harmonics(np.stack([n[found], m[found]], axis=1), size[found])


def ideal_wire(
    geometry: Geometry, start: WireStart, harmonics: Float[np.ndarray, "harmonics 2"], rules: WireRules | None = None
) -> Wire:
    """The wire of the rig as built, with a round pupil and an even field; ranges of kappa are not set.

    Args:
        geometry: gives the rays.
        start: the rig as built.
        harmonics: orders (n, m) along X and Y.
        rules: for the degrees of the shading.
    """
    degrees = (rules or WireRules()).smooth_degrees[1] + 1
    fields = np.zeros((len(harmonics), 2, 2, 4))
    fields[:, 0, 0, 0] = 1.0
    return Wire(
        geometry=geometry,
        rotation_rad=np.zeros(3),
        standoff_per_pitch=np.float64(start.standoff_per_pitch),
        offset_periods=np.zeros(2),
        footprint_per_pitch=np.float64(start.footprint_per_pitch),
        row_open=np.float64(start.row_open),
        column_open=np.float64(start.column_open),
        depth_per_pitch=np.float64(start.depth_per_pitch),
        harmonics=harmonics,
        frequency=np.tile([0.0, 1.0], (len(harmonics), 1)),
        fields=fields,
        amplitudes=np.zeros((0, 2, 1, 1)),
        baseline=np.zeros((degrees, degrees)),
    )
