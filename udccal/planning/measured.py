"""The state that fits have measured: at its values, and with the errors beside noise that they have found."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, final

import numpy as np

from udccal.fitting.geometry.boards import BY_HAND, ON_JIG
from udccal.models.backscatter import Backscatter
from udccal.models.geometry import Geometry
from udccal.models.noise import Noise
from udccal.models.psf import PsfField
from udccal.models.wire import Wire
from udccal.planning.state import RigState, Unexplained, nominal_state
from udccal.result import FitResult, FitStatus
from udccal.rig import RigDescription


@final
@dataclass(frozen=True)
class Measured:
    """The fits of one rig, as a profile holds them."""

    noise: FitResult[Noise]
    geometry: FitResult[Geometry]
    wire: FitResult[Wire]
    psf: FitResult[PsfField]
    backscatter: FitResult[Backscatter]


def measured_state(rig: RigDescription, fits: Measured) -> RigState:
    """A rig at the values of its fits; terms that these hold as absent, or could not tell, stand as built."""
    nominal = nominal_state(rig)
    geometry_seen = _seen(fits.geometry)
    return RigState(
        rig=rig,
        noise=fits.noise.term if _seen(fits.noise) else nominal.noise,
        geometry=fits.geometry.term if geometry_seen else nominal.geometry,
        wire=fits.wire.term if _seen(fits.wire) else None,
        psf=fits.psf.term if _seen(fits.psf) else None,
        backscatter=fits.backscatter.term if _seen(fits.backscatter) else None,
        unexplained=Unexplained(
            on_jig_px=_corners(fits.geometry, ON_JIG) if geometry_seen else None,
            by_hand_px=_corners(fits.geometry, BY_HAND) if geometry_seen else None,
            wire=_diagnostic(fits.wire, "wire_map_model_sigma") / 100,
            psf=_diagnostic(fits.psf, "model_error"),
            psf_kernel=_diagnostic(fits.psf, "kernel_error_l2"),
            backscatter=_diagnostic(fits.backscatter, "model_error_of_white"),
            inflation=max(_diagnostic(fits.backscatter, "pattern_inflation"), 1.0),
        ),
    )


def _seen(result: FitResult[Any]) -> bool:
    return result.status is FitStatus.CONVERGED


def _corners(geometry: FitResult[Geometry], name: str) -> float | None:
    """Scatter of corners beside noise, disagreement of views included; None where the fit does not tell."""
    if all(item.name != name for item in geometry.diagnostics):
        return None
    return _diagnostic(geometry, name) * float(np.sqrt(max(_diagnostic(geometry, "variance_factor"), 1.0)))


def _diagnostic(result: FitResult[Any], name: str) -> float:
    """0 where the fit does not tell."""
    return next((item.value for item in result.diagnostics if item.name == name), 0.0)
