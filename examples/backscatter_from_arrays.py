"""Fit the backscatter term to rates of your own in bins: white, pictures and dark, made here from a profile that ships.

python examples/backscatter_from_arrays.py
"""

from __future__ import annotations

import numpy as np

import udccal
from udccal.displays.pictures import face_picture
from udccal.fitting.backscatter.data import BackscatterData, Binned
from udccal.fitting.backscatter.read import visible_crop
from udccal.models.backscatter import panel_response, response_grid

EXPOSURE_S, SAMPLES, READ_E = 0.05, 256, 3.0


def main() -> None:
    """Make rates with the noise of the samples in a bin, fit them, and print the estimates with their sigmas."""
    profile, rng = udccal.load_profile("lg55-reduced"), np.random.default_rng(0)
    panel, geometry = profile.rig.panel, profile.geometry.term
    pictures = [face_picture(seed, panel.columns, panel.rows) for seed in range(8)]
    response = panel_response(profile.backscatter.term, panel.rows, panel.columns)
    shown = [np.full_like(pictures[0], 255), *pictures, np.zeros_like(pictures[0])]
    light = np.stack([np.asarray(response_grid(response, one), dtype=np.float64) for one in shown])
    # Variance of a bin's rate per unit of light, and in the dark.
    shot = np.full(light.shape, 1 / (EXPOSURE_S * SAMPLES))
    rest = np.full(light.shape, (READ_E / EXPOSURE_S) ** 2 / SAMPLES)
    rate, one = shot * rng.poisson(light / shot) + np.sqrt(rest) * rng.standard_normal(light.shape), np.ones(len(light))
    shots, crop = Binned(rate, shot, rest, light < 0, EXPOSURE_S * one, one), visible_crop(geometry, profile.rig)
    data = BackscatterData(shots, np.stack([crop.of(picture) for picture in pictures]), crop, tuple("abcdefgh"))
    found = udccal.fit_backscatter(data, geometry, profile.rig).or_raise()
    lines = [f"{e.name:18} {e.value:9.5f} ± {e.sigma:.5f} {e.unit}" for e in found.estimates]
    print(found.status.name, *lines, sep="\n")


if __name__ == "__main__":
    main()
