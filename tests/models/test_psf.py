"""The psf model against brute force, against the simulator's wave optics, and against itself."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.scenes.psf import light_on_lattice
from udccal.models import psf
from udccal.models.diffraction import (
    Diffraction,
    disc_autocorrelation,
    local_frame,
    opening_overlaps,
)
from udccal.models.fields import polynomial_basis, polynomial_terms
from udccal.models.geometry import Geometry
from udccal.models.interference import disc_overlap_coefficient
from udccal.models.lattice import lattice_for, sample, spline_coefficients
from udccal.models.psf import PsfField, psf_kernels, residual_kernel
from udccal.models.slits import Slits, slit_coefficients, window_overlap
from udccal.numerics import in_float64
from udccal.rig import load_rig
from udccal.simulation.psf import kernels as simulated_kernels
from udccal.simulation.spectrum import camera_spectrum
from udccal.simulation.truth import RigTruth, draw_truth

ROWS, COLUMNS = 49, 25
GREEN_NM = np.array([550.0, 550.0 + 1e-6])
Pair = tuple[float, float]


def as_numpy(function: Callable[..., object]) -> Callable[..., np.ndarray]:
    return in_float64(lambda *args: np.asarray(function(*args)))


def true_field(truth: RigTruth) -> PsfField:
    """The model with the simulator's own numbers."""
    optics, panel, spectrum = truth.optics, truth.panel, camera_spectrum(truth)
    geometry = Geometry(
        focal_px=np.array([optics.fx_px, optics.fy_px]),
        principal_point_px=np.array([optics.cx_px, optics.cy_px]),
        distortion=np.array(optics.distortion),
        rotation_rad=Rotation.from_matrix(optics.R_panel_camera).as_rotvec(),
        pupil_mm=optics.pupil_mm,
    )
    diffraction = Diffraction(
        pitch_mm=np.float64(panel.pitch_mm),
        openings=np.array([panel.column_open, panel.row_open]),
        depth_mm=np.float64(panel.depth_mm),
        depth_ratio=np.float64(0.0),
        bar_width=np.zeros(2),
        bar_place=np.zeros(2),
        corner_radius=np.float64(0.0),
        slant=np.zeros(2),
        pupil_diameter_mm=np.float64(optics.pupil_diameter_mm),
        blur_px=np.float64(0.0),
        blur_growth=np.zeros(2),
        blur_colour=np.zeros(3),
        offset_periods=optics.pupil_mm[:2] / panel.pitch_mm,
        standoff_per_pitch=np.float64((panel.depth_mm / 2 - optics.pupil_mm[2]) / panel.pitch_mm),
        visibility=np.float64(1.0),
        wavelengths_nm=spectrum.wavelengths_nm,
        spectrum=spectrum.weights,
    )
    return PsfField(
        geometry=geometry,
        diffraction=diffraction,
        diffraction_fraction=np.float64(1.0),
        residual=np.zeros((1, 3, 1, 1)),
        centre_px=np.array([511.5, 383.5]),
        half_px=np.array([511.5, 383.5]),
        support_px=np.array([1024.0, 768.0]),
        degree=0,
        fine=14,
    )


@pytest.fixture(scope="module")
def truth() -> RigTruth:
    return draw_truth(load_rig("lg55-reduced"), seed=1)


@pytest.mark.parametrize("lag", [0.1, 0.8, 1.05, 2.3, -1.2])
@pytest.mark.parametrize("order", [1, 2])
def test_slits_against_a_sum(lag: float, order: int) -> None:
    y = (np.arange(20000) + 0.5) / 20000
    opened = 0.7

    def open_at(place: np.ndarray) -> np.ndarray:
        return np.abs((place + 0.5) % 1 - 0.5) < opened / 2

    both = open_at(y + lag / 2) & open_at(y - lag / 2)
    expected = (both * np.cos(2 * np.pi * order * y)).mean() / opened
    assert as_numpy(slit_coefficients)(np.array([lag]), opened, 3)[order - 1, 0] == pytest.approx(expected, abs=3e-4)


@pytest.mark.parametrize("lag", [0.0, 0.1, 0.31, 0.8, 1.05, -1.2])
@pytest.mark.parametrize(("width", "place"), [(0.0, 0.1), (0.04, 0.1), (0.2, -0.25), (0.05, 0.0)])
def test_slits_with_a_bar_against_a_sum(lag: float, width: float, place: float) -> None:
    y, opened = (np.arange(20000) + 0.5) / 20000, 0.7

    def open_at(at: np.ndarray) -> np.ndarray:
        away = (at + 0.5) % 1 - 0.5
        return (np.abs(away) < opened / 2) & ~(np.abs(away - place) < width / 2)

    expected = (open_at(y + lag) & open_at(y)).mean() / (opened - width)
    found = as_numpy(overlap_at)((lag, 0.0), (opened, 1.0), (width, 0.0), (place, 0.0), 0.0)
    assert found == pytest.approx(expected, abs=4e-4)


