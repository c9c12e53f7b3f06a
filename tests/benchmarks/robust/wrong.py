"""Wrong input of every kind to every entry point that takes arrays: a sentence, a status, a note, or a right answer."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tests.benchmarks.robust.family import Answer, Case, Family, Number, all_finite, of_result
from tests.fitting.geometry.boards import sight
from tests.scenes import wire as wires
from tests.scenes.noise import PLAIN, expose, patterns, truth
from udccal.board.charuco import board_points_mm
from udccal.fitting.geometry.fit import fit_geometry
from udccal.fitting.hdr.merge import merge_bracket
from udccal.fitting.noise.data import ExposureLevel, NoiseData, SpatialStack
from udccal.fitting.noise.fit import fit_noise
from udccal.fitting.psf_stamps.data import Stamps
from udccal.fitting.psf_stamps.fit import fit_psf_stamps
from udccal.fitting.wire.data import WireData
from udccal.fitting.wire.fit import fit_wire
from udccal.fitting.wire.parameters import WireRules
from udccal.models.noise import Noise
from udccal.result import FitStatus

Arrays = list[Any]
Spoil = Callable[[Arrays, np.random.Generator], Arrays]


@dataclass(frozen=True)
class Entry:
    """An entry point: its arguments as a list of arrays and numbers, and its answer to them."""

    name: str
    arrays: Callable[[], Arrays]
    answer: Callable[[Arrays], Answer]


def _one(arrays: Arrays, rng: np.random.Generator, change: Callable[[np.ndarray], Any]) -> Arrays:
    """One of the arrays changed."""
    places = [i for i, part in enumerate(arrays) if isinstance(part, np.ndarray)]
    place = int(rng.choice(places))
    return [change(part) if i == place else part for i, part in enumerate(arrays)]


def _spoiled(value: float, part: float) -> Spoil:
    def spoil(arrays: Arrays, rng: np.random.Generator) -> Arrays:
        def change(array: np.ndarray) -> np.ndarray:
            return np.where(rng.random(array.shape) < part, value, array.astype(np.float64))

        return _one(arrays, rng, change)

    return spoil


def _changed(change: Callable[[np.ndarray], Any]) -> Spoil:
    return lambda arrays, rng: _one(arrays, rng, change)


def _numbers(value: float) -> Spoil:
    def spoil(arrays: Arrays, rng: np.random.Generator) -> Arrays:
        places = [i for i, part in enumerate(arrays) if isinstance(part, float)] or [0]
        place = int(rng.choice(places))
        return [value if i == place else part for i, part in enumerate(arrays)]

    return spoil


def _swapped(arrays: Arrays, rng: np.random.Generator) -> Arrays:
    first, second = rng.choice(len(arrays), 2, replace=False)
    out = list(arrays)
    out[first], out[second] = arrays[second], arrays[first]
    return out


SPOILS: tuple[tuple[str, Spoil], ...] = (
    ("nan everywhere", _spoiled(np.nan, 1.1)),
    ("nan in a tenth", _spoiled(np.nan, 0.1)),
    ("infinite in a hundredth", _spoiled(np.inf, 0.01)),
    ("-inf in a hundredth", _spoiled(-np.inf, 0.01)),
    ("0 everywhere", _changed(np.zeros_like)),
    ("constant", _changed(lambda a: np.full_like(a, a.flat[0] if a.size else 0))),
    ("negative", _changed(lambda a: -a.astype(np.float64))),
    ("huge in a tenth", _spoiled(1e30, 0.1)),
    ("tiny in a tenth", _spoiled(1e-30, 0.1)),
    ("empty", _changed(lambda a: a[:0])),
    ("one less", _changed(lambda a: a[:-1])),
    ("one dimension more", _changed(lambda a: a[None])),
    ("flat", _changed(np.ravel)),
    ("transposed", _changed(np.transpose)),
    ("float32", _changed(lambda a: a.astype(np.float32))),
    ("int64", _changed(lambda a: np.nan_to_num(a).astype(np.int64))),
    ("big-endian", _changed(lambda a: a.astype(a.dtype.newbyteorder(">")))),
    ("complex", _changed(lambda a: a.astype(complex))),
    ("text", _changed(lambda a: a.astype(str))),
    ("bool", _changed(lambda a: a > 0)),
    ("None", _changed(lambda a: None)),
    ("list", _changed(lambda a: a.tolist())),
    ("not contiguous", _changed(lambda a: np.repeat(a, 2, axis=-1)[..., ::2])),
    ("two exchanged", _swapped),
    ("a number 0", _numbers(0.0)),
    ("a number -1", _numbers(-1.0)),
    ("a number nan", _numbers(float("nan"))),
    ("a number infinite", _numbers(float("inf"))),
)


def draw(seed: int) -> Case:
    """Entry points by turns, with a drawn mistake."""
    rng = np.random.default_rng([seed, 21])
    entry = ENTRIES[seed % len(ENTRIES)]
    name, spoil = SPOILS[int(rng.integers(len(SPOILS)))]
    return Case(f"{entry.name}: {name}", functools.partial(_answer, entry, spoil, seed), sound=False)


def _answer(entry: Entry, spoil: Spoil, seed: int) -> Answer:
    return entry.answer(spoil(entry.arrays(), np.random.default_rng([seed, 22])))


@functools.cache
def _noise_arrays() -> tuple[Any, ...]:
    rng, sensor = np.random.default_rng(5), replace(PLAIN, rows=64, columns=80)
    fixed = patterns(sensor, rng)
    times = [sensor.exposure_s(level) for level in (0.1, 0.3, 0.5, 0.7)]
    frames = [expose(sensor, fixed, t, lit, rng) for t in times for lit in (False, False, True, True)]
    stacks = [np.stack([expose(sensor, fixed, times[2], lit, rng) for _ in range(4)]) for lit in (False, True)]
    return (*frames, *stacks, *times)


def _noise(arrays: Arrays) -> Answer:
    frames, (dark, flat), times = arrays[:16], arrays[16:18], arrays[18:]
    pairs = zip(times, frames[0::4], frames[1::4], frames[2::4], frames[3::4], strict=True)
    levels = [ExposureLevel(t, (a, b), (c, d)) for t, a, b, c, d in pairs]
    result = fit_noise(NoiseData(levels, SpatialStack(times[2], dark, flat), top_code=4095))
    right = truth(replace(PLAIN, rows=64, columns=80))
    stated = [one for one in result.estimates if one.name in ("K_DN_per_e", "black_DN", "sigma_d_e")]
    return of_result(result, tuple(Number(e.name, e.value - right[e.name], e.sigma, words=("",)) for e in stated))


_SENSOR = Noise(0.36, 64.0, 4095.0, 4.0, 0.14, 0.0, 1.0, 10.0, 0.0, 0.0)


@functools.cache
def _hdr_arrays() -> tuple[Any, ...]:
    rng, times = np.random.default_rng(6), 1e-3 * 3.0 ** np.arange(5)
    rate = np.full((60, 70), 2e4)
    electrons = [rng.poisson((rate + 10) * t) + 4 * rng.standard_normal(rate.shape) for t in times]
    frames = np.clip(np.rint(64 + 0.36 * np.array(electrons)), 0, 4095).astype(np.uint16)
    return frames, times, 0.36, 64.0, 4095.0, 4.0


def _hdr(arrays: Arrays) -> Answer:
    frames, times, K, black, saturation, sigma_d = arrays
    told = Noise(K, black, saturation, sigma_d, 0.14, 0.0, 1.0, 10.0, 0.0, 0.0)
    merged = merge_bracket(frames, times, told)
    good = merged.status is FitStatus.CONVERGED
    z = (merged.rate_e_per_s - 2e4) / merged.sigma_e_per_s
    number = Number("rate", float(np.mean(z)) * (merged.used.max(initial=0) > 0), 0.05 + z.size**-0.5)
    notes = (*merged.notes, *(one.rule for one in merged.outliers), *([] if good else [merged.status.value]))
    return Answer(good, notes, (number,), all_finite(merged.rate_e_per_s, merged.sigma_e_per_s))


@functools.cache
def _geometry_arrays() -> tuple[Any, ...]:
    scene = sight(seed=1, views=6)
    views = scene.views(np.random.default_rng(7))
    points = board_points_mm(scene.spec)
    return (*(points[v.corners.ids] for v in views), *(v.corners.xy for v in views))


def _geometry(arrays: Arrays) -> Answer:
    scene = sight(seed=1, views=6)
    result = fit_geometry(arrays[:6], arrays[6:], scene.size)
    true = np.concatenate([scene.camera.focal_px, scene.camera.principal_point_px])
    stated = zip(result.estimates[:4], true, strict=False)
    return of_result(result, tuple(Number(e.name, e.value - t, e.sigma, words=("left out",)) for e, t in stated))


@functools.cache
def _wire_arrays() -> tuple[Any, ...]:
    flat = wires.noisy(wires.drawn_truth(wires.SEED, wires.start(), wires.geometry()), wires.SEED)
    return flat.signal, flat.variance, wires.PRNU


def _wire(arrays: Arrays) -> Answer:
    signal, variance, PRNU = arrays
    data = WireData(signal, variance, wires.geometry(), wires.start(), PRNU)
    result = fit_wire(data, WireRules(samples=4000))
    return of_result(result, ())


@functools.cache
def _stamps_arrays() -> tuple[Any, ...]:
    rng = np.random.default_rng(8)
    y, x = np.mgrid[-5:6, -5:6]
    light = 2e4 * np.exp(-(x**2 + y**2) / (2 * 1.3**2)) / (2 * np.pi * 1.3**2)
    places = rng.integers(0, 500, (20, 2))
    values = rng.poisson(light, (20, 11, 11)) + 3.0 * rng.standard_normal((20, 11, 11))
    return values, places, 3.0, 1e9


def _stamps(arrays: Arrays) -> Answer:
    found = fit_psf_stamps(Stamps(*arrays))
    return Answer(found.status is FitStatus.CONVERGED, (found.status.value, *found.notes), (), True)


ENTRIES = (
    Entry("fit_noise", lambda: list(_noise_arrays()), _noise),
    Entry("merge_bracket", lambda: list(_hdr_arrays()), _hdr),
    Entry("fit_geometry", lambda: list(_geometry_arrays()), _geometry),
    Entry("fit_wire", lambda: list(_wire_arrays()), _wire),
    Entry("fit_psf_stamps", lambda: list(_stamps_arrays()), _stamps),
)
FAMILY = Family("wrong", draw)
