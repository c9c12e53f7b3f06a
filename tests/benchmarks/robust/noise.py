"""Sensors of every kind: read noise, patterns of gain, bends, gains, converters, wells, dark current, flicker."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np

from tests.benchmarks.efficiency.noise import bounds
from tests.benchmarks.robust.family import Answer, Case, Family, Number, of_result
from tests.scenes.noise import ToySensor, measure, patterns, truth

Draw = Callable[[np.random.Generator, tuple[int, ...]], np.ndarray]
_ROWS, _COLUMNS = 144, 192
# Notes that say of a number that it may be off.
_CODED = ("of the model's kind",)
_WORDS = {
    "PRNU1288": ("PRNU1288",),
    "dark_current_e_per_s": ("dark current of", *_CODED),
    "black_DN": _CODED,
    "sigma_d_e": _CODED,
    "sigma_row_DN": _CODED,
    "DSNU1288_e": _CODED,
}


def draw(seed: int) -> Case:
    """A sensor and its frames."""
    rng = np.random.default_rng([seed, 16])
    bits = int(rng.choice([8, 10, 12, 14, 16]))
    top, well = 2.0**bits - 1, float(np.exp(rng.uniform(np.log(2e3), np.log(5e4))))
    # The converter ends below the full well, or a third beyond it.
    K = top / well * rng.uniform(0.6, 1.15)
    # Read noise of at least a seventh of a code; black ten sigma above 0.
    read = max(float(np.exp(rng.uniform(np.log(0.7), np.log(12.0)))), 0.15 / K)
    row = float(rng.choice([0.0, rng.uniform(0.05, 1.0)])) * K * read
    offset = float(rng.choice([0.0, rng.uniform(0.1, 1.5)])) * read
    black = float(np.ceil(10 * math.hypot(K * read, row, K * offset) + 2))
    name, other = _read_noise(rng)
    telegraph = float(rng.choice([0.0, 0.0, rng.uniform(0.002, 0.08)]))
    kind, pattern = _pattern(rng)
    sensor = ToySensor(
        rows=_ROWS,
        columns=_COLUMNS,
        K_DN_per_e=K,
        black_DN=black,
        full_well_e=well,
        read_e=read,
        lambda_read=float(rng.uniform(-0.05, 0.3)) if name == "Tukey" else None,
        other_noise=other,
        telegraph=telegraph,
        pattern=pattern,
        row_DN=row,
        dark_e_per_s=float(rng.choice([0.0, np.exp(rng.uniform(np.log(3.0), np.log(300.0)))])),
        DSNU_e=offset,
        PRNU=float(rng.choice([0.0, rng.uniform(0.001, 0.015)])),
        bend=float(rng.choice([0.0, rng.uniform(-0.03, 0.12)])),
        bits=bits,
        flux_e_per_s=5 * well,
        flicker=float(rng.choice([0.0, 0.0, rng.uniform(1e-3, 0.02)])),
    )
    sensor = replace(sensor, black_DN_per_s=_moving_black(np.random.default_rng([seed, 27]), sensor))
    tails = f", {telegraph:.1%} telegraph" if telegraph else ""
    moves = f", black moves {sensor.black_DN_per_s:+.2g} DN/s" if sensor.black_DN_per_s else ""
    what = f"{name}{tails}, {kind} gain, {bits} bit, K {K:.3g}, read {read:.2g} e, bend {sensor.bend:.2g}{moves}"
    return Case(what, functools.partial(answer, sensor, seed, _bounded(sensor)))


def _moving_black(rng: np.random.Generator, sensor: ToySensor) -> float:
    """In a twentieth each: a camera that compensates dark current, and one whose black rises.

    It rises as by a dark current whose noise would show: of 0.15 to 3 times the read noise's variance in a second.
    """
    kind, part = int(rng.integers(20)), float(np.exp(rng.uniform(np.log(0.15), np.log(3.0))))
    rise_e = {0: -sensor.dark_e_per_s, 1: 3.0 + part * sensor.read_e**2}.get(kind, 0.0)
    return sensor.K_DN_per_e * rise_e


def _read_noise(rng: np.random.Generator) -> tuple[str, Draw | None]:
    """Name and draw of unit variance; None stands for normal noise or Tukey's lambda."""
    name = str(rng.choice(["normal", "Tukey", "Student", "Laplace", "mixture"]))
    freedom, part, wide = float(rng.uniform(3.0, 8.0)), float(rng.uniform(0.01, 0.2)), float(rng.uniform(2.0, 6.0))
    if name == "Student":
        unit = math.sqrt(freedom / (freedom - 2))
        return f"Student t {freedom:.1f}", lambda rng, size: rng.standard_t(freedom, size) / unit
    if name == "Laplace":
        return name, lambda rng, size: rng.laplace(size=size) / math.sqrt(2)
    if name == "mixture":
        unit = math.sqrt(1 + part * (wide**2 - 1))
        return (
            f"mixture {part:.0%} x {wide:.1f}",
            lambda rng, size: np.where(rng.random(size) < part, wide, 1.0) * rng.standard_normal(size) / unit,
        )
    return name, None


