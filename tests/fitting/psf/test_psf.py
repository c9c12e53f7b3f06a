"""The psf fit on a grating, on blur that has nothing to do with one, and on sessions that cannot be fitted."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from scipy.special import ndtr

from tests.scenes.psf_wave_optics import seen_by_the_wire
from udccal.cameras.protocol import CameraIdentity, Frame, Region, Settings
from udccal.cfa import cfa_named
from udccal.fitting.hdr.merge import HdrMerge
from udccal.fitting.noise.fit import nominal_noise
from udccal.fitting.nominal import absent_wire, nominal_geometry
from udccal.fitting.psf.data import PsfData, PsfRules, Shots, group, joined
from udccal.fitting.psf.fit import fit_psf
from udccal.fitting.psf.held_out import stated_by
from udccal.fitting.psf.image import shifts
from udccal.fitting.psf.start import cut_crop, read_psf, start_model, window_half
from udccal.models.psf import PsfField, psf_kernels
from udccal.numerics import in_float64
from udccal.reports.true_values import true_geometry
from udccal.result import FitResult, FitStatus
from udccal.rig import RigDescription, load_rig
from udccal.sessions.captured import SingleFrame
from udccal.sessions.schema import LedSubject
from udccal.sessions.store import Session
from udccal.sessions.writer import SessionWriter
from udccal.simulation.psf import captured_light
from udccal.simulation.psf import kernels as simulated_kernels
from udccal.simulation.truth import draw_truth

HALF = (14, 7)
SIZE = (41, 27)
MIDDLE = np.array([13, 20])
TOY = PsfRules(positions=5, shifts=2, half_px=HALF, close_px=(12, 6), iterations=25)
FLUX = 1e8 * np.array([0.7, 1.0, 0.6])


@dataclass(frozen=True)
class Fitted:
    result: FitResult[PsfField]
    worst_l2: float


def kernels(field: PsfField, positions: np.ndarray, rows: int, columns: int) -> np.ndarray:
    return in_float64(lambda: np.asarray(psf_kernels(field, positions, rows, columns)))()


def relative_l2(found: np.ndarray, expected: np.ndarray) -> np.ndarray:
    return np.sqrt(((found - expected) ** 2).sum(axis=(2, 3)) / (expected**2).sum(axis=(2, 3)))


def shots_of(light, rig: RigDescription, places: np.ndarray, shifts: int, disc_px: float, seed: int = 0) -> Shots:
    """Crops of LEDs about ``places``; ``light(x, y, middle)`` is the image of ``SIZE`` about an integer middle."""
    rng = np.random.default_rng(seed)
    crops, aims = [], []
    for place in places:
        for _ in range(shifts):
            aim = place + rng.uniform(0, 2, 2)
            source = aim + rng.uniform(-1, 1, 2)
            middle = np.round(aim)
            corner = (middle - MIDDLE) // 2 * 2
            image = light(source, corner + MIDDLE)
            channel = cfa_named(rig.camera.cfa).channel_map(*SIZE)
            rate = np.take_along_axis(image * FLUX[:, None, None], channel[None], axis=0)[0]
            sigma = np.hypot(0.003 * rate, 20.0)
            merged = HdrMerge(
                rate + sigma * rng.standard_normal(rate.shape), sigma, np.ones(rate.shape, dtype=np.int64)
            )
            at, aimed = tuple(int(v) for v in corner), tuple(float(v) for v in aim)
            crop = cut_crop(merged, at, aimed, rig.camera.cfa, HALF, disc_px)
            assert crop is not None
            crops.append(crop)
            aims.append(aim)
    return joined(crops, np.array(aims))


def places_on(rig: RigDescription, columns: int, rows: int) -> np.ndarray:
    x, y = (np.linspace(40, size - 40, n) for size, n in ((rig.camera.columns, columns), (rig.camera.rows, rows)))
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2).round()


@pytest.fixture(scope="module")
def grating() -> Fitted:
    truth = draw_truth(load_rig("lg55-reduced"), seed=1)
    rig, geometry = truth.description, true_geometry(truth)
    disc = 1.0

    def light(source: np.ndarray, middle: np.ndarray) -> np.ndarray:
        return captured_light(truth, middle.astype(float), *SIZE, tuple(source - middle), disc)

    shots = shots_of(light, rig, places_on(rig, 3, 3), 2, disc)
    result = fit_psf(PsfData(shots), rig, geometry, seen_by_the_wire(truth, geometry), TOY)
    places = np.array([[300.0, 240.0], [720.0, 610.0]])
    error = relative_l2(kernels(result.term, places, 41, 21), simulated_kernels(truth, places, 41, 21))
    return Fitted(result, float(error.max()))


@pytest.mark.medium
def test_a_grating_is_predicted_where_it_was_not_captured(grating: Fitted) -> None:
    assert grating.result.status is FitStatus.CONVERGED
    assert grating.worst_l2 < 0.03
    assert grating.result.estimate("row_open").value == pytest.approx(0.3917, abs=0.004)
    assert all(estimate.sigma > 0 for estimate in grating.result.estimates)
    assert grating.result.cov.shape == (12, 12)
    sigmas = [estimate.sigma for estimate in grating.result.estimates]
    np.testing.assert_allclose(np.sqrt(np.diag(grating.result.cov)), sigmas)
    # The rig file alone tells the pitch.
    assert grating.result.estimate("pitch_mm").by_prior
    assert not grating.result.estimate("row_open").by_prior
    # One of the wire's phase, one of the residual's orders, and how far light reaches along rows and along columns.
    assert [c.chosen for c in grating.result.candidates][:2] == [True, False]
    assert sum(candidate.chosen for candidate in grating.result.candidates) == 4
    # Light of a grating leaves windows this small: where the term has no end it is the sensor's size.
    np.testing.assert_array_equal(grating.result.term.support_px, [1024, 768])
    numbers = {d.name: d.value for d in grating.result.diagnostics}
    # The model has the lowest terms of the interference only: its strength is about 1, and far from 0.
    assert numbers["wire_phase_strength"] == pytest.approx(1.0, abs=0.4)
    assert 0.0 < numbers["efficiency"] <= 1.05
    # What noise alone would leave open is less than what the model's deviation does.
    for name in ("column_open", "row_open", "depth_mm", "pupil_diameter_mm"):
        assert 0.0 < numbers[f"noise_sigma_{name}"] < grating.result.estimate(name).sigma
    # Wave optics has more terms than the model: that is seen, said, and part of what the kernel is off by.
    assert numbers["residual_pattern_p"] < 1e-3
    assert any("have a pattern" in note and "clear part, rows;" in note for note in grating.result.notes)
    assert 0.3 < numbers["kernel_error_l2"] / grating.worst_l2 < 2.0
    assert grating.result.chi2_dof == pytest.approx(1.0, abs=0.15)


@pytest.mark.medium
def test_the_posterior_knows_the_numbers_and_what_the_kernel_is_off_by(grating: Fitted) -> None:
    result = grating.result
    for estimate, of in (
        (result.estimate("pitch_mm"), lambda term: term.diffraction.pitch_mm),
        (result.estimate("row_open"), lambda term: term.diffraction.openings[1]),
        (result.estimate("pupil_diameter_mm"), lambda term: term.diffraction.pupil_diameter_mm),
        (result.estimate("blur_px"), lambda term: term.diffraction.blur_px),
    ):
        assert float(result.sigma_of(of)) == pytest.approx(estimate.sigma, rel=0.02)
    # Found at positions held out, it is part of every kernel's sigma, and of what may be drawn.
    off = result.sigma_of(lambda term: term.residual[0, 1])
    brightest = np.unravel_index(off.argmax(), off.shape)
    assert np.abs(np.subtract(brightest, np.array(off.shape) // 2)).max() <= 1
    # What a profile states of kernels is never far below what the posterior gives; here it is twice as much.
    stated, place = stated_by(result), np.array([[300.0, 240.0]])
    assert stated is not None
    by_posterior = result.sigma_of(lambda term: kernels(term, place, 41, 21))
    map_of_sigma = stated.of_kernels(kernels(result.term, place, 41, 21))
    assert 0.7 < float(np.linalg.norm(map_of_sigma) / np.linalg.norm(by_posterior)) < 3.0
    (drawn,) = result.posterior.draws(np.random.default_rng(1), 1)
    assert np.isfinite(np.asarray(drawn.residual)).all()
    assert np.abs(drawn.residual).max() > 0


def streak(source: np.ndarray, middle: np.ndarray, disc_px: float, rig: RigDescription) -> np.ndarray:
    """Two Gaussians that grow over the field; not a grating's."""
    down, across = source[1] / rig.camera.rows - 0.5, source[0] / rig.camera.columns - 0.5
    image = np.zeros((3, *SIZE))
    for channel, size in enumerate((1.1, 1.0, 0.9)):
        for weight, sigma_x, sigma_y in ((0.85, 0.8 + 0.1 * across, 0.9 + 0.2 * down), (0.15, 1.2, 3.4 + down)):
            sx, sy = (np.hypot(sigma * size, disc_px / 4) for sigma in (sigma_x, sigma_y))
            x, y = (
                np.diff(ndtr((np.arange(n + 1) - n // 2 - 0.5 - o) / s))
                for n, o, s in ((SIZE[1], source[0] - middle[0], sx), (SIZE[0], source[1] - middle[1], sy))
            )
            image[channel] += weight * np.outer(y, x)
    return image


@pytest.mark.slow
def test_blur_without_a_grating_is_carried_by_the_image() -> None:
    rig = load_rig("lg55-reduced")
    geometry = nominal_geometry(rig)
    shots = shots_of(lambda s, m: streak(s, m, 1.0, rig), rig, places_on(rig, 4, 3), 4, 1.0)
    result = fit_psf(PsfData(shots), rig, geometry, absent_wire(rig, geometry), TOY)
    assert result.status is FitStatus.CONVERGED
    assert float(result.term.diffraction_fraction) == 0.0
    assert result.chi2_dof < 10.0
    assert "not that of a panel's grating" in result.notes[0]
    stated = stated_by(result)
    assert stated is not None
    assert any("The kernel is off by" in note for note in result.notes) == (stated.size > 0)
    assert result.term.residual.shape[2:] == tuple(2 * result.term.support_px[::-1].astype(int) + 1)
    place = np.array([[430.0, 300.0]])
    truth = streak(place[0], place[0], 0.0, rig)[None, :, 6:-6, 6:-6]
    error = relative_l2(kernels(result.term, place, 29, 15), truth)
    assert error.max() < 0.03
    other = streak(place[0] + [0.0, 0.4], place[0], 0.0, rig)[None, :, 6:-6, 6:-6]
    assert relative_l2(kernels(result.term, place, 29, 15), other).min() > 0.1


@pytest.mark.parametrize("per_px", [1, 2])
def test_matrices_move_towards_the_offset_and_smear_by_the_disc(per_px: int) -> None:
    nodes = np.arange(per_px * 40 + 1) / per_px
    image = np.exp(-0.5 * ((nodes - 20.0) / 1.5) ** 2)
    moved, smeared = shifts(np.array([0.4, 0.0]), np.array([0.0, 1.6]), 41, per_px) @ image
    samples = np.arange(41)
    for seen, mean, variance in ((moved, 20.4, 1.5**2), (smeared, 20.0, 1.5**2 + 1.6**2 / 16)):
        assert np.average(samples, weights=seen) == pytest.approx(mean, abs=0.012)
        assert np.average((samples - mean) ** 2, weights=seen) == pytest.approx(variance, rel=5e-3)
    assert moved.sum() == pytest.approx(np.sqrt(2 * np.pi) * 1.5, rel=1e-3)


def test_aims_fall_into_groups() -> None:
    aims = np.array([[10.0, 10.0], [11.5, 10.5], [50.0, 10.0], [10.4, 11.9]])
    np.testing.assert_array_equal(group(aims), [0, 0, 1, 0])


def session_of(folder: Path, level_DN: int, places: int = 6, hot: tuple[int, int] | None = None) -> Session:
    """Brackets whose LED is a square of ``level_DN`` at the shortest exposure, clipped beyond 12 bit.

    ``hot`` is the (row, column) of a pixel that is full in all pictures.
    """
    rig = load_rig("lg55-reduced")
    writer = SessionWriter.create(folder, rig, CameraIdentity("maker", "model", "1", "test"))
    rng = np.random.default_rng(0)
    for place in range(places):
        region = Region(100 * place + 20, 40, 48, 64)
        frames = []
        for exposure in (1e-4, 4e-4):
            data = 64.0 + rng.normal(0, 2, (64, 48))
            data[30:34, 22:26] += level_DN * exposure / 1e-4
            if hot:
                data[hot] = 4095
            settings = Settings(exposure, 0.0, region)
            frame = Frame(np.clip(data.round(), 0, 4095).astype(np.uint16), settings, 0.0, 0, True)
            frames.append(SingleFrame(frame))
        subject = LedSubject(x_px=region.x + 23.5, y_px=region.y + 31.5, distance_mm=2000.0, diameter_mm=2.3)
        writer.add_step(f"psf/p{place:02d}_s0", "psf", subject, frames)
    return Session.open(folder)


@pytest.mark.parametrize(
    ("level_DN", "places", "status"),
    [(0, 6, FitStatus.TOO_DARK), (60000, 6, FitStatus.SATURATED), (2000, 2, FitStatus.TOO_FEW_DATA)],
)
def test_bad_captures_are_said_to_be_bad(tmp_path: Path, level_DN: int, places: int, status: FitStatus) -> None:
    session = session_of(tmp_path / "session", level_DN, places)
    rig, geometry = session.rig, nominal_geometry(session.rig)
    wire = absent_wire(rig, geometry)
    data = read_psf(session, nominal_noise(rig), np.ones((rig.camera.rows, rig.camera.columns)))
    result = fit_psf(data, rig, geometry, wire)
    assert result.status is status
    assert result.notes
    assert not result.ok
    assert window_half(session, (48, 16)) == (28, 16)


@pytest.mark.parametrize(("hot", "clipped"), [((2, 2), 0), ((30, 30), 3)])
def test_a_hot_pixel_costs_a_picture_only_next_to_its_led(tmp_path: Path, hot: tuple[int, int], clipped: int) -> None:
    session = session_of(tmp_path / "session", 2000, 3, hot)
    camera = session.rig.camera
    data = read_psf(session, nominal_noise(session.rig), np.ones((camera.rows, camera.columns)))
    assert (data.taken, data.dark, data.clipped) == (3, 0, clipped)


def test_the_order_of_capture_does_not_number_positions(tmp_path: Path) -> None:
    session = session_of(tmp_path / "session", 2000, 3)
    even = np.ones((session.rig.camera.rows, session.rig.camera.columns))
    backwards = session.manifest.model_copy(update={"steps": session.manifest.steps[::-1]})
    one, other = (
        read_psf(each, nominal_noise(session.rig), even).shots for each in (session, Session(session.path, backwards))
    )
    assert one is not None
    assert other is not None
    np.testing.assert_array_equal(one.positions_px(), other.positions_px())
    np.testing.assert_array_equal(one.rate, other.rate)


def test_where_no_wire_shows_the_rig_says_where_to_start() -> None:
    rig = load_rig("lg55-reduced")
    geometry = nominal_geometry(rig)
    model = start_model(rig, geometry, absent_wire(rig, geometry))
    assert float(model.visibility) == 0.0
    np.testing.assert_allclose(model.openings, [0.94, 0.40])
