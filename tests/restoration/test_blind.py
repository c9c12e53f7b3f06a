from __future__ import annotations

import pickle

import numpy as np
import pytest

from udccal.cfa import Cfa, cfa_named
from udccal.models.noise import Noise
from udccal.restoration.blind import BlindSamples

EXPOSURE_S = 0.01
SHAPE = (40, 48)


def light() -> np.ndarray:
    """In e-: a slanted plane with another brightness at each site."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    return np.asarray(2000.0 + 20 * y + 10 * x + 700 * (y % 2) + 300 * (x % 2))


def in_DN(signal_e: np.ndarray) -> np.ndarray:
    return np.clip(np.rint(64 + 0.355 * (signal_e + 0.05)), 0, 3969).astype(np.uint16)


@pytest.mark.parametrize("rows", [slice(10, 11), slice(10, 14), slice(0, 3), slice(38, 40)])
def test_blind_rows_are_interpolated_between_rows_of_their_site(toy_noise: Noise, rows: slice) -> None:
    wire = 1 + 0.1 * np.sin(np.arange(SHAPE[0]) / 3)[:, None] * np.ones(SHAPE)
    wire[rows] = 0.015
    blind = BlindSamples.of(wire.astype(np.float32), SHAPE, cfa_named("RGGB"), toy_noise)
    assert blind.wire is not None
    mended = blind.mended(in_DN(light() * wire), EXPOSURE_S)
    found = (mended - 64.0) / 0.355 / blind.wire
    # At the border there is one neighbour alone, up to 4 rows away.
    np.testing.assert_allclose(found, light(), atol=5 if rows.start == 10 else 85)


def test_a_column_without_light_takes_its_neighbour(toy_noise: Noise) -> None:
    wire = np.ones(SHAPE, np.float32)
    wire[:, 20] = 1e-4
    blind = BlindSamples.of(wire, SHAPE, cfa_named("RGGB"), toy_noise)
    mended = blind.mended(in_DN(light() * wire), EXPOSURE_S)
    np.testing.assert_array_equal(mended[:, 20], in_DN(light())[:, 18])


def test_a_wire_of_3_percent_is_believed(toy_noise: Noise) -> None:
    wire = np.ones(SHAPE, np.float32)
    wire[10:14] = 0.03
    blind = BlindSamples.of(wire, SHAPE, cfa_named("RGGB"), toy_noise)
    frame = in_DN(light() * wire)
    assert not blind.blind.any()
    assert blind.wire is wire
    # The rows are that dark because of the wire, as it says.
    np.testing.assert_array_equal(blind.mended(frame, EXPOSURE_S), frame)


@pytest.mark.parametrize("cfa", [cfa_named("RGGB"), cfa_named("mono")], ids=lambda cfa: cfa.name)
@pytest.mark.parametrize("count", [1, 2, 4])
def test_dead_rows_of_the_sensor_are_found_in_the_frame(toy_noise: Noise, cfa: Cfa, count: int) -> None:
    frame = in_DN(np.random.default_rng(2).normal(light(), 50.0))
    dead = frame.copy()
    dead[20 : 20 + count] = np.random.default_rng(3).integers(62, 67, (count, SHAPE[1]))
    mended = BlindSamples.of(None, SHAPE, cfa, toy_noise).mended(dead, EXPOSURE_S)
    at = np.zeros(SHAPE[0], dtype=bool)
    at[20 : 20 + count] = True
    np.testing.assert_array_equal(mended[~at], frame[~at])
    # Without colours, neighbours have the other brightness, too.
    step = 800 if cfa.name == "mono" else 100
    assert np.abs((mended[at].astype(float) - in_DN(light())[at]).mean(axis=1)).max() < 0.355 * step


@pytest.mark.parametrize("kind", ["no light", "a black band", "black below", "a dim row", "row noise"])
def test_rows_that_may_be_the_scene_stay(toy_noise: Noise, kind: str) -> None:
    scene, rng = light(), np.random.default_rng(5)
    if kind == "no light":
        scene[:] = 0.0
    elif kind == "a black band":
        scene[14:26] = 0.0
    elif kind == "black below":
        scene[20:] = 0.0
    elif kind == "a dim row":
        scene[20] *= 0.04
    else:  # sigma of a row is 2.8 e-
        scene = np.ones(SHAPE) * rng.normal(0.0, 2.8, (SHAPE[0], 1)) + 3.0
    frame = in_DN(rng.normal(scene, np.sqrt(np.maximum(scene, 0) + 25)))
    assert BlindSamples.of(None, SHAPE, cfa_named("RGGB"), toy_noise).mended(frame, EXPOSURE_S) is frame


def test_what_replaces_a_sample_beside_clipped_ones_clips(toy_noise: Noise) -> None:
    wire = np.ones(SHAPE, np.float32)
    wire[20] = 1e-3
    frame = in_DN(light() * wire)
    frame[18, 10] = 3969
    assert BlindSamples.of(wire, SHAPE, cfa_named("RGGB"), toy_noise).mended(frame, EXPOSURE_S)[20, 10] == 3969


def test_samples_that_have_mended_a_frame_can_be_pickled(toy_noise: Noise) -> None:
    frame = in_DN(light())
    frame[20] = 64
    blind = BlindSamples.of(None, SHAPE, cfa_named("RGGB"), toy_noise)
    mended = blind.mended(frame, EXPOSURE_S)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(blind)).mended(frame, EXPOSURE_S), mended)


def test_a_map_that_is_blind_all_over_is_left_alone(toy_noise: Noise) -> None:
    """Of one site nothing is left: there is nothing to take instead."""
    wire = np.ones(SHAPE, np.float32)
    wire[::2, ::2] = 1e-4
    frame = in_DN(light() * wire)
    mended = BlindSamples.of(wire, SHAPE, cfa_named("RGGB"), toy_noise).mended(frame, EXPOSURE_S)
    np.testing.assert_array_equal(mended, frame)
