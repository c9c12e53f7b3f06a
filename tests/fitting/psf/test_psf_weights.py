"""Weights of the psf fit: noise at the expected light, a model error estimated from residuals, outliers, patterns."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.scenes.psf import frames_of, small_scene
from udccal.fitting.hdr.merge import HdrMerge
from udccal.fitting.psf.data import PsfRules, Shots, estimate_model_error, left_out
from udccal.fitting.psf.diffraction import pattern_p_value, without_outliers
from udccal.fitting.psf.samples import Samples
from udccal.fitting.psf.start import choose_samples, cut_crop, shot_noise, stands_for
from udccal.models.diffraction import LocalFrame

SHOTS, SAMPLES = 6, 400


def samples_of(rate: np.ndarray, variance: np.ndarray, noise_per_rate: float = 0.0) -> Samples:
    """One position: samples on whole pixels, three colours in turn."""
    shots, samples = rate.shape
    x = np.arange(samples)
    points = np.broadcast_to(np.stack([x % 20, x // 20], axis=-1) * 1.0, (shots, samples, 2))
    frame = LocalFrame(jnp.array([0.0, 0.0, 1.0]), jnp.eye(2), jnp.eye(2), jnp.zeros(2))
    made = Samples(
        frame=frame,
        points=points,
        density=np.ones_like(rate),
        slope=np.eye(2),
        begun_px=np.zeros((shots, 2)),
        colour=np.broadcast_to(np.eye(3)[x % 3], (shots, samples, 3)),
        rate=rate,
        known=1.0 / variance,
        noise_per_rate=np.full_like(rate, noise_per_rate),
        weight=1.0 / variance,
        correction=np.zeros_like(rate),
        by_overlaps=np.zeros((*rate.shape, 2)),
        overlaps_at=np.ones(2),
        overlaps=np.zeros((0, 0, 0, 0)),
        disc_px=np.asarray(1.0),
        index=np.arange(shots),
    )
    return jax.tree.map(lambda part: part[None], made)


def light_of() -> np.ndarray:
    return np.tile(1e6 * np.exp(-np.arange(SAMPLES) / 60.0), (1, SHOTS, 1))


def noisy(rng: np.random.Generator, model_error: float = 0.0) -> tuple[np.ndarray, Samples]:
    light = light_of()
    sigma = np.hypot(np.hypot(0.005 * light, 30.0), left_out(light, model_error))
    noise = np.hypot(0.005 * light, 30.0) ** 2
    return light, samples_of((light + sigma * rng.standard_normal(light.shape))[0], noise[0])


@pytest.mark.parametrize("true", [0.003, 0.015, 0.08])
def test_a_model_error_is_found_as_large_as_it_is(true: float) -> None:
    light, samples = noisy(np.random.default_rng(1), true)
    residual = (np.asarray(samples.rate) - light).ravel()
    found = estimate_model_error(residual, 1 / np.asarray(samples.known).ravel(), left_out(light, 1.0).ravel(), 0)
    assert found == pytest.approx(true, rel=0.1)


def test_noise_is_not_taken_for_a_model_error() -> None:
    found = []
    for seed in range(40):
        light, samples = noisy(np.random.default_rng(seed))
        residual = (np.asarray(samples.rate) - light).ravel()
        variance = 1 / np.asarray(samples.known).ravel()
        found.append(estimate_model_error(residual, variance, left_out(light, 1.0).ravel(), 0))
    assert np.count_nonzero(found) <= 2


@settings(max_examples=60)
@given(
    scale=st.floats(1e-6, 1e6), spread=st.floats(0.0, 1e3), outlier=st.floats(-1e9, 1e9), parameters=st.integers(0, 50)
)
def test_the_model_error_is_always_a_number_within_bounds(
    scale: float, spread: float, outlier: float, parameters: int
) -> None:
    rng = np.random.default_rng(0)
    residual = scale * spread * rng.standard_normal(50)
    residual[0] += outlier
    share = scale * np.linspace(0.0, 1.0, 50)
    found = estimate_model_error(residual, np.full(50, scale**2), share, parameters)
    assert np.isfinite(found)
    assert 0.0 <= found <= 0.5


def test_variance_follows_the_expected_light_not_the_noisy_one() -> None:
    rate = np.array([[90.0, 110.0]])
    samples = samples_of(rate, (rate + 4.0) / 2.0, noise_per_rate=0.5)
    np.testing.assert_allclose(samples.sensor_variance(np.full((1, 1, 2), 100.0)), 52.0)
    np.testing.assert_allclose(samples.weighed(0.0, np.full((1, 1, 2), 100.0)).weight, 1 / 52.0)


def test_the_slope_of_the_variance_is_that_of_the_exposure() -> None:
    scene = small_scene()
    exposure, floor = 0.02, 25.0 + (1.0 / float(scene.noise.K_DN_per_e)) ** 2 / 12.0
    rate = np.array([[0.0, 1e3, 1e6]])
    sigma = np.sqrt(rate / exposure + floor / exposure**2)
    used = np.array([[1, 1, 0]])
    slope = shot_noise(HdrMerge(rate, sigma, used), scene.noise)
    np.testing.assert_allclose(slope, [[1 / exposure, 1 / exposure, 0.0]], rtol=1e-9)


def errors(samples: Samples, light: np.ndarray) -> np.ndarray:
    return (np.asarray(samples.rate) - light) * np.sqrt(np.asarray(samples.weight))


def test_a_cosmic_hit_and_a_picture_that_moved_are_left_out_and_listed() -> None:
    light, samples = noisy(np.random.default_rng(3))
    rate = np.array(samples.rate)
    rate[0, 1, 200] += 40 * np.sqrt(1 / np.asarray(samples.known)[0, 1, 200])
    rate[0, 4] = np.roll(rate[0, 4], 3)
    samples = replace(samples, rate=rate)
    kept, found = without_outliers(samples, errors(samples, light), PsfRules())
    pictures_out, samples_out = found
    assert pictures_out.places == ("picture 4 at position 0",)
    assert samples_out.count == 1
    assert samples_out.places == ("picture 1 at position 0, +40 sigma",)
    assert np.count_nonzero(np.asarray(kept.weight) == 0) == SAMPLES + 1


def test_good_pictures_all_stay() -> None:
    light, samples = noisy(np.random.default_rng(4))
    kept, found = without_outliers(samples, errors(samples, light), PsfRules())
    assert found == ()
    np.testing.assert_array_equal(kept.weight, samples.weight)


def test_noise_has_no_pattern_and_a_common_misfit_has_one() -> None:
    values = []
    for seed in range(60):
        light, samples = noisy(np.random.default_rng(seed))
        values.append(pattern_p_value(samples, errors(samples, light)))
    assert 0.3 < np.mean(values) < 0.7
    assert np.mean(np.array(values) < 0.05) < 0.2
    light, samples = noisy(np.random.default_rng(5))
    wave = 0.005 * light * np.sin(np.arange(SAMPLES) / 7.0)
    assert pattern_p_value(samples, errors(samples, light - wave)) < 1e-6


def test_samples_are_drawn_as_many_in_every_picture() -> None:
    rng = np.random.default_rng(0)
    rate = rng.uniform(1e3, 1e6, (3, 41, 21))
    zeros = np.zeros_like(rate)
    channel = np.zeros(rate.shape, dtype=np.int64)
    origin = np.zeros((3, 2), dtype=np.int64)
    shots = Shots(np.zeros((3, 2)), origin, np.arange(3), np.ones(3), rate, zeros + 1.0, channel, zeros)
    every, some = (
        choose_samples(shots, PsfRules(close_px=(18, 9), far_fraction=part)).sum(axis=(1, 2)) for part in (1.0, 0.2)
    )
    assert (every == 37 * 19).all()
    assert len(set(some.tolist())) == 1
    assert some[0] < every[0]
    # Those drawn stand for the others of their own picture, to a whole number of them.
    chosen, count = choose_samples(shots, PsfRules()), stands_for(shots, PsfRules())
    far = np.abs(shots.offsets()[..., 0])[None].repeat(3, axis=0)[chosen].reshape(3, -1) > PsfRules().peak_half_px[1]
    assert count[far] == pytest.approx(6.0)
    assert (count == 1.0).any(axis=1).all()
    assert count.sum(axis=1) == pytest.approx(choose_samples(shots, PsfRules(far_fraction=1.0)).sum(axis=(1, 2)), abs=6)


def test_brackets_are_clipped_and_quantised() -> None:
    scene = small_scene()
    frames = frames_of(scene, np.array([[0.0, 9e6]]), np.random.default_rng(0))
    assert frames.shape == (6, 1, 2)
    assert (frames[1:, 0, 1] == scene.rig.saturation_DN).all()
    assert abs(float(frames[0, 0, 0]) - float(scene.noise.black_DN)) < 12


def test_samples_that_rounding_moves_alike_have_no_weight() -> None:
    rows, columns = np.mgrid[:41, :41]
    light = 1e5 * np.exp(-0.5 * np.hypot(rows - 20, columns - 20) ** 2 / 4.0) + 50.0 * (columns > 30)
    ones = np.ones(light.shape)
    kept = []
    for below in (0.0, 40.0):
        merged = HdrMerge(light, ones, ones.astype(int), (), below)
        shots = cut_crop(merged, (0, 0), (20.0, 20.0), "mono", (20, 20), 1.0)
        assert shots is not None
        kept.append(shots.weight[0] > 0)
    assert kept[0].all()
    assert kept[1][light > 60].all()
    assert kept[1][:, 33:].all()
    assert not kept[1][:5, :25].any()
