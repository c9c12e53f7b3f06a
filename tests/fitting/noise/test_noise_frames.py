"""The noise term from plain arrays: on sensors of known numbers, at random, and with frames that are none."""

from __future__ import annotations

import inspect
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, example, given, settings
from hypothesis import strategies as st

from tests.scenes.noise import (
    PLAIN,
    ToySensor,
    chosen_terms,
    errors_in_sigma,
    expose,
    measure,
    patterns,
    sensor_with,
    truth,
)
from udccal.errors import FitError
from udccal.fitting.noise.data import ExposureLevel, Frame, NoiseData, NoiseRules, SpatialStack
from udccal.fitting.noise.fit import fit_noise
from udccal.fitting.noise.moments import reduced
from udccal.result import FitStatus


def capture(sensor: ToySensor, seed: int) -> tuple[list[ExposureLevel], SpatialStack]:
    rng = np.random.default_rng(seed)
    shoot = partial(expose, sensor, patterns(sensor, rng), rng=rng)
    times = [sensor.exposure_s(level) for level in sensor.levels]
    levels = [ExposureLevel(t, (shoot(t, False), shoot(t, False)), (shoot(t, True), shoot(t, True))) for t in times]
    t = sensor.exposure_s(sensor.stack_level)
    dark, bright = ([shoot(t, lit) for _ in range(sensor.stack_frames)] for lit in (False, True))
    return levels, SpatialStack(t, dark, bright)


def test_a_bent_sensor_is_found_bent_and_every_number_within_its_error() -> None:
    sensor = ToySensor()
    result = measure(sensor, 5).or_raise()
    assert len(errors_in_sigma(result, sensor)) == len(truth(sensor))
    assert np.abs(errors_in_sigma(result, sensor)).max() < 4.5
    assert result.estimate("nonlinearity").value == pytest.approx(0.02, rel=0.05)
    # A straight line through the same variances would be off by far more than this.
    assert float(np.asarray(result.term.K_DN_per_e)) == pytest.approx(sensor.K_DN_per_e, rel=0.015)


def test_the_response_and_its_bend_are_among_the_diagnostics() -> None:
    sensor = ToySensor()
    numbers = {item.name: item.value for item in measure(sensor, 5).diagnostics}
    full_DN = sensor.K_DN_per_e * sensor.full_well_e
    assert numbers["response_DN_per_light"] == pytest.approx(sensor.K_DN_per_e * sensor.flux_e_per_s, rel=2e-3)
    assert numbers["curvature"] == pytest.approx(sensor.bend / full_DN, rel=0.05)


@pytest.mark.parametrize("seed", range(3))
def test_the_terms_that_are_there_are_chosen(seed: int) -> None:
    there = np.random.default_rng([seed, 3]).random(5) < 0.5
    assert chosen_terms(measure(sensor_with(there), 50 + seed)) == tuple(there.tolist())


@pytest.mark.slow
def test_the_right_terms_in_95_of_100_runs() -> None:
    from tests.scenes.noise import right_orders

    right, count = right_orders(1.0)
    assert right >= 0.95 * count


@pytest.mark.medium
def test_loaders_and_arrays_and_bytes_give_the_same(tmp_path) -> None:  # type: ignore[no-untyped-def]
    sensor = replace(PLAIN, bits=8, K_DN_per_e=0.022, black_DN=8.0, row_DN=0.05)
    levels, stack = capture(sensor, 3)

    def lazy(frames: tuple[Frame, ...]) -> tuple[Frame, ...]:
        paths = [tmp_path / f"{id(frame)}.npy" for frame in frames]
        for path, frame in zip(paths, frames, strict=True):
            np.save(path, frame.astype(np.uint8))
        return tuple(partial(np.load, path, mmap_mode="r") for path in paths)

    late = [replace(level, dark=lazy(level.dark), bright=lazy(level.bright)) for level in levels]
    late_stack = replace(stack, dark=lazy(tuple(stack.dark)), bright=lazy(tuple(stack.bright)))
    here, there = (fit_noise(NoiseData(*frames, top_code=255)) for frames in ((levels, stack), (late, late_stack)))
    assert here.ok
    assert [e.value for e in here.estimates] == [e.value for e in there.estimates]


def test_colours_of_a_mosaic_are_kept_apart() -> None:
    sensor = PLAIN
    levels, stack = capture(sensor, 4)
    data = reduced(NoiseData(levels, stack, bayer=True, top_code=4095), NoiseRules())
    assert data is not None
    grey = reduced(NoiseData(levels, stack, top_code=4095), NoiseRules())
    assert grey is not None
    assert (data.flats[0].mean_DN.size, grey.flats[0].mean_DN.size) == (4, 1)
    result = fit_noise(NoiseData(levels, stack, bayer=True, top_code=4095))
    assert np.abs(errors_in_sigma(result, sensor)).max() < 4.5


