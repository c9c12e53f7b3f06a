"""Error bars of the kernel where no LED was, on a rig whose truth no candidate of the fit can be."""

from __future__ import annotations

import numpy as np
import pytest

from tests.scenes.psf_wave_optics import COVERED, coverage
from udccal.fitting.psf.data import PsfRules
from udccal.fitting.psf.held_out import KernelError, estimate_kernel_error, stated_error

SIZES = np.geomspace(1e-5, 1.0, 4000)
# Of each size some, so that no sample decides its picture's light.
PICTURES = np.arange(4000) % 50


def residuals(error: KernelError, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Noise of 0.3 % at the peak and less below, with an error of the kernel."""
    variance = 1e-5 * SIZES + 1e-13
    return np.sqrt(variance + error.of_peak(SIZES) ** 2) * rng.standard_normal(SIZES.size), variance


@pytest.mark.parametrize(
    "true", [KernelError(0.01, 0.3, 0.75), KernelError(0.03, 1.0, 0.6), KernelError(0.1, 0.1, 0.9)]
)
def test_the_error_of_a_kernel_is_found_as_large_as_it_is(true: KernelError) -> None:
    residual, variance = residuals(true, np.random.default_rng(1))
    found = estimate_kernel_error(residual, variance, SIZES, PICTURES, PsfRules())
    for size in (1e-3, 1e-2, 0.1):
        assert found.of_peak(np.array([size]))[0] == pytest.approx(true.of_peak(np.array([size]))[0], rel=0.2)


@pytest.mark.medium
def test_noise_is_no_error_of_the_kernel() -> None:
    rng = np.random.default_rng(2)
    found = [estimate_kernel_error(*residuals(KernelError(0.0), rng), SIZES, PICTURES, PsfRules()) for _ in range(20)]
    assert sum(error.size > 0 for error in found) <= 1


def test_light_that_follows_the_brightest_sample_does_not_hide_its_error() -> None:
    """Pictures with one bright sample each, whose own light fits that sample."""
    rng, true = np.random.default_rng(5), KernelError(0.03, 1.0, 0.8)
    light = np.tile([1.0, *np.geomspace(1e-4, 0.03, 40)], (60, 1))
    off = rng.standard_normal(light.shape) * true.of_peak(light)
    off -= light * ((off * light).sum(axis=1) / (light**2).sum(axis=1))[:, None]
    assert np.abs(off[:, 0]).max() < 0.1 * true.of_peak(np.ones(1))[0]
    picture = np.broadcast_to(np.arange(60)[:, None], light.shape).ravel()
    found = estimate_kernel_error(off.ravel(), np.full(light.size, 1e-14), light.ravel(), picture, PsfRules())
    assert found.of_peak(np.ones(1))[0] == pytest.approx(true.of_peak(np.ones(1))[0], rel=0.4)


def test_faint_samples_do_not_decide_the_error_of_the_bright_ones() -> None:
    """Far from the source the kernel is as wrong as it is large, in most samples; near it, in two hundred."""
    rng, true = np.random.default_rng(6), KernelError(0.02, 0.5, 0.7)
    light = np.concatenate([np.geomspace(1e-2, 1.0, 200), np.geomspace(1e-6, 1e-3, 20000)])
    off = rng.standard_normal(light.size) * np.where(light > 2e-3, true.of_peak(light), light)
    found = estimate_kernel_error(off, np.full(light.size, 1e-18), light, np.arange(light.size) % 20, PsfRules())
    assert found.of_peak(np.array([0.3]))[0] == pytest.approx(true.of_peak(np.array([0.3]))[0], rel=0.4)


def test_hits_are_no_error_of_the_kernel() -> None:
    true = KernelError(0.01, 0.3, 0.75)
    residual, variance = residuals(true, np.random.default_rng(3))
    residual[::400] += 0.5
    found = estimate_kernel_error(residual, variance, SIZES, PICTURES, PsfRules())
    assert found.of_peak(np.array([1e-2]))[0] == pytest.approx(true.of_peak(np.array([1e-2]))[0], rel=0.4)


@pytest.mark.parametrize("error", [KernelError(0.01, 0.3, 0.75), KernelError(0.0)])
def test_the_stated_error_has_the_size_of_both_its_parts(error: KernelError) -> None:
    magnitude = np.random.default_rng(4).random((3, 21, 11)) ** 6
    stated = stated_error(error, 0.004, magnitude, PsfRules())
    wanted = np.hypot(error.relative_l2(magnitude).mean(), 0.004)
    assert float(stated.relative_l2(magnitude).mean()) == pytest.approx(wanted)
    assert (stated.knee, stated.power) == (0.3, 0.75)


def test_an_error_is_in_the_unit_of_its_kernels() -> None:
    error = KernelError(0.02, 1.0, 0.5)
    kernel = np.array([[[1.0, 4.0], [0.0, 16.0]]])
    part = kernel / 16.0
    np.testing.assert_allclose(error.of_kernels(kernel), 16.0 * 0.02 * np.sqrt(part / (1 + part)))
    wanted = np.sqrt((error.of_kernels(kernel) ** 2).sum() / (kernel**2).sum())
    np.testing.assert_allclose(error.relative_l2(kernel), wanted)
    lit = part[part > 0]
    rms = np.sqrt(np.mean((0.02 * np.sqrt(lit / (1 + lit)) / lit) ** 2))
    # A sample that is a hundred-thousandth of the peak does not count; one of a thousandth does.
    for faint, least, most in ((1.6e-4, 0.999, 1.001), (1.6e-2, 2.0, 100.0)):
        kernel[0, 1, 0] = faint
        assert least * rms < error.relative_rms(kernel) < most * rms


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_the_stated_interval_covers_the_kernel_of_wave_optics(seed: int) -> None:
    found = coverage(seed)
    assert found.covered >= COVERED
    # Neither too small, nor so large that it would cover anything.
    assert 0.6 <= found.stated / found.found <= 1.7
    assert found.pattern_p < 1e-3
