"""What a plan takes for true: the rig's nominal values, or those that a profile has measured."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import final

import numpy as np
from jaxtyping import Float

from udccal.arrangements import Arrangement, Board, Dark, FlatLight, Led, PanelPicture, Photograph
from udccal.fitting.nominal import nominal_geometry
from udccal.models.backscatter import Backscatter
from udccal.models.geometry import Geometry
from udccal.models.noise import Noise
from udccal.models.psf import PsfField
from udccal.models.wire import Wire
from udccal.rig import Captures, RigDescription

# What no data sheet of an industrial camera says: EMVA 1288 numbers as its reports commonly show them.
_SIGMA_D_E, _LAMBDA, _SIGMA_ROW_E = 5.0, 0.14, 0.6
_DARK_E_PER_S, _DSNU_E, _PRNU = 15.0, 2.0, 0.0055
# White light of LEDs as red, green and blue photodiodes see it.
WHITE = (0.6, 1.0, 0.7)
# Lenses of a short focal length bend about so much (k1, k2).
_DISTORTION = (-0.07, 0.035, 0.0, 0.0, -0.005)
# How long things take to fill the wells: flats and boards are lit so that they do within a frame.
_LED_FULL_S, _PANEL_FULL_S = 125e-6, 0.1


@final
@dataclass(frozen=True)
class Unexplained:
    """What noise does not explain, as a profile's fits have found it.

    Attributes:
        on_jig_px, by_hand_px: scatter of a board's corners by axis beside noise; None where not known.
        wire, psf: relative error of the model; the psf's is what its fit allows for, see ``fitting.psf.weights``.
        psf_kernel: relative L2 error of the kernel beside noise where it was not captured.
        backscatter: error of a ratio to white.
        inflation: of the variances of the backscatter's parameters, whose residuals hang together.
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
    """A rig, and the terms as they are expected to come out.

    Attributes:
        rig: with the captures that are looked at.
        noise, geometry: as expected.
        wire, psf, backscatter: as a profile has measured them; None: as built.
        unexplained: errors beside noise.
    """

    rig: RigDescription
    noise: Noise
    geometry: Geometry
    wire: Wire | None = None
    psf: PsfField | None = None
    backscatter: Backscatter | None = None
    unexplained: Unexplained = Unexplained()

    def of(self, rig: RigDescription) -> RigState:
        """The same of another description."""
        return replace(self, rig=rig)

    def with_captures(self, captures: Captures) -> RigState:
        """The same with other captures."""
        return self.of(self.rig.model_copy(update={"captures": captures}))

    @property
    def full_well_e(self) -> float:
        """Electrons between black level and saturation."""
        noise = self.noise
        return float(np.asarray((noise.saturation_DN - noise.black_DN) / noise.K_DN_per_e))


def nominal_state(rig: RigDescription) -> RigState:
    """From the rig's description alone."""
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


def full_s(arrangement: Arrangement, state: RigState) -> float:
    """Exposure at which the brightest sample of what stands before the camera would fill its well."""
    match arrangement:
        case Led():
            return _LED_FULL_S
        case PanelPicture():
            if state.backscatter is not None and np.max(state.backscatter.mask) > 0:
                return state.full_well_e / float(np.max(state.backscatter.mask))
            return _PANEL_FULL_S
        case FlatLight() | Board() | Dark() | Photograph():
            return 1.0 / state.rig.camera.frame_rate_hz


def sensor_samples(rig: RigDescription, across: int) -> Float[np.ndarray, "n 2"]:
    """About ``across`` x ``across`` pixels spread evenly over the sensor."""
    x, y = ((np.arange(across) + 0.5) / across * size - 0.5 for size in (rig.camera.columns, rig.camera.rows))
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def built_wire(state: RigState) -> Wire:
    """The wire as the rig was built, with a round pupil and its strongest harmonics."""
    from udccal.fitting.wire.parameters import ideal_wire, possible_harmonics
    from udccal.fitting.wire.rules import wire_start

    start = wire_start(state.rig)
    return ideal_wire(state.geometry, start, possible_harmonics(start).orders)
