"""Fit the psf term to merged pictures of LEDs as arrays, made here from a profile that ships; it takes three minutes.

python examples/psf_from_leds.py
"""

from __future__ import annotations

import numpy as np

import udccal
from udccal.cfa import cfa_named
from udccal.effort import QUICK
from udccal.fitting.psf.data import PsfData, Shots
from udccal.kernels import kernels_at

ROWS, COLUMNS, FLUX_E_PER_S, EXPOSURE_S, READ_E = 73, 25, 1e9, 1e-2, 3.0


def main() -> None:
    """Draw the light of six LEDs with noise, fit it, and print the estimates with their sigmas."""
    profile, rng = udccal.load_profile("lg55-reduced"), np.random.default_rng(0)
    camera, psf = profile.rig.camera, profile.psf.term
    x, y = np.meshgrid(np.linspace(80, camera.columns - 80, 3), np.linspace(100, camera.rows - 100, 2))
    places = np.stack([x.ravel(), y.ravel()], axis=1).astype(np.int64) // 2 * 2
    kernels = kernels_at(psf, places.astype(float), ROWS, COLUMNS).astype(np.float64)
    # All windows begin at even rows and columns of the sensor.
    channel = np.broadcast_to(cfa_named(camera.cfa).channel_map(ROWS, COLUMNS), (len(places), ROWS, COLUMNS))
    light = FLUX_E_PER_S * np.take_along_axis(kernels, channel[:, None], axis=1)[:, 0]
    variance = light / EXPOSURE_S + (READ_E / EXPOSURE_S) ** 2
    rate = light + np.sqrt(variance) * rng.standard_normal(light.shape)
    each, slope = np.arange(len(places)), np.full(light.shape, 1 / EXPOSURE_S)
    shots = Shots(places * 1.0, places, each, np.full(len(each), 0.01), rate, 1 / variance, channel, slope)
    found = udccal.fit_psf(PsfData(shots), profile.rig, profile.geometry.term, profile.wire.term, QUICK.psf)
    print(found.status.name)
    print(*(f"{e.name:20} {e.value:10.5f} ± {e.sigma:.5f} {e.unit}" for e in found.estimates), sep="\n")


if __name__ == "__main__":
    main()