def test_a_flickering_pair_and_cosmic_hits_are_listed_and_left_out() -> None:
    sensor = PLAIN
    levels, stack = capture(sensor, 6)
    first, second = levels[4].bright
    levels[4] = replace(levels[4], bright=(first, (second * 0.8).astype(np.uint16)))
    first, second = (frame.copy() for frame in levels[2].dark)
    first[10:14, 20:24] += 3000
    levels[2] = replace(levels[2], dark=(first, second))
    result = fit_noise(NoiseData(levels, stack, top_code=4095))
    rules = {outliers.rule.split(" ")[0]: outliers for outliers in result.outliers}
    assert rules["flats"].places[0].startswith("flat 4 ")
    assert rules["two"].count == 16
    assert np.abs(errors_in_sigma(result, sensor)).max() < 4.5


def test_pixels_patterns_in_a_flickering_stack_are_not_taken_for_shot_noise() -> None:
    # Frames that differ by 20 % of light differ by as much of every pixel's response: of K that would be 3.6 sigma.
    result = measure(replace(PLAIN, flicker=0.2), 0)
    K = result.estimate("K_DN_per_e")
    assert abs(K.value - PLAIN.K_DN_per_e) < 2.5 * K.sigma


@pytest.mark.parametrize("read_e", [0.3, 1.2])
def test_rounding_is_in_the_sigma_of_a_saturation_between_codes(read_e: float) -> None:
    sensor = replace(PLAIN, read_e=read_e, row_DN=0.0, DSNU_e=0.0, full_well_e=10_001.25)
    found, true = measure(sensor, 3).estimate("saturation_DN"), truth(sensor)["saturation_DN"]
    assert abs(found.value - true) < 3 * found.sigma
    assert found.sigma < 0.35


def test_rounding_of_noise_with_tails_is_in_the_sigma_of_a_saturation_between_codes() -> None:
    def laplace(rng: np.random.Generator, size: tuple[int, ...]) -> np.ndarray:
        return rng.laplace(size=size) / np.sqrt(2)

    off = []
    for well in (16_653.2, 16_654.4, 16_655.4):
        sensor = replace(PLAIN, K_DN_per_e=0.2294, full_well_e=well, read_e=2.6, row_DN=0.0, DSNU_e=0.0, PRNU=0.013)
        sensor = replace(sensor, other_noise=laplace, flux_e_per_s=5 * well)
        found, true = measure(sensor, 3).estimate("saturation_DN"), truth(sensor)["saturation_DN"]
        off.append(abs(found.value - true) / found.sigma)
        assert found.sigma < 0.3
    assert max(off) < 3


def test_a_bend_that_unsteady_light_hides_is_in_the_sigma_of_the_gain() -> None:
    # The lamp hides the bend from the response; the variances alone do not show it clearly, and K takes its part.
    sensor = replace(PLAIN, rows=144, columns=192, K_DN_per_e=2.8, full_well_e=3800.0, bits=14, bend=-0.008)
    sensor = replace(
        sensor, black_DN=122.0, row_DN=0.0, DSNU_e=0.0, dark_e_per_s=0.0, flux_e_per_s=19_000.0, flicker=0.011
    )
    results = [measure(sensor, seed) for seed in range(3)]
    gains = [result.estimate("K_DN_per_e") for result in results]
    assert any("nonlinearity" not in [one.name for one in result.estimates] for result in results)
    assert max(abs(K.value - 2.8) / K.sigma for K in gains) < 4


def test_a_full_well_just_below_the_last_code_is_in_the_sigma_of_saturation() -> None:
    # Nearly all full pixels are rounded to the last code.
    sensor = replace(PLAIN, bits=8, K_DN_per_e=0.017, black_DN=5.0, full_well_e=249.95 / 0.017, read_e=11.0)
    sensor = replace(sensor, row_DN=0.0, DSNU_e=0.0, flux_e_per_s=5 * 249.95 / 0.017)
    found = measure(sensor, 2).estimate("saturation_DN")
    assert found.value == 255
    assert 0.05 / 3 < found.sigma < 0.1
    beyond = measure(replace(sensor, full_well_e=2e4, read_e=60.0), 2).estimate("saturation_DN")
    assert (beyond.value, beyond.sigma) == (255, 0)


