"""The assumptions of a plan: the rig's nominal values or those that fits have measured, and light in an even field."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, final

import jax
import numpy as np
from jaxtyping import Float
from scipy.interpolate import RegularGridInterpolator

from udccal.cfa import cfa_named
from udccal.fitting.geometry.fit import BY_HAND, ON_JIG
from udccal.fitting.nominal import nominal_geometry
from udccal.models.backscatter import Backscatter
from udccal.models.geometry import Geometry
from udccal.models.noise import Noise, variance_e
from udccal.models.wire import Wire, wire_values
from udccal.numerics import in_float64
from udccal.planned_steps import with_small_panel
from udccal.planning.steps import PANEL_FULL_S, Cost, PlannedStep, steps_at
from udccal.plugins import find_procedure
from udccal.result import FitResult, FitStatus, TermResults
from udccal.rig import Captures, RigDescription
from udccal.sessions.schema import TermName

# White light of LEDs as red, green and blue photodiodes see it, 1 for the brightest.
WHITE = np.array([0.6, 1.0, 0.7])
# Distortion (k1, k2) that is usual for lenses of a short focal length.
_DISTORTION = (-0.07, 0.035, 0.0, 0.0, -0.005)
# Shading is smooth; the modulation by the rows hardly changes the number of electrons.
_FIELD_GRID = (49, 65)
_wire_values = jax.jit(wire_values, static_argnums=(2, 3))


@final
@dataclass(frozen=True)
class ModelErrors:
    """Model errors of the terms, in addition to noise, as a profile's fits have found them.

    Attributes:
        on_jig_px, by_hand_px: scatter of a board's corners by axis in addition to noise. Edges of the board on the jig
            run along the sensor's rows: samples see them at few phases, and corners scatter more.
        wire, psf: relative model error; the psf's is that which its fit allows for, see ``fitting.psf.data.left_out``.
        psf_kernel: relative L2 error of the kernel, in addition to noise, where it was not captured.
        backscatter: error of the ratio to white.
        inflation: factor on the variances of the backscatter's parameters, since its residuals are correlated.
    """

    on_jig_px: float = 0.0085
    by_hand_px: float = 0.006
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
        wire_pixels: pixels that the wire's fit uses; None for those of a fit of full effort.
    """

    rig: RigDescription
    noise: Noise
    geometry: Geometry
    wire: Wire | None = None
    backscatter: Backscatter | None = None
    model_errors: ModelErrors = ModelErrors()
    wire_pixels: int | None = None

    def with_captures(self, captures: Captures) -> RigState:
        """The same with other captures."""
        return replace(self, rig=self.rig.model_copy(update={"captures": captures}))

    def steps(self, term: TermName) -> list[PlannedStep]:
        """The steps of a term's procedure, pictures on the panel tiny; it raises the errors of ``steps_at``."""
        panel_full_s = PANEL_FULL_S if self.white is None else self.full_well_e / float(self.white.max())
        return list(steps_at(term, with_small_panel(self.rig), panel_full_s))

    def cost(self, term: TermName) -> Cost:
        """Frames, seconds and set-ups of a term's procedure; it raises the errors of ``steps_at``."""
        steps, period_s = self.steps(term), 1.0 / self.rig.camera.frame_rate_hz
        exposures_s = [one for step in steps for one in (*step.exposures_s, *step.exposures_s[:1] * step.test_frames)]
        # Steps that a person is led through: all shifts in a cell are one, and so are all views held by hand.
        set_ups = sum(1 for _ in find_procedure(term)().guided(self.rig))
        return Cost(len(exposures_s), sum(max(period_s, one) for one in exposures_s), set_ups)

    @property
    def white(self) -> Float[np.ndarray, "3 a b"] | None:
        """Measured light of a white picture on the backscatter's grid in e-/s; None where no light was measured."""
        mask = None if self.backscatter is None else np.asarray(self.backscatter.mask, dtype=np.float64)
        return None if mask is None or mask.max() <= 0 else mask

    @property
    def full_well_e(self) -> float:
        """Electrons between black level and saturation."""
        return float((self.noise.saturation_DN - self.noise.black_DN) / self.noise.K_DN_per_e)

    @in_float64
    def variance_e(self, signal_e: Float[np.ndarray, "*n"], exposure_s: float) -> Float[np.ndarray, "*n"]:
        """Temporal variance of single samples in e-^2; see ``models.noise.variance_e``."""
        return np.asarray(variance_e(self.noise, signal_e, exposure_s))


