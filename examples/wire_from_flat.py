"""Fit the wire term to an averaged flat of your own, and compute the sigma of its map anywhere.

    python examples/wire_from_flat.py

The flat is made here: the map of the shipped profile, evenly lit, with the noise of 100 averaged frames.
"""

from __future__ import annotations

import numpy as np

import udccal
from udccal.fitting.wire.data import WireData
from udccal.fitting.wire.fit import sensor_map
from udccal.fitting.wire.parameters import WireRules, wire_start
from udccal.models.wire import wire_values

LIGHT_E, FRAMES, PRNU = 9000.0, 100, 0.006
RULES = WireRules(samples=30_000)


def main() -> None:
    """Make a flat, fit it, and print the map's sigma at three pixels."""
    profile, rng = udccal.load_profile("lg55-reduced"), np.random.default_rng(0)
    camera, truth = profile.rig.camera, profile.wire.term
    mean = LIGHT_E * sensor_map(truth, camera.rows, camera.columns)
    noise = np.sqrt(mean / FRAMES + (PRNU * mean) ** 2) * rng.standard_normal(mean.shape)
    flat = WireData(mean + noise, mean / FRAMES, profile.geometry.term, wire_start(profile.rig), PRNU)
    found = udccal.fit_wire(flat, RULES).or_raise()
    for one in found.estimates:
        print(f"  {one.name:20} {one.value:9.5f} ± {one.sigma:.5f} {one.unit}")
    pixels = np.array([[10.0, 10.0], [511.5, 383.5], [1000.0, 700.0]])
    sigma = found.sigma_of(lambda wire: np.asarray(wire_values(wire, pixels, camera.rows, camera.columns)))
    print(f"{found.status.name}; the map's sigma: " + ", ".join(f"{100 * one:.4f} %" for one in sigma))


if __name__ == "__main__":
    main()