@pytest.mark.parametrize("brightest", [0.5, 0.7])
def test_codes_that_end_in_one_colour_only_are_the_saturation(brightest: float) -> None:
    # Red and blue get half of green's light: less than half of the frame's samples have the converter's last code.
    colours = np.tile([[-0.5, 0.0], [0.0, -0.4]], (48, 64))
    sensor = replace(PLAIN, bits=10, K_DN_per_e=0.1, full_well_e=20_000.0, read_e=15.0, DSNU_e=5.0, pattern=colours)
    sensor = replace(sensor, flux_e_per_s=1e5, levels=(*np.linspace(0.04, 0.4, 9).tolist(), brightest), stack_level=0.2)
    levels, stack = capture(sensor, 1)
    saturation = fit_noise(NoiseData(levels, stack, bayer=True, top_code=1023)).estimate("saturation_DN")
    assert abs(saturation.value - 1023) <= saturation.sigma
    assert saturation.sigma < 0.35


@pytest.mark.parametrize("brightest", [1.15, 0.95])
def test_flats_that_clip_in_their_middle_alone_show_saturation(brightest: float) -> None:
    """No bin is full. Just below saturation, nothing piles up, and the converter's end is the only bound."""
    y, x = np.mgrid[-1:1:96j, -1:1:128j]
    sensor = replace(PLAIN, pattern=-0.4 * (x**2 + y**2), levels=(*PLAIN.levels[:-1], brightest))
    levels, stack = capture(sensor, 3)
    result = fit_noise(NoiseData(levels, stack, top_code=4095))
    found, true = result.estimate("saturation_DN"), truth(sensor)["saturation_DN"]
    seen = brightest > 1
    assert any("No flat reached saturation" in note for note in result.notes) != seen
    assert abs(found.value - true) < 3 * found.sigma
    assert (found.sigma < 0.5) == seen


def test_hot_pixels_are_named() -> None:
    levels, stack = capture(PLAIN, 6)
    for frame in stack.dark:
        frame[7, 9] += 500
    result = fit_noise(NoiseData(levels, stack, top_code=4095))
    hot = next(outliers for outliers in result.outliers if "hot" in outliers.rule)
    assert "row 7, column 9" in hot.places


def test_residuals_are_those_of_normal_noise_and_lie_on_the_sensor() -> None:
    sensor = replace(PLAIN, rows=256, columns=384)
    levels, stack = capture(sensor, 8)
    sample = fit_noise(NoiseData(levels, stack, bayer=True, top_code=4095)).residuals
    assert sample is not None
    assert len(sample.z) > 100
    assert sample.z.std() == pytest.approx(1.0, abs=4 / np.sqrt(2 * len(sample.z)))
    middle = sample.positions_px.mean(axis=0)
    assert middle == pytest.approx([0.5 * (sensor.columns - 1), 0.5 * (sensor.rows - 1)], abs=3.0)
    assert sample.positions_px.min() >= 0
    assert (sample.positions_px < [sensor.columns, sensor.rows]).all()


FRAME = np.full((32, 32), 100, np.uint16)


@pytest.mark.parametrize(
    ("levels", "stack", "sentence"),
    [
        ([ExposureLevel(0.1, (FRAME,), ())], None, "two dark frames"),
        ([ExposureLevel(-1.0, (FRAME, FRAME), ())], None, "exposure in seconds"),
        ([ExposureLevel(float("nan"), (FRAME, FRAME), ())], None, "exposure in seconds"),
        ([ExposureLevel(0.1, (FRAME, FRAME), (FRAME, FRAME), -5.0)], None, "number of photons"),
        ([], SpatialStack(float("nan"), [FRAME] * 2, [FRAME] * 2), "the stack to have an exposure in seconds"),
        ([], SpatialStack(0.1, [FRAME] * 2, [FRAME] * 2, -5.0), "the stack to have a number of photons"),
        ([ExposureLevel(0.1, (FRAME, FRAME[:20]), (FRAME, FRAME))], None, "found"),
        ([ExposureLevel(0.1, (lambda: FRAME.astype(float), FRAME), (FRAME, FRAME))], None, "uint8 or uint16"),
        ([ExposureLevel(0.1, (lambda: "frame", FRAME), (FRAME, FRAME))], None, "found str"),
        ([ExposureLevel(0.1, (FRAME[:4], FRAME[:4]), (FRAME, FRAME))], None, "samples a side"),
        ([ExposureLevel(0.1, (FRAME, FRAME), (FRAME, FRAME))], SpatialStack(0.1, [FRAME], [FRAME]), "stack"),
        ([ExposureLevel(0.1, (FRAME, FRAME), (FRAME + np.uint16(60000),) * 2)], None, "top_code"),
        ([ExposureLevel(0.1, (FRAME + np.uint16(60000),) * 2, (FRAME, FRAME))], None, "exchanged"),
    ],
)
def test_what_is_no_frame_is_refused(levels: list[ExposureLevel], stack: SpatialStack | None, sentence: str) -> None:
    with pytest.raises(FitError, match=sentence):
        fit_noise(NoiseData(levels, stack, top_code=4095))


