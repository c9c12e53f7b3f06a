"""Sensors and captures at the ends: single electrons, extreme gains, no dark noise, few bits, clipped, flickering."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np

from tests.benchmarks.extremes.case import Case, Outcome, outcome
from tests.scenes.noise import PLAIN, ToySensor, errors_in_sigma, expose, measure, patterns
from udccal.fitting.noise.data import ExposureLevel, NoiseData, SpatialStack
from udccal.fitting.noise.fit import fit_noise

_DIM = tuple(np.geomspace(1.0, 60.0, 8) / 10_000)


def _measured(sensor: ToySensor, seed: int = 0) -> Outcome:
    result = measure(sensor, seed)
    return outcome(result, errors_in_sigma(result, sensor))


def _clipped_white() -> Outcome:
    return _measured(replace(PLAIN, levels=(2.0, 2.5, 3.0, 4.0), stack_level=3.0))


def _without_stack() -> Outcome:
    sensor = PLAIN
    rng = np.random.default_rng(4)
    fixed = patterns(sensor, rng)
    shoot = functools.partial(expose, sensor, fixed, rng=rng)
    times = [sensor.exposure_s(level) for level in sensor.levels]
    levels = [ExposureLevel(t, (shoot(t, False), shoot(t, False)), (shoot(t, True), shoot(t, True))) for t in times]
    result = fit_noise(NoiseData(levels, top_code=4095))
    return outcome(result, errors_in_sigma(result, sensor))


def _one_frame_everywhere(code: int) -> Outcome:
    frame = np.full((96, 128), code, np.uint16)
    levels = [ExposureLevel(0.01 * i, (frame, frame), (frame, frame)) for i in range(1, 6)]
    stack = SpatialStack(0.03, [frame] * 4, [frame] * 4)
    return outcome(fit_noise(NoiseData(levels, stack, top_code=4095)))


def _case(name: str, sensor: ToySensor) -> Case:
    return Case("noise", name, functools.partial(_measured, sensor))


CASES = (
    _case("signals from 1 e- to 60 e-", replace(PLAIN, levels=_DIM, stack_level=30 / 10_000)),
    _case(
        "signals from 1 e- to 60 e-, read noise 0.4 e-, 2 DN/e-",
        replace(PLAIN, levels=_DIM, stack_level=30 / 10_000, read_e=0.4, K_DN_per_e=2.0, bits=16, row_DN=0.1),
    ),
    _case("signals from 1 e- to the full well", replace(PLAIN, levels=(*_DIM, *PLAIN.levels))),
    _case("gain 0.05 DN/e-", replace(PLAIN, K_DN_per_e=0.05, read_e=8.0, row_DN=0.1)),
    _case("gain 5 DN/e-, 16 bit", replace(PLAIN, K_DN_per_e=5.0, bits=16, row_DN=5.0)),
    _case(
        "gain 20 DN/e-, 16 bit",
        replace(PLAIN, K_DN_per_e=20.0, bits=16, full_well_e=3000.0, flux_e_per_s=15_000.0, row_DN=20.0),
    ),
    _case("no read noise", replace(PLAIN, read_e=0.0)),
    _case(
        "no read noise, no pattern, no dark current",
        replace(PLAIN, read_e=0.0, row_DN=0.0, DSNU_e=0.0, dark_e_per_s=0.0),
    ),
    _case("no read noise, 1 DN/e-", replace(PLAIN, read_e=0.0, K_DN_per_e=1.0, bits=14)),
    _case("8 bit", replace(PLAIN, bits=8, K_DN_per_e=0.022, black_DN=8.0, row_DN=0.02)),
    _case("10 bit", replace(PLAIN, bits=10, K_DN_per_e=0.09, black_DN=16.0, row_DN=0.1)),
    _case("16 bit", replace(PLAIN, bits=16, K_DN_per_e=5.8, black_DN=1000.0, row_DN=6.0)),
    _case("no light", replace(PLAIN, lamp=0.0)),
    Case("noise", "all clipped", _clipped_white),
    _case("one level", replace(PLAIN, levels=(0.5,))),
    _case("saturation not reached", replace(PLAIN, levels=PLAIN.levels[:-1])),
    _case("codes end below the full well", replace(PLAIN, full_well_e=13_000.0, flux_e_per_s=65_000.0)),
    _case("black level 0: dark codes cut off", replace(PLAIN, black_DN=0.0)),
    _case("black level 0 and 0.5 e- read noise", replace(PLAIN, black_DN=0.0, read_e=0.5, row_DN=0.05)),
    _case("lamp flickers by 2 %", replace(PLAIN, flicker=0.02)),
    _case("lamp flickers by 20 %", replace(PLAIN, flicker=0.2)),
    _case("bent by 15 %", replace(PLAIN, bend=0.15)),
    _case("bent the other way by 10 %", replace(PLAIN, bend=-0.1, levels=PLAIN.levels[:-1])),
    _case("frames of 16 x 16", replace(PLAIN, rows=16, columns=16)),
    Case("noise", "no spatial stack", _without_stack),
    Case("noise", "every frame 0", functools.partial(_one_frame_everywhere, 0)),
    Case("noise", "every frame 4095", functools.partial(_one_frame_everywhere, 4095)),
    Case("noise", "every frame 100", functools.partial(_one_frame_everywhere, 100)),
)
