"""Spectra of white light in the camera's three colours."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from udccal.simulation.truth import RigTruth

_FIRST_NM, _LAST_NM, _BANDS = 400.0, 700.0, 21
_PEAKS_NM = np.array([600.0, 535.0, 460.0])
_WIDTHS_NM = np.array([42.0, 40.0, 36.0])


@dataclass(frozen=True)
class Spectrum:
    """Light reaching each colour, in bands of ``step_nm`` centred on ``wavelengths_nm``; each colour sums to 1."""

    wavelengths_nm: Float[np.ndarray, "bands"]
    weights: Float[np.ndarray, "3 bands"]
    step_nm: float


def camera_spectrum(truth: RigTruth) -> Spectrum:
    """Return the colour responses of the simulated camera times the spectrum of a white LED, drawn once per rig.

    The responses are Gaussians of 35 to 45 nm standard deviation whose peaks differ by a few nanometres from rig to
    rig; the LED is a blue peak plus a broad phosphor.
    """
    rng = np.random.default_rng([truth.seed, 0x5BEC])
    peaks = _PEAKS_NM + rng.uniform(-4.0, 4.0, 3)
    widths = _WIDTHS_NM * rng.uniform(0.96, 1.04, 3)
    wavelengths = np.linspace(_FIRST_NM, _LAST_NM, _BANDS)
    responses = np.exp(-0.5 * ((wavelengths - peaks[:, None]) / widths[:, None]) ** 2)
    weights = responses * _white_led(wavelengths)
    weights /= weights.sum(axis=1, keepdims=True)
    return Spectrum(wavelengths_nm=wavelengths, weights=weights, step_nm=float(wavelengths[1] - wavelengths[0]))


def _white_led(wavelengths_nm: Float[np.ndarray, "bands"]) -> Float[np.ndarray, "bands"]:
    blue = 0.7 * np.exp(-0.5 * ((wavelengths_nm - 455.0) / 22.0) ** 2)
    phosphor = np.exp(-0.5 * ((wavelengths_nm - 565.0) / 65.0) ** 2)
    return blue + phosphor + 0.02
