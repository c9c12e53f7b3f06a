"""The assumptions of a plan: the rig's nominal values or those that fits have measured, and light in an even field."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, final

import jax
import numpy as np
from jaxtyping import Float
from scipy.ndimage import map_coordinates

from udccal.arrangements import Arrangement, PanelPicture
from udccal.calibration import Calibration
from udccal.cfa import cfa_named
from udccal.fitting.geometry.fit import BY_HAND, ON_JIG
from udccal.fitting.nominal import nominal_geometry
from udccal.models.backscatter import Backscatter
from udccal.models.geometry import Geometry
from udccal.models.noise import Noise, variance_e
from udccal.models.wire import Wire, wire_values
from udccal.numerics import in_float64
from udccal.planning.exposures import nominal_full_s
from udccal.profiles.profile import Profile
from udccal.result import FitResult, FitStatus
from udccal.rig import Captures, RigDescription

# Numbers that data sheets of industrial cameras leave out, as EMVA 1288 reports commonly show them.
_SIGMA_D_E, _LAMBDA, _SIGMA_ROW_E = 5.0, 0.14, 0.6
_DARK_E_PER_S, _DSNU_E, _PRNU = 15.0, 2.0, 0.0055
# White light of LEDs as red, green and blue photodiodes see it.
WHITE = (0.6, 1.0, 0.7)
# Distortion (k1, k2) that is usual for lenses of a short focal length.
_DISTORTION = (-0.07, 0.035, 0.0, 0.0, -0.005)
# Shading is smooth; the modulation by the rows hardly changes the number of electrons.
_FIELD_GRID = (49, 65)
_variance_e = jax.jit(variance_e)
_wire_values = jax.jit(wire_values, static_argnums=(2, 3))


@final
@dataclass(frozen=True)
class ModelErrors:
    """Model errors of the terms, in addition to noise, as a profile's fits have found them.

    Attributes:
        on_jig_px, by_hand_px: scatter of a board's corners by axis in addition to noise; None where not known.
        wire, psf: relative model error; the psf's is that which its fit allows for, see ``fitting.psf.data.left_out``.
        psf_kernel: relative L2 error of the kernel, in addition to noise, where it was not captured.
        backscatter: error of the ratio to white.
        inflation: factor on the variances of the backscatter's parameters, since its residuals are correlated.
    """

    on_jig_px: float | None = None
    by_hand_px: float | None = None
    wire: float = 0.0
    psf: float = 0.0
    psf_kernel: float = 0.0
    backscatter: float = 0.0
    inflation: float = 1.0


@final
@dataclass(frozen=True)
class RigState:
    """A rig, and the terms that its calibration is expected to give.

    Attributes:
        rig: with the captures that are evaluated.
        noise, geometry: expected terms.
        wire, backscatter: terms that a profile has measured; None stands for the rig as built.
        model_errors: errors in addition to noise.
    """

    rig: RigDescription
    noise: Noise
    geometry: Geometry
    wire: Wire | None = None
    backscatter: Backscatter | None = None
    model_errors: ModelErrors = ModelErrors()

    def with_captures(self, captures: Captures) -> RigState:
        """The same with other captures."""
        return replace(self, rig=self.rig.model_copy(update={"captures": captures}))

    @property
    def full_well_e(self) -> float:
        """Electrons between black level and saturation."""
        noise = self.noise
        return float(np.asarray((noise.saturation_DN - noise.black_DN) / noise.K_DN_per_e))


def nominal_state(rig: RigDescription) -> RigState:
    """The state of a rig that was never calibrated.

    Args:
        rig: its description, with the captures that are evaluated.

    Returns:
        terms at the description's nominal values, with usual noise and distortion, and no model errors.
    """
    camera = rig.camera
    K, black = camera.K_DN_per_e.value, camera.black_DN.value
    noise = Noise(
        K_DN_per_e=K,
        black_DN=black,
        saturation_DN=min(float(rig.saturation_DN), black + K * camera.full_well_e.value),
        sigma_d_e=_SIGMA_D_E,
        lambda_read=_LAMBDA,
        sigma_row_DN=_SIGMA_ROW_E * K,
        q_DN=1.0,
        dark_current_e_per_s=_DARK_E_PER_S,
        DSNU1288_e=_DSNU_E,
        PRNU1288=_PRNU,
    )
    return RigState(rig, noise, replace(nominal_geometry(rig), distortion=np.array(_DISTORTION)))


def measured_state(rig: RigDescription, fits: Calibration | Profile) -> RigState:
    """The state of a rig that was calibrated.

    Args:
        rig: its description, with the captures that are evaluated.
        fits: of that rig.

    Returns:
        terms and model errors as fitted; a term whose fit did not converge is that of the rig as built.
    """
    nominal = nominal_state(rig)
    geometry_seen = _converged(fits.geometry)
    return RigState(
        rig=rig,
        noise=fits.noise.term if _converged(fits.noise) else nominal.noise,
        geometry=fits.geometry.term if geometry_seen else nominal.geometry,
        wire=fits.wire.term if _converged(fits.wire) else None,
        backscatter=fits.backscatter.term if _converged(fits.backscatter) else None,
        model_errors=ModelErrors(
            on_jig_px=_corners_px(fits.geometry, ON_JIG) if geometry_seen else None,
            by_hand_px=_corners_px(fits.geometry, BY_HAND) if geometry_seen else None,
            wire=(fits.wire.diagnostic("wire_map_model_sigma") or 0.0) / 100,
            psf=fits.psf.diagnostic("model_error") or 0.0,
            psf_kernel=fits.psf.diagnostic("kernel_error_l2") or 0.0,
            backscatter=fits.backscatter.diagnostic("model_error_of_white") or 0.0,
            inflation=max(fits.backscatter.diagnostic("pattern_inflation") or 0.0, 1.0),
        ),
    )


def _converged(result: FitResult[Any]) -> bool:
    return result.status is FitStatus.CONVERGED


def _corners_px(geometry: FitResult[Geometry], name: str) -> float | None:
    """Scatter of corners in addition to noise, disagreement of views included; None where the fit lacks the number."""
    scatter_px, factor = geometry.diagnostic(name), geometry.diagnostic("variance_factor") or 0.0
    return None if scatter_px is None else scatter_px * float(np.sqrt(max(factor, 1.0)))


def full_s(arrangement: Arrangement, state: RigState) -> float:
    """Exposure in seconds at which the brightest sample of an arrangement would fill its well."""
    if isinstance(arrangement, PanelPicture) and state.backscatter is not None and np.max(state.backscatter.mask) > 0:
        return state.full_well_e / float(np.max(state.backscatter.mask))
    return nominal_full_s(arrangement, state.rig)


def sensor_samples(rig: RigDescription, across: int) -> Float[np.ndarray, "n 2"]:
    """Pixels spread evenly over the sensor.

    Args:
        rig: for the size of the sensor.
        across: number of pixels along x and along y.

    Returns:
        (x, y) in px, ``across`` squared of them, not rounded to whole pixels.
    """
    x, y = ((np.arange(across) + 0.5) / across * size - 0.5 for size in (rig.camera.columns, rig.camera.rows))
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def built_wire(state: RigState) -> Wire:
    """The wire as the rig was built, with a round pupil and its strongest harmonics."""
    from udccal.fitting.wire.rules import ideal_wire, possible_harmonics, wire_start

    start = wire_start(state.rig)
    return ideal_wire(state.geometry, start, possible_harmonics(start).orders)


@final
class EvenField:
    """An even white field as one rig sees it, 1 at its brightest: the wire's measured shading, or the cos^4 law."""

    @in_float64
    def __init__(self, state: RigState) -> None:
        camera, geometry, wire = state.rig.camera, state.geometry, state.wire
        self._size = np.array([camera.columns, camera.rows])
        self._cfa = cfa_named(camera.cfa)
        y, x = (np.linspace(0, size - 1, count) for size, count in zip(self._size[::-1], _FIELD_GRID, strict=True))
        pixels = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        if wire is None:
            ideal = (pixels - np.asarray(geometry.principal_point_px)) / np.asarray(geometry.focal_px)
            values = (1 + (ideal**2).sum(axis=1)) ** -2.0
        else:
            values = np.asarray(_wire_values(wire, pixels, camera.rows, camera.columns), dtype=np.float64)
        self._grid = (values / values.max()).reshape(_FIELD_GRID)

    def at(self, pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
        """Light at pixels, by linear interpolation."""
        places = (pixels / (self._size - 1) * (np.array(_FIELD_GRID[::-1]) - 1)).T[::-1]
        return np.asarray(map_coordinates(self._grid, places, order=1, mode="nearest"))

    def signal(self, pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
        """Signal of samples of a white field, 1 for the brightest of all."""
        x, y = np.round(pixels).astype(np.int64).T
        channel = self._cfa.channels[y % self._cfa.rows, x % self._cfa.columns]
        return np.asarray(self.at(pixels) * (np.array(WHITE) / max(WHITE))[channel])


@in_float64
def sample_variance_e(state: RigState, signal_e: Float[np.ndarray, "*n"], exposure_s: float) -> Float[np.ndarray, "*n"]:
    """Temporal variance of single samples in e-^2; see ``models.noise.variance_e``."""
    return np.asarray(_variance_e(state.noise, signal_e, exposure_s))
