"""The wire fit at the ends of its range, on flats drawn from the model."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import jax
import numpy as np

from tests.benchmarks.extremes.case import MOST_SINGLE, Case, Outcome, outcome
from tests.scenes.wire import (
    COLUMNS,
    ELECTRONS,
    ROWS,
    SEED,
    Flat,
    constant,
    drawn_truth,
    fitted,
    geometry,
    map_at,
    map_sigma,
    noisy,
    places,
    start,
)
from udccal.fitting.wire.parameters import WireStart
from udccal.models.geometry import Geometry
from udccal.models.wire import Wire, wire_map
from udccal.result import FitResult, FitStatus

# Of lenses that still resolve the rows.
_FAR_FOCAL_PX, _STEEP_FOCAL_PX = 1500.0, 400.0


def judged(fit: FitResult[Wire], flat: Flat) -> Outcome:
    """Return the map's errors at places over the sensor, in units of its sigma."""
    if not fit.ok:
        return outcome(fit)
    error = map_at(fit.term, places()) - map_at(flat.truth, places())
    return outcome(fit, error / map_sigma(fit, places()))


def of_rig(
    built: WireStart, lens: Geometry | None = None, modulated: bool = True, electrons: float = ELECTRONS
) -> Outcome:
    """A truth near ``built``, and its fit."""
    lens = lens or geometry()
    flat = noisy(drawn_truth(SEED, built, lens, modulated), SEED, electrons)
    return judged(fitted(flat, built, lens), flat)


def _narrow(lens: Geometry, focal_px: float) -> Geometry:
    return replace(lens, focal_px=np.array([focal_px, focal_px]))


def _rows_only(footprint_per_pitch: float) -> WireStart:
    """A small pupil shows many harmonics of columns, too; without those, fits are quick."""
    return replace(start(), footprint_per_pitch=footprint_per_pitch, column_open=0.9995, column_tolerance=1e-4)


def wrong_start(standoff: float, pupil: float, seed: int = SEED) -> Outcome:
    """The rig description off by these factors."""
    built = start()
    flat = noisy(drawn_truth(seed, built, geometry()), seed)
    wrong = replace(
        built,
        standoff_per_pitch=built.standoff_per_pitch * standoff,
        footprint_per_pitch=built.footprint_per_pitch * pupil,
    )
    return judged(fitted(flat, wrong, geometry()), flat)


def saturated() -> Outcome:
    """Every pixel above the level from which frames clip."""
    signal = np.full((ROWS, COLUMNS), 4095.0)
    flat = Flat(drawn_truth(SEED, start(), geometry()), signal, signal)
    return outcome(fitted(flat, start(), geometry(), clip=4000.0))


def clipped_middle() -> Outcome:
    """The brightest parts clip, pixel by pixel as their noise has it."""
    flat = noisy(drawn_truth(SEED, start(), geometry()), SEED)
    clip = float(np.quantile(flat.signal, 0.99))
    flat = replace(flat, signal=np.minimum(flat.signal, clip))
    return judged(fitted(flat, start(), geometry(), clip=clip), flat)


def single_precision() -> Outcome:
    """The map in float32 against the map in float64, in sigmas of the fit."""
    flat = noisy(drawn_truth(SEED, start(), geometry()), SEED)
    fit = fitted(flat, start(), geometry())
    single = np.asarray(wire_map(fit.term, ROWS, COLUMNS), dtype=np.float64)
    with jax.enable_x64(True):
        double = np.asarray(wire_map(fit.term, ROWS, COLUMNS))
    y, x = np.divmod(np.arange(0, single.size, 37), COLUMNS)
    off = np.abs(single - double)[y, x] / map_sigma(fit, np.stack([x, y], axis=-1).astype(np.float64))
    found = outcome(fit, off)
    if off.max() <= MOST_SINGLE:
        return found
    return replace(found, status=FitStatus.POOR_FIT, advice="")


def _case(name: str, run: Callable[[], Outcome]) -> Case:
    return Case("wire", name, run)


CASES: tuple[Case, ...] = (
    _case("modulation 0", lambda: of_rig(start(), modulated=False)),
    _case("modulation 0.98: pupil of one period", lambda: of_rig(_rows_only(1.0))),
    _case("amplitude through zero over the field", lambda: of_rig(_rows_only(2.233))),
    _case(
        "pupil touching the panel",
        lambda: of_rig(replace(start(), standoff_per_pitch=0.02, standoff_tolerance=0.5)),
    ),
    _case(
        "pupil 100 mm from the panel",
        lambda: of_rig(
            replace(start(), standoff_per_pitch=158.0, standoff_tolerance=0.01),
            _narrow(geometry(), _FAR_FOCAL_PX),
        ),
    ),
    _case("tilt 0°", lambda: of_rig(start(), geometry(0.0))),
    _case("tilt 60°", lambda: of_rig(start(), _narrow(geometry(60.0), _STEEP_FOCAL_PX))),
    _case("constant flat", lambda: outcome(constant(1000.0))),
    _case("black flat", lambda: outcome(constant(0.0))),
    _case("saturated flat", saturated),
    _case("1 % of the flat clipped", clipped_middle),
    _case("10 frames of 1 e⁻", lambda: of_rig(start(), electrons=10.0)),
    _case("1 frame of 1 e⁻", lambda: of_rig(start(), electrons=1.0)),
    _case("stand-off over pitch 20 % too small", lambda: wrong_start(0.8, 1.0)),
    _case("stand-off over pitch 20 % too large", lambda: wrong_start(1.2, 1.0)),
    _case("pupil over pitch 20 % too small", lambda: wrong_start(1.0, 0.8)),
    _case("pupil over pitch 20 % too large", lambda: wrong_start(1.0, 1.2)),
    _case("pitch 20 % too large", lambda: wrong_start(1 / 1.2, 1 / 1.2)),
    _case("pitch 20 % too small, stand-off and lens 20 % too large", lambda: wrong_start(1.5, 1.5)),
    _case("map in float32 against float64, under a tenth of sigma", single_precision),
)
