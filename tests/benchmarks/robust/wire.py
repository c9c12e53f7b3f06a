"""Wires of every kind on a small sensor: panels, footprints, openings that are rectangles or smooth, light."""

from __future__ import annotations

import functools

import numpy as np

from tests.benchmarks.robust.family import Answer, Case, Family, Number, of_result
from tests.scenes.wire import PRNU, drawn_truth, fitted, geometry, map_at, map_sigma, noisy, places
from udccal.fitting.wire.parameters import WireStart


def draw(seed: int) -> Case:
    """A rig's description, a wire within its tolerances, and a flat."""
    rng = np.random.default_rng([seed, 23])
    standoff, footprint = float(rng.uniform(8.0, 25.0)), float(rng.uniform(2.5, 9.0))
    built = WireStart(
        standoff_per_pitch=standoff,
        standoff_tolerance=0.03,
        footprint_per_pitch=footprint,
        pupil_tolerance=0.04,
        row_open=float(rng.uniform(0.25, 0.75)),
        row_tolerance=0.02,
        column_open=float(rng.uniform(0.9, 0.99)),
        column_tolerance=0.002,
        depth_per_pitch=float(rng.uniform(0.02, 0.15)),
        depth_tolerance=0.01,
    )
    tilt, electrons = float(rng.uniform(0.0, 25.0)), float(np.exp(rng.uniform(np.log(3e3), np.log(1e6))))
    highest = float(rng.choice([1.0, 2.0, np.inf]))
    openings = "rectangles" if highest == np.inf else f"harmonics up to {highest:.0f}"
    what = f"stand-off {standoff:.0f}, footprint {footprint:.1f}, {openings}, tilt {tilt:.0f}, {electrons:.0e} e"
    # Openings that are no rectangles are outside the description.
    return Case(what, functools.partial(answer, built, seed, tilt, electrons, highest), sound=highest == np.inf)


def answer(built: WireStart, seed: int, tilt_deg: float, electrons: float, highest: float) -> Answer:
    """Of the fit with all pixels: the map at places all over the sensor."""
    lens = geometry(tilt_deg)
    true = drawn_truth(seed, built, lens, highest=highest)
    result = fitted(noisy(true, seed, electrons), built, lens, PRNU)
    if not result.ok:
        return of_result(result, ())
    pixels = places()
    error, sigma = map_at(result.term, pixels) - map_at(true, pixels), map_sigma(result, pixels)
    # Both maps have a mean of 1; the few places do not.
    numbers = (
        Number(f"map at ({x:.0f}, {y:.0f})", float(off), float(own), words=("map is not",))
        for (x, y), off, own in zip(pixels, error, sigma, strict=True)
    )
    return of_result(result, tuple(numbers))


FAMILY = Family("wire", draw, most_refused=0.1)