def overlap_at(lag: Pair, opened: Pair, width: Pair, place: Pair, corner: float, slant: Pair = (0.0, 0.0)) -> jax.Array:
    """Of openings at a lag of (columns, rows), of green light alone."""
    slits = Slits(*(jnp.array(part) for part in (opened, width, place, (corner, corner), slant)))
    model = true_field(draw_truth(load_rig("lg55-reduced"), seed=1)).diffraction
    model = replace(model, wavelengths_nm=GREEN_NM, spectrum=np.ones((3, 2)))
    per_period, shaped = model.pitch_mm / (GREEN_NM[0] * 1e-6), max(corner, *slant) > 0
    columns, rows = opening_overlaps(model, slits, *(jnp.array([part * per_period]) for part in lag), shaped)
    return jnp.sum(columns[:, 0, 0] * rows[:, 0, 0]) / slits.open_part(shaped)


_LAGS = [(0.0, 0.0), (0.1, 0.05), (0.2, 0.31), (-0.3, 0.8), (1.4, 0.02), (2.9, 2.95)]


@pytest.mark.medium
@pytest.mark.parametrize("lag", _LAGS)
@pytest.mark.parametrize(("width", "place"), [(0.0, 0.0), (0.05, 0.1), (0.06, 0.16)])
def test_openings_with_round_corners_against_a_sum(lag: Pair, width: float, place: float) -> None:
    opened, corner = (0.8, 0.4), 0.15
    across, down = (part / 2 - corner for part in opened)

    def open_at(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        inside, bar = (np.abs(x) < opened[0] / 2) & (np.abs(y) < opened[1] / 2), np.abs(y - place) < width / 2
        away = np.hypot(np.maximum(np.abs(x) - across, 0.0), np.maximum(np.abs(y) - down, 0.0))
        return inside & ~bar & (away < corner)

    expected = summed(open_at, lag)
    found, square = (as_numpy(overlap_at)(lag, opened, (0.0, width), (0.0, place), at) for at in (corner, 0.0))
    assert found == pytest.approx(expected, abs=3e-3)
    assert abs(square - expected) > 4e-3 or max(expected, 1.0 - expected) > 0.999  # that the comparison can fail


@pytest.mark.medium
@pytest.mark.parametrize("lag", _LAGS)
@pytest.mark.parametrize("axis", [0, 1])
def test_openings_wider_at_one_end_against_a_sum(lag: Pair, axis: int) -> None:
    opened, slant = ((0.4, 0.8) if axis == 0 else (0.8, 0.4)), 0.12

    def open_at(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        across, along = (x, y) if axis == 0 else (y, x)
        wide = opened[axis] / 2 + slant * along / opened[1 - axis]
        return (np.abs(across) < wide) & (np.abs(along) < opened[1 - axis] / 2)

    expected, none = summed(open_at, lag), (0.0, 0.0)
    slants = (slant, 0.0) if axis == 0 else (0.0, slant)
    found, plain = (as_numpy(overlap_at)(lag, opened, none, none, 0.0, of) for of in (slants, none))
    assert found == pytest.approx(expected, abs=3e-3)
    assert abs(found - expected) < 0.3 * abs(plain - expected) or abs(plain - expected) < 3e-3


def summed(open_at: Callable[[np.ndarray, np.ndarray], np.ndarray], lag: Pair) -> float:
    """The open part times itself moved, of what is open at places in a period, whose middle is the opening's."""
    axis = (np.arange(1000) + 0.5) / 1000
    here, there = (
        open_at(*((at + 0.5) % 1 - 0.5 for at in np.meshgrid(axis + move[0], axis + move[1])))
        for move in ((0.0, 0.0), lag)
    )
    return float((here & there).mean() / here.mean())


@pytest.mark.parametrize("spread", [1e-9, 0.02, 0.3, 0.9])
def test_an_overlap_of_windows_is_averaged_over_the_spread(spread: float) -> None:
    apart, shift = np.linspace(-1.3, 2.6, 40), spread * (np.arange(-199, 200) / 200)
    triangle = (1 - np.abs(shift) / spread) / 200

    def overlap(one: float, other: float, apart: np.ndarray) -> np.ndarray:
        nearer = np.abs(apart - np.round(apart))
        return sum(np.clip((one + other) / 2 - away, 0.0, min(one, other)) for away in (nearer, 1 - nearer))

    for one, other in ((0.7, 0.3), (0.9, 0.8), (0.4, 0.0)):
        expected = overlap(one, other, apart[:, None] + shift) @ triangle
        found = as_numpy(lambda *parts: window_overlap(*map(jnp.asarray, parts)))(
            np.full(40, one), np.full(40, other), apart, np.full(40, spread)
        )
        np.testing.assert_allclose(found, expected, atol=1e-4)


@pytest.mark.parametrize(
    ("lag", "wave"), [((0.0, 0.0), (0.3, 5.1)), ((0.2, 0.35), (0.4, 3.0)), ((-0.5, 0.1), (5.0, 5.0))]
)
@pytest.mark.medium
def test_overlap_of_discs_against_a_sum(lag: tuple[float, float], wave: tuple[float, float]) -> None:
    axis = (np.arange(1500) + 0.5) / 1500 - 0.5
    x, y = np.meshgrid(axis, axis)
    inside = [(x + s * lag[0] / 2) ** 2 + (y + s * lag[1] / 2) ** 2 < 0.25 for s in (1, -1)]
    both = inside[0] & inside[1]
    scale = 4 / np.pi / 1500**2
    expected = (both * np.cos(2 * np.pi * (wave[0] * x + wave[1] * y))).sum() * scale
    found = as_numpy(disc_overlap_coefficient)(np.array([lag]), np.array(wave))[0]
    assert found == pytest.approx(expected, abs=2e-4)
    area = as_numpy(disc_autocorrelation)(np.array([np.hypot(*lag)]))[0]
    assert area == pytest.approx(both.sum() * scale, abs=1e-3)


@pytest.mark.medium
def test_a_lattice_gives_back_what_its_transfer_says() -> None:
    def value(points: np.ndarray) -> jnp.ndarray:
        lattice = lattice_for(48.0, 40.0, 3, 4)
        fy, fx = lattice.frequency_y[:, None], lattice.frequency_x[None, :]
        transfer = jnp.exp(-2 * np.pi**2 * (0.9**2 * fx**2 + 1.3**2 * fy**2))[None]
        return sample(lattice, spline_coefficients(lattice, transfer), jnp.asarray(points))[:, 0]

    points = np.random.default_rng(0).uniform(-4, 4, (200, 2))
    expected = np.exp(-0.5 * ((points[:, 0] / 0.9) ** 2 + (points[:, 1] / 1.3) ** 2)) / (2 * np.pi * 0.9 * 1.3)
    np.testing.assert_allclose(as_numpy(value)(points), expected, atol=0.04 * expected.max())
    np.testing.assert_array_equal(as_numpy(value)(np.array([[30.0, 0.0]])), 0.0)


def test_numpy_evaluates_a_lattice_as_jax_does() -> None:
    rng, lattice = np.random.default_rng(0), lattice_for(20.0, 12.0, 3, 4)
    coefficients = rng.normal(size=(lattice.rows, lattice.columns, 2))
    points = rng.uniform(-11, 11, (300, 2))
    compiled = as_numpy(lambda at: sample(lattice, jnp.asarray(coefficients), at))(points)
    np.testing.assert_allclose(sample(lattice, coefficients, points), compiled, rtol=1e-9, atol=1e-12)
    assert np.abs(sample(lattice, coefficients, points + 0.1) - compiled).max() > 0.1


def test_polynomials_are_counted_and_start_with_one() -> None:
    unit = np.array([[0.2, -0.4], [1.0, 1.0]])
    basis = as_numpy(lambda u: polynomial_basis(u, 2))(unit)
    assert basis.shape == (2, polynomial_terms(2)) == (2, 6)
    np.testing.assert_allclose(basis[:, 0], 1.0)
    np.testing.assert_allclose(basis[1], 1.0)
    assert polynomial_terms(-1) == 0


@pytest.mark.medium
def test_kernels_agree_with_wave_optics(truth: RigTruth) -> None:
    positions = np.array([[512.0, 384.0], [940.0, 715.0]])
    field = true_field(truth)
    expected = simulated_kernels(truth, positions, ROWS, COLUMNS)
    found = as_numpy(lambda p: psf_kernels(field, p, ROWS, COLUMNS))(positions)
    np.testing.assert_allclose(found.sum(axis=(2, 3)), 1.0, atol=1e-9)
    assert relative_l2(found, expected).max() < 0.008
    bright = expected > 1e-3 * expected.max(axis=(2, 3), keepdims=True)
    assert np.sqrt((((found - expected) / expected)[bright] ** 2).mean()) < 0.065
    wrong = replace(field, diffraction=replace(field.diffraction, openings=np.array([0.94, 0.5])))
    assert relative_l2(as_numpy(lambda p: psf_kernels(wrong, p, ROWS, COLUMNS))(positions), expected).min() > 0.05


@pytest.mark.medium
def test_kernels_are_those_of_one_fine_lattice(truth: RigTruth, monkeypatch: pytest.MonkeyPatch) -> None:
    l2, beside = kernel_errors(truth)
    assert l2 < 0.003
    assert beside < 0.015
    # Too few nodes for the band that they carry.
    monkeypatch.setattr(psf, "_BAND", (0.8, 1.3))
    monkeypatch.setattr(psf, "_COARSE", 3)
    assert kernel_errors(truth)[1] > 0.04


@in_float64
def kernel_errors(truth: RigTruth) -> tuple[float, float]:
    """Relative L2 error of a kernel, and RMS of its relative error where it is between 0.3 and 10 % of its peak."""
    field = true_field(truth)
    model, geometry, lattice = field.diffraction, field.geometry, lattice_for(1.25 * ROWS, 1.6 * COLUMNS, 14, 14)
    y, x = np.mgrid[:ROWS, :COLUMNS] - np.array([ROWS // 2, COLUMNS // 2])[:, None, None]
    offsets = jnp.stack([x.ravel(), y.ravel()], axis=-1) * 1.0

    def kernel(place: jax.Array) -> jax.Array:
        return psf.diffraction_kernel(model, geometry, place, ROWS, COLUMNS, field.fine, False)

    place = jnp.array([300.0, 130.0])
    found = np.asarray(jax.jit(kernel)(place))
    light = light_on_lattice(model, geometry, place, offsets, lattice, shaped=False, disc_px=0.0)
    wanted = np.asarray(light).T.reshape(found.shape)
    part = wanted / wanted.max(axis=(1, 2), keepdims=True)
    beside = (part > 0.003) & (part < 0.1)
    errors = relative_l2(found[None], wanted[None]).max(), np.sqrt(((found / wanted - 1.0)[beside] ** 2).mean())
    return float(errors[0]), float(errors[1])


def relative_l2(found: np.ndarray, expected: np.ndarray) -> np.ndarray:
    return np.sqrt(((found - expected) ** 2).sum(axis=(2, 3)) / (expected**2).sum(axis=(2, 3)))


def test_the_residual_follows_its_polynomial_and_is_cut_or_padded(truth: RigTruth) -> None:
    residual = np.zeros((3, 3, 5, 5))
    residual[0, :, 2, 2] = 1.0
    residual[1, :, 2, 4] = 0.5
    field = replace(true_field(truth), residual=residual, degree=1)

    @as_numpy
    def images(size: int) -> jnp.ndarray:
        return jnp.stack([residual_kernel(field, jnp.asarray(place), size, size) for place in places])

    places = np.array([[511.5, 383.5], [511.5, 767.0], [1023.0, 383.5]])
    first_order = as_numpy(lambda p: polynomial_basis((p - field.centre_px) / field.half_px, 1))(places)[:, 1]
    wide = images(7)
    np.testing.assert_allclose(wide[:, 0, 3, 5], 0.5 * first_order, atol=1e-12)
    np.testing.assert_allclose(wide[:, 0, 3, 3], 1.0, atol=1e-12)
    np.testing.assert_array_equal(images(3), wide[:, :, 2:5, 2:5])


@pytest.mark.medium
def test_the_footprint_grows_with_obliquity(truth: RigTruth) -> None:
    geometry = true_field(truth).geometry

    def area(place: np.ndarray) -> jnp.ndarray:
        frame = local_frame(geometry, place)
        axis = jnp.linalg.inv(frame.footprint)
        return jnp.abs(1.0 / jnp.linalg.det(axis)) * frame.direction[2]

    # Light through the panel's openings is the same tube that enters the pupil: area times cosine is the pupil's own.
    centre, corner = np.array([511.5, 383.5]), np.array([1000.0, 740.0])
    towards = as_numpy(lambda p: local_frame(geometry, p).direction)
    axis = truth.optics.R_panel_camera[:, 2]
    for place in (centre, corner):
        assert as_numpy(area)(place) == pytest.approx(abs(float(towards(place) @ axis)), rel=1e-6)
