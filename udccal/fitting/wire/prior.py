"""What is known of the wire before the data: the rig as built for the shape, small departures from a round pupil."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import final

import numpy as np
from jaxtyping import Float

from udccal.fitting.wire.basis import SITES, Basis
from udccal.fitting.wire.harmonics import WireStart
from udccal.fitting.wire.slopes import SHAPE_PARAMETERS, shape_vector
from udccal.models.wire import Wire

# How far the geometry's own rotation may be off (rad); where the origin is, in periods, is not known.
ROTATION_SIGMA, _ORIGIN_SIGMA = 0.04, 1.0
# The rig's tolerances are bounds on a careful build; the fit may go somewhat beyond.
_WIDENING = 2.0
# Amplitudes beside the pupil's; changes of the pupil's transform relative to itself.
_AMPLITUDE_SIGMA, _FIELD_SIGMA = 0.05, 0.5
_LEAST_SIGMA = 1e-6


@final
@dataclass(frozen=True)
class Prior:
    """Normal distributions of the ten shape parameters, in the order of ``shape_vector``, and of the linear ones."""

    centre: Float[np.ndarray, "10"]
    sigma: Float[np.ndarray, "10"]

    def around(self, wire: Wire) -> Prior:
        """With the origin that a scan found as its centre."""
        centre = self.centre.copy()
        centre[4:6] = np.asarray(wire.offset)
        return replace(self, centre=centre)

    def offsets(self, wire: Wire, basis: Basis, shape: bool) -> Float[np.ndarray, " all"]:
        """How far ``wire`` is from the centre, column by column."""
        beside = np.asarray(wire.amplitudes)[tuple(basis.amplitudes.T)]
        fields = np.asarray(wire.fields)[tuple(basis.fields.T)]
        round_pupil = np.all(basis.fields[:, 1:] == 0, axis=1)
        linear = np.concatenate([np.zeros(len(basis.baseline) + SITES - 1), beside, fields - round_pupil])
        return np.concatenate([linear, shape_vector(wire) - self.centre]) if shape else linear

    def precision(self, basis: Basis, shape: bool) -> Float[np.ndarray, " all"]:
        """Inverse variance, column by column; 0 where nothing is known."""
        free = np.zeros(len(basis.baseline) + SITES - 1)
        beside = np.full(len(basis.amplitudes), _AMPLITUDE_SIGMA**-2)
        linear = np.concatenate([free, beside, np.full(len(basis.fields), _FIELD_SIGMA**-2)])
        return np.concatenate([linear, self.sigma**-2.0]) if shape else linear

    def cost(self, wire: Wire, basis: Basis, shape: bool) -> float:
        """What the prior adds to chi-squared at ``wire``."""
        return float(np.sum(self.offsets(wire, basis, shape) ** 2 * self.precision(basis, shape)))


def rig_prior(start: WireStart) -> Prior:
    """From the rig description; stand-off and pupil are logarithms."""
    sizes = (
        start.standoff_tolerance,
        _ORIGIN_SIGMA / _WIDENING,
        _ORIGIN_SIGMA / _WIDENING,
        start.pupil_tolerance,
        start.row_tolerance,
        start.column_tolerance,
        start.depth_tolerance,
    )
    centre = np.zeros(SHAPE_PARAMETERS)
    centre[3], centre[6] = np.log(start.standoff_per_pitch), np.log(start.pupil_per_pitch)
    centre[7:] = start.row_open, start.column_open, start.depth_per_pitch
    sigma = np.array([ROTATION_SIGMA] * 3 + [_WIDENING * size for size in sizes])
    return Prior(centre, np.maximum(sigma, _LEAST_SIGMA))
