"""The assumptions of a plan: the rig's nominal values or those that fits have measured, and light in an even field."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import final

import jax
import numpy as np
from jaxtyping import Float
from scipy.ndimage import map_coordinates

from udccal.arrangements import Arrangement, PanelPicture
from udccal.cfa import cfa_named
from udccal.fitting.geometry.fit import BY_HAND, ON_JIG
from udccal.fitting.nominal import nominal_geometry
from udccal.models.backscatter import Backscatter
from udccal.models.geometry import Geometry
from udccal.models.noise import Noise, variance_e
from udccal.models.wire import Wire, wire_values
from udccal.numerics import in_float64
from udccal.planning.steps import Cost, PlannedStep, cost_of, nominal_full_s, steps_at, with_small_panel
from udccal.result import FitResult, FitStatus, TermResults
from udccal.rig import Captures, RigDescription
from udccal.sessions.schema import TermName

# White light of LEDs as red, green and blue photodiodes see it, 1 for the brightest.
WHITE = np.array([0.6, 1.0, 0.7])
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

    def steps(self, term: TermName, drawn: bool = True) -> list[PlannedStep]:
        """The steps of a term's procedure at the exposures of this state; it raises the errors of ``steps_at``.

        For counting, pictures on the panel need not be ``drawn``: they are tiny then.
        """
        return list(steps_at(term, self.rig if drawn else with_small_panel(self.rig), self._full_s))

    def cost(self, term: TermName) -> Cost:
        """Frames, seconds and set-ups of a term's procedure; it raises the errors of ``steps_at``."""
        return cost_of(self.steps(term, drawn=False), self.rig)

    def _full_s(self, arrangement: Arrangement) -> float:
        """Exposure in seconds at which the brightest sample of an arrangement would fill its well."""
        if isinstance(arrangement, PanelPicture) and (white := self.white) is not None:
            return self.full_well_e / float(white.max())
        return nominal_full_s(arrangement, self.rig)

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
        return np.asarray(_variance_e(self.noise, signal_e, exposure_s))


def nominal_state(rig: RigDescription) -> RigState:
    """The state of a rig that was never calibrated.

    Args:
        rig: its description, with the captures that are evaluated.

    Returns:
        terms at the description's nominal values, with usual noise and distortion, and no model errors.
    """
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
    """The state of a rig that was calibrated.

    Args:
        rig: its description, with the captures that are evaluated.
        fits: of that rig: a calibration or a profile.

    Returns:
        terms and model errors as fitted; a term whose fit did not converge is that of the rig as built.
    """
    nominal = nominal_state(rig)
    noise, geometry, wire, psf, backscatter = fits.results
    return RigState(
        rig=rig,
        noise=noise.term if _converged(noise) else nominal.noise,
        geometry=geometry.term if _converged(geometry) else nominal.geometry,
        wire=wire.term if _converged(wire) else None,
        backscatter=backscatter.term if _converged(backscatter) else None,
        model_errors=ModelErrors(
            on_jig_px=_corners_px(geometry, ON_JIG, ModelErrors.on_jig_px),
            by_hand_px=_corners_px(geometry, BY_HAND, ModelErrors.by_hand_px),
            wire=(wire.diagnostic("wire_map_model_sigma") or 0.0) / 100,
            psf=psf.diagnostic("model_error") or 0.0,
            psf_kernel=psf.diagnostic("kernel_error_l2") or 0.0,
            backscatter=backscatter.diagnostic("model_error_of_white") or 0.0,
            inflation=max(backscatter.diagnostic("pattern_inflation") or 0.0, 1.0),
        ),
    )


def _converged(result: FitResult) -> bool:
    return result.status is FitStatus.CONVERGED


def _corners_px(geometry: FitResult[Geometry], name: str, usual: float) -> float:
    """Scatter of corners in addition to noise, disagreement of views included; the usual one where none was fitted."""
    scatter_px = geometry.diagnostic(name) if _converged(geometry) else None
    factor = max(geometry.diagnostic("variance_factor") or 0.0, 1.0)
    return usual if scatter_px is None else scatter_px * float(np.sqrt(factor))


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


@final
class EvenField:
    """An even white field as one rig sees it, 1 at its brightest: the wire's measured shading, or the cos^4 law."""

    @in_float64
    def __init__(self, state: RigState) -> None:
        camera, geometry = state.rig.camera, state.geometry
        self._size, self._cfa = np.array([camera.columns, camera.rows]), cfa_named(camera.cfa)
        x, y = (np.linspace(0, size - 1, count) for size, count in zip(self._size, _FIELD_GRID[::-1], strict=True))
        pixels = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        if state.wire is None:
            ideal = (pixels - np.asarray(geometry.principal_point_px)) / np.asarray(geometry.focal_px)
            values = (1 + (ideal**2).sum(axis=1)) ** -2.0
        else:
            values = np.asarray(_wire_values(state.wire, pixels, camera.rows, camera.columns), dtype=np.float64)
        self._grid = (values / values.max()).reshape(_FIELD_GRID)

    def at(self, pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
        """Light at pixels, by linear interpolation."""
        places = (pixels / (self._size - 1) * (np.array(_FIELD_GRID[::-1]) - 1)).T[::-1]
        return np.asarray(map_coordinates(self._grid, places, order=1, mode="nearest"))

    def signal(self, pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
        """Signal of samples of a white field, 1 for the brightest of all."""
        x, y = np.round(pixels).astype(np.int64).T
        return np.asarray(self.at(pixels) * WHITE[self._cfa.channels[y % self._cfa.rows, x % self._cfa.columns]])