def _unplugged() -> np.ndarray:
    raise OSError("disk gone")


def test_a_frame_that_cannot_be_loaded_is_named() -> None:
    """The function's own error came through, which says nothing of the frame."""
    levels = [ExposureLevel(0.1, (FRAME, FRAME), (FRAME, FRAME)), ExposureLevel(0.2, (FRAME, _unplugged), ())]
    with pytest.raises(FitError, match=r"loads dark frame 1 of the pair of 0\.2 s, found OSError: disk gone"):
        fit_noise(NoiseData(levels))


@pytest.mark.parametrize(("arguments", "kind"), [((5, None), "Noise"), ((None, 5), "NoiseRules")])
def test_arguments_of_another_kind_are_refused(arguments: tuple[Any, Any], kind: str) -> None:
    """They ended in an AttributeError, or in the result."""
    without_checks_of_types = inspect.unwrap(fit_noise)
    with pytest.raises(FitError, match=f"Expected a {kind}, found 5"):
        without_checks_of_types(NoiseData([]), *arguments)


def test_an_exposure_that_is_a_frame_is_refused() -> None:
    level = ExposureLevel(0.1, (FRAME, FRAME), (FRAME, FRAME))
    # What runs with types checked refuses it earlier.
    object.__setattr__(level, "exposure_s", FRAME)
    with pytest.raises(FitError, match=r"level 0 to have an exposure in seconds .* found uint16 of shape \(32, 32\)"):
        fit_noise(NoiseData([level]))


@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        ({"levels": None}, "sequence of exposure levels, found NoneType"),
        ({"levels": (level for level in [])}, "sequence of exposure levels, found generator"),
        ({"levels": ExposureLevel(0.1)}, "sequence of exposure levels, found ExposureLevel"),
        ({"levels": [FRAME]}, "every level as an ExposureLevel, found uint16"),
        ({"top_code": "4095"}, "top_code as a whole number from 1 to 65535, found '4095'"),
        ({"top_code": float("nan")}, "found nan"),
        ({"top_code": 1e9}, "found 1000000000.0"),
        ({"top_code": True}, "found True"),
        ({"top_code": 70_000}, "found 70000"),
    ],
)
def test_data_of_another_kind_are_refused(changed: dict[str, Any], sentence: str) -> None:
    data = NoiseData([ExposureLevel(0.1, (FRAME, FRAME), (FRAME, FRAME))])
    for name, value in changed.items():
        object.__setattr__(data, name, value)
    with pytest.raises(FitError, match=sentence):
        fit_noise(data)


@pytest.mark.parametrize(
    ("name", "value", "sentence"),
    [
        ("exposure_s", True, "level 0 to have an exposure in seconds .* found True"),
        ("photons", True, "level 0 to have a number of photons .* found True"),
        ("dark", None, "dark frames of level 0 as a sequence, found NoneType"),
        ("bright", (frame for frame in [FRAME]), "bright frames of level 0 as a sequence, found generator"),
    ],
)
def test_a_level_of_another_kind_is_refused(name: str, value: Any, sentence: str) -> None:
    level = ExposureLevel(0.1, (FRAME, FRAME), (FRAME, FRAME))
    object.__setattr__(level, name, value)
    with pytest.raises(FitError, match=sentence):
        fit_noise(NoiseData([level]))


def test_pairs_may_be_arrays() -> None:
    levels, stack = capture(PLAIN, 3)
    stacked = [replace(of, dark=np.stack(list(of.dark)), bright=np.stack(list(of.bright))) for of in levels]
    alike = [fit_noise(NoiseData(these, stack, top_code=4095)) for these in (levels, stacked)]
    assert [one.value for one in alike[0].estimates] == [one.value for one in alike[1].estimates]


def test_nothing_at_all_is_too_few() -> None:
    assert fit_noise(NoiseData([])).status is FitStatus.TOO_FEW_DATA


# A failing example is shown as drawn: to shrink it would take hundreds of fits.
def _examples(count: int) -> settings:
    return settings(
        max_examples=count,
        phases=(Phase.explicit, Phase.generate),
        suppress_health_check=list(HealthCheck),
    )


