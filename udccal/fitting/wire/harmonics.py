"""Where the wire fit starts, which harmonics a panel can show, and how many coefficients each may need."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from udccal.fitting.wire.basis import SITES, Basis
from udccal.models.wire import HIGHEST_ORDER
from udccal.rig import RigDescription

# Harmonics of a smaller relative size are left out: a thousand of them, 0.01 % together, which is part of the map's
# sigma. Those below the second number do not add to that.
LEAST_AMPLITUDE, _LEAST_COUNTED = 3e-5, 1e-6
_STRONG, _MIDDLE = 2e-3, 2e-4
SMOOTH_DEGREE = 8
_ALWAYS_SMOOTH = 4
FIELD_DEGREES = 4


@dataclass(frozen=True)
class WireStart:
    """The rig as built, lengths in panel periods. Tolerances are absolute but those of stand-off and pupil."""

    standoff_per_pitch: float
    standoff_tolerance: float
    pupil_per_pitch: float
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
    pitch = panel.pitch_mm.value
    pitch_tolerance = panel.pitch_mm.tolerance / pitch
    return WireStart(
        standoff_per_pitch=standoff.value / pitch,
        standoff_tolerance=standoff.tolerance / standoff.value + pitch_tolerance,
        # The beam narrows a little from the pupil to the panel on its way to the focus distance.
        pupil_per_pitch=rig.pupil_mm * (1 - standoff.value / lens.focus_mm) / pitch,
        pupil_tolerance=lens.focal_mm.tolerance / lens.focal_mm.value
        + lens.f_number.tolerance / lens.f_number.value
        + pitch_tolerance,
        row_open=panel.row_open_fraction.value,
        row_tolerance=panel.row_open_fraction.tolerance,
        column_open=panel.column_open_fraction.value,
        column_tolerance=panel.column_open_fraction.tolerance,
        depth_per_pitch=panel.structure_thickness_mm.value / pitch,
        depth_tolerance=panel.structure_thickness_mm.tolerance / pitch,
    )


def _slit(order: int, open_fraction: float) -> float:
    """Bound of a slit grating's coefficient relative to its mean; order 0 gives 1."""
    if order == 0:
        return 1.0
    return min(2.0 / (np.pi * order * open_fraction), 2.0 * (1 - open_fraction) / open_fraction)


def possible_harmonics(start: WireStart) -> tuple[Float[np.ndarray, "harmonics 2"], Float[np.ndarray, " harmonics"]]:
    """(n, m) and the bound of its relative amplitude, largest first.

    The bound is the slits' times the envelope of 2 J1(z) / z, z = pi D kappa / pitch, for a round pupil.
    """
    return _harmonics_between(start, LEAST_AMPLITUDE, np.inf)


def omitted_harmonics(
    start: WireStart,
) -> tuple[Float[np.ndarray, "harmonics 2"], Float[np.ndarray, " harmonics"]]:
    """(n, m) of those that a fit leaves out, as far as they matter together, and their bounds; largest first."""
    return _harmonics_between(start, _LEAST_COUNTED, LEAST_AMPLITUDE)


def _harmonics_between(
    start: WireStart, least: float, below: float
) -> tuple[Float[np.ndarray, "harmonics 2"], Float[np.ndarray, " harmonics"]]:
    found = []
    for m in range(HIGHEST_ORDER + 1):
        for n in range(-HIGHEST_ORDER if m else 1, HIGHEST_ORDER + 1):
            if n == 0 and m == 0:
                continue
            z = np.pi * start.pupil_per_pitch * np.hypot(n, m)
            size = (0.5 if n and m else 1.0) * _slit(m, start.row_open) * _slit(abs(n), start.column_open)
            size *= min(1.0, 2 * np.sqrt(2 / np.pi) / z**1.5)
            if least <= size < below:
                found.append((size, float(n), float(m)))
    found.sort(key=lambda item: -item[0])
    return np.array([item[1:] for item in found]).reshape(-1, 2), np.array([item[0] for item in found])


def plain_basis(degree: int = SMOOTH_DEGREE) -> Basis:
    """Baseline up to a total degree, and site gains."""
    pairs = _pairs(degree)
    none = np.zeros((0, 4), dtype=np.int64)
    return Basis(pairs, none, none, np.full(len(pairs) + SITES - 1, -1))


def free_basis(strongest: int, degree: int) -> Basis:
    """The plain basis, and amplitudes of the strongest harmonics up to a total degree over the sensor."""
    plain = plain_basis()
    amplitudes = [(h, phase, *pair) for h in range(strongest) for phase in (0, 1) for pair in _pairs(degree)]
    groups = np.full(len(plain.groups) + len(amplitudes), -1)
    return Basis(plain.baseline, np.array(amplitudes, dtype=np.int64).reshape(-1, 4), plain.fields, groups)


def _pairs(degree: int) -> Int[np.ndarray, "pairs 2"]:
    return np.array([(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)])


def full_basis(sizes: Float[np.ndarray, " harmonics"], free: Basis) -> Basis:
    """What ``free`` has, and every correction to the round pupil that may be needed: more for stronger harmonics."""
    fields: list[tuple[int, int, int, int]] = []
    degrees = free.baseline.sum(axis=1)
    groups = [-1 if d <= _ALWAYS_SMOOTH else int(d) for d in degrees] + [-1] * (SITES - 1)
    group = SMOOTH_DEGREE
    for harmonic, phase, *pair in free.amplitudes:
        groups.append(group + 1 + int((2 * harmonic + phase) * (SMOOTH_DEGREE + 1) + sum(pair)))
    group = max(groups[-1], group)
    for h, size in enumerate(sizes):
        # What a real pupil changes of the weakest harmonics is too small to be seen.
        cosines, sines = (4, 3) if size > _STRONG else (2, 1) if size > _MIDDLE else (0, 0)
        for phase, count in ((0, cosines), (1, sines)):
            for degree in range(count):
                # The two carriers of a degree stand or fall together.
                fields += [(h, phase, carrier, degree) for carrier in (0, 1)]
                group += 1
                groups += [group] * 2
    return Basis(free.baseline, free.amplitudes, np.array(fields, dtype=np.int64).reshape(-1, 4), np.array(groups))