def _pattern(rng: np.random.Generator) -> tuple[str, np.ndarray | None]:
    """A relative response in addition to the white one."""
    kind, size = str(rng.choice(["white", "columns", "rows", "blobs"])), float(rng.uniform(0.001, 0.015))
    shape = {"columns": (1, _COLUMNS), "rows": (_ROWS, 1)}.get(kind, (_ROWS, _COLUMNS))
    picture = rng.standard_normal(shape)
    if kind == "white":
        return kind, None
    if kind == "blobs":
        picture = cv2.GaussianBlur(picture, (0, 0), float(rng.uniform(0.7, 6.0)))
    return kind, size * np.broadcast_to(picture / picture.std(), (_ROWS, _COLUMNS))


def answer(sensor: ToySensor, seed: int, bounded: bool) -> Answer:
    """Of the fit; the bound is that of sensors whose read noise the model knows."""
    result = measure(sensor, seed)
    if not result.ok:
        return of_result(result, ())
    # ``measure`` draws the patterns first.
    fixed = patterns(sensor, np.random.default_rng([seed, 77]))
    read = float(np.sqrt(np.mean(fixed.read_e**2)))
    true = truth(replace(sensor, read_e=read)) | {"PRNU1288": float(np.std(fixed.response) / np.mean(fixed.response))}
    if sensor.black_DN_per_s:
        # A well that fills does so at another code in every exposure.
        del true["saturation_DN"]
    least = _least(sensor) if bounded else {}
    stated = [one for one in result.estimates if one.name in true and (one.name != "lambda_read" or bounded)]
    return of_result(
        result,
        tuple(
            Number(one.name, one.value - true[one.name], one.sigma, least.get(one.name, math.nan),
                   _WORDS.get(one.name, ()))
            for one in stated
        ),
    )  # fmt: skip


def _bounded(sensor: ToySensor) -> bool:
    """Whether the bound holds: the likelihood is the model's, and light is as steady as the exposure times say."""
    return sensor.other_noise is None and not (sensor.telegraph or sensor.flicker or sensor.black_DN_per_s)


def _least(sensor: ToySensor) -> dict[str, float]:
    """The bounds of what the sensor has; the derivatives need a little of everything."""
    here = truth(sensor)
    some = replace(
        sensor,
        pattern=None,
        row_DN=max(sensor.row_DN, 0.05 * sensor.K_DN_per_e * sensor.read_e),
        DSNU_e=max(sensor.DSNU_e, 0.1 * sensor.read_e),
        dark_e_per_s=max(sensor.dark_e_per_s, 3.0),
        PRNU=max(sensor.PRNU, 1e-3),
        bend=sensor.bend or 1e-3,
    )
    return {name: bound for name, bound in bounds(some).items() if here[name]}


FAMILY = Family("noise", draw)