_ANY_SENSOR = given(
    K=st.floats(-1.3, 1.3),
    bits=st.sampled_from([8, 10, 12, 14, 16]),
    read_e=st.one_of(st.just(0.0), st.floats(0.3, 30.0)),
    black=st.floats(0.0, 0.1),
    top=st.floats(-3.5, 0.5),
    row=st.one_of(st.just(0.0), st.floats(0.05, 1.0)),
    dark=st.one_of(st.just(0.0), st.floats(1.0, 300.0)),
    bend=st.sampled_from([0.0, 0.0, 0.03, -0.03]),
    flicker=st.sampled_from([0.0, 0.0, 0.003, 0.03]),
    seed=st.integers(0, 10_000),
)


# Much noise, cut off at code 0, on few pixels: chance, not rounding, decides how well offsets are known.
@example(
    K=0.78, bits=16, read_e=24.4, black=0.0006, top=0.11, row=0.85, dark=1.5, bend=0.03, flicker=0.0, seed=200
)  # fmt: skip
# No dark noise at all.
@example(
    K=0.36, bits=10, read_e=0.0, black=0.1, top=0.053342991926067285, row=0.0, dark=0.0, bend=0.0, flicker=0.03,
    seed=3381,
)  # fmt: skip
# None either: rounding is the same in every frame, under offsets of several codes.
@example(
    K=0.35, bits=10, read_e=0.0, black=0.1, top=0.053342991926067285, row=0.0, dark=0.0, bend=0.0, flicker=0.03,
    seed=3382,
)  # fmt: skip
@_examples(3)
@_ANY_SENSOR
@pytest.mark.medium
def test_any_sensor_gives_a_result_within_its_error_or_a_status(**numbers: Any) -> None:
    _within_its_error_or_a_status(**numbers)


@pytest.mark.slow
@_examples(40)
@_ANY_SENSOR
def test_any_of_many_sensors_gives_a_result_within_its_error_or_a_status(**numbers: Any) -> None:
    _within_its_error_or_a_status(**numbers)


def _within_its_error_or_a_status(
    K: float, bits: int, read_e: float, black: float, top: float, row: float, dark: float, bend: float,
    flicker: float, seed: int,
) -> None:  # fmt: skip
    gain, codes = 10**K, 2.0**bits - 1
    well = max(0.9 * codes * (1 - black) / gain, 5.0)
    sensor = replace(
        PLAIN, rows=64, columns=64, K_DN_per_e=gain, bits=bits, read_e=read_e, black_DN=black * codes, full_well_e=well,
        row_DN=row * gain, dark_e_per_s=dark, bend=bend, flicker=flicker, flux_e_per_s=well / 0.2,
        levels=tuple(10**top * np.linspace(0.05, 1, 7)), stack_level=0.5 * 10**top, stack_frames=4,
    )  # fmt: skip
    result = measure(sensor, seed)
    numbers = np.array([[e.value, e.sigma] for e in result.estimates])
    assert np.isfinite(numbers).all()
    assert np.isfinite(result.cov).all()
    if result.status is FitStatus.CONVERGED:
        assert np.abs(errors_in_sigma(result, sensor)).max() < 5.5, errors_in_sigma(result, sensor)
    else:
        assert result.notes


def test_dark_frames_that_dark_current_fills_are_left_out() -> None:
    # 203 e-/s nearly fill 160 e- in the two longest of six dark exposures. Kept, they double DSNU: 17 sigma off.
    sensor = replace(
        PLAIN, rows=64, columns=64, K_DN_per_e=5.4, bits=10, read_e=2.9, black_DN=64.0, full_well_e=160.0,
        dark_e_per_s=203.0, flux_e_per_s=800.0, stack_frames=4,
    )  # fmt: skip
    result = measure(sensor, 21)
    assert any("dark exposures are left out" in note for note in result.notes)
    assert np.abs(errors_in_sigma(result, sensor)).max() < 4.5


@pytest.mark.medium
def test_a_dark_current_that_is_left_out_may_be_there_by_its_sigma() -> None:
    """Where it is too weak to be asked for, its sigma is not that of a fit that has it."""
    sensor, lost = replace(PLAIN, dark_e_per_s=0.28), 0
    for seed in range(12):
        found = measure(sensor, 400 + seed).estimate("dark_current_e_per_s")
        assert abs(found.value - 0.28) < 2.5 * found.sigma
        lost += found.value == 0
    assert 3 <= lost <= 11