def nominal_state(rig: RigDescription) -> RigState:
    """The state of a rig that was never calibrated: nominal values, usual noise and distortion, no model errors."""
    K, black = rig.camera.K_DN_per_e.value, rig.camera.black_DN.value
    # Data sheets of industrial cameras leave most numbers out: these are as EMVA 1288 reports commonly show them.
    noise = Noise(
        K_DN_per_e=K,
        black_DN=black,
        saturation_DN=min(float(rig.saturation_DN), black + K * rig.camera.full_well_e.value),
        sigma_d_e=5.0,
        lambda_read=0.14,
        sigma_row_DN=0.6 * K,
        q_DN=1.0,
        dark_current_e_per_s=15.0,
        DSNU1288_e=2.0,
        PRNU1288=0.0055,
    )
    return RigState(rig, noise, replace(nominal_geometry(rig), distortion=np.array(_DISTORTION)))


def measured_state(rig: RigDescription, fits: TermResults) -> RigState:
    """The state of a rig by the fits of its calibration or profile: terms and model errors as fitted.

    A term whose fit did not converge is that of the rig as built.
    """
    built, (noise, geometry, wire, psf, backscatter) = nominal_state(rig), fits.results

    def fitted(result: FitResult[Any], otherwise: Any = None) -> Any:
        return result.term if result.status is FitStatus.CONVERGED else otherwise

    def corners_px(name: str, usual: float) -> float:
        scatter_px = geometry.diagnostic(name) if fitted(geometry) else None
        # Views that disagree scatter by more.
        factor = max(geometry.diagnostic("variance_factor") or 0.0, 1.0)
        return usual if scatter_px is None else scatter_px * math.sqrt(factor)

    errors = ModelErrors(
        on_jig_px=corners_px(ON_JIG, ModelErrors.on_jig_px),
        by_hand_px=corners_px(BY_HAND, ModelErrors.by_hand_px),
        wire=(wire.diagnostic("wire_map_model_sigma") or 0.0) / 100,
        psf=psf.diagnostic("model_error") or 0.0,
        psf_kernel=psf.diagnostic("kernel_error_l2") or 0.0,
        backscatter=backscatter.diagnostic("model_error_of_white") or 0.0,
        inflation=max(backscatter.diagnostic("pattern_inflation") or 0.0, 1.0),
    )
    terms = fitted(noise, built.noise), fitted(geometry, built.geometry), fitted(wire), fitted(backscatter)
    return RigState(rig, *terms, errors)


def sensor_samples(rig: RigDescription, across: int) -> Float[np.ndarray, "n 2"]:
    """Pixels (x, y) spread evenly over the sensor, ``across`` along each side, not rounded to whole pixels."""
    x, y = ((np.arange(across) + 0.5) / across * size - 0.5 for size in (rig.camera.columns, rig.camera.rows))
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


@final
class EvenField:
    """An even white field as one rig sees it, 1 at its brightest: the wire's measured shading, or the cos^4 law."""

    @in_float64
    def __init__(self, state: RigState) -> None:
        camera, geometry, self._cfa = state.rig.camera, state.geometry, cfa_named(state.rig.camera.cfa)
        sizes = zip((camera.rows, camera.columns), _FIELD_GRID, strict=True)
        y, x = (np.linspace(0, size - 1, count) for size, count in sizes)
        pixels = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        if state.wire is None:
            ideal = (pixels - geometry.principal_point_px) / geometry.focal_px
            values = (1 + (ideal**2).sum(axis=1)) ** -2.0
        else:
            values = np.asarray(_wire_values(state.wire, pixels, camera.rows, camera.columns), dtype=np.float64)
        values = (values / values.max()).reshape(_FIELD_GRID)
        self._light = RegularGridInterpolator((y, x), values, bounds_error=False, fill_value=None)

    def at(self, pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
        """Light at pixels, by linear interpolation."""
        return np.asarray(self._light(pixels[:, ::-1]))

    def signal(self, pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
        """Signal of samples of a white field, 1 for the brightest of all."""
        x, y = np.round(pixels).astype(np.int64).T
        return np.asarray(self.at(pixels) * WHITE[self._cfa.channels[y % self._cfa.rows, x % self._cfa.columns]])
