from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.simulation.toy import toy_rig, toy_truth
from udccal.bins import Bins, block_weights
from udccal.cameras.protocol import CameraIdentity, Region, Settings
from udccal.cfa import PATTERNS, Cfa, cfa_named
from udccal.displays.pictures import face_picture
from udccal.fitting.backscatter.data import BackscatterData, Binned
from udccal.fitting.backscatter.fit import fit_backscatter
from udccal.fitting.backscatter.model import grid_step
from udccal.fitting.backscatter.parameters import BackscatterRules
from udccal.fitting.backscatter.read import binned, read_backscatter, visible_crop
from udccal.fitting.noise.fit import nominal_noise
from udccal.fitting.nominal import nominal_geometry
from udccal.models.backscatter import Backscatter, backscatter_rate
from udccal.models.geometry import Geometry
from udccal.result import FitResult, FitStatus
from udccal.rig import RigDescription, load_rig
from udccal.sessions.captured import AveragedFrames
from udccal.sessions.schema import DarkSubject
from udccal.sessions.store import Average, Session
from udccal.sessions.writer import SessionWriter
from udccal.simulation.backscatter import backscatterer

EXPOSURE_S = 0.05
FRAMES = 8


def wide_rig() -> RigDescription:
    """The toy with big pixels: as much of the panel is seen as at full size."""
    rig = toy_rig()
    return rig.model_copy(update={"camera": rig.camera.model_copy(update={"pitch_um": 55.2})})


def wide_truth():  # type: ignore[no-untyped-def]
    truth = toy_truth()
    fx_px, fy_px = truth.optics.fx_px / 8, truth.optics.fy_px / 8
    optics = replace(truth.optics, fx_px=fx_px, fy_px=fy_px, distortion=(-0.07, 0.03, 0.0, 0.0, 0.0))
    return replace(truth, description=wide_rig(), optics=optics)


TRUTH = wide_truth()
RIG = wide_rig()


def known_geometry() -> Geometry:
    """What a geometry fit would know: all but the pupil's place, which is nominal."""
    optics = TRUTH.optics
    return Geometry(
        focal_px=np.array([optics.fx_px, optics.fy_px]),
        principal_point_px=np.array([optics.cx_px, optics.cy_px]),
        distortion=np.array(optics.distortion),
        rotation_rad=Rotation.from_matrix(optics.R_panel_camera).as_rotvec(),
        pupil_mm=nominal_geometry(RIG).pupil_mm,
    )


def picture(seed: int) -> np.ndarray:
    return face_picture(seed, RIG.panel.columns, RIG.panel.rows)


WHITE = np.full((RIG.panel.rows, RIG.panel.columns, 3), 255, np.uint8)
SHOWN = [picture(seed) for seed in range(10)]


def noisy(rate: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    variance = (rate * EXPOSURE_S + 25.0) / FRAMES / EXPOSURE_S**2
    return rate + rng.normal(size=rate.shape) * np.sqrt(variance), variance


@pytest.fixture(scope="module")
def simulator():  # type: ignore[no-untyped-def]
    return backscatterer(TRUTH)


@pytest.fixture(scope="module")
def data(simulator) -> BackscatterData:  # type: ignore[no-untyped-def]
    rng = np.random.default_rng(1)
    crop = visible_crop(known_geometry(), RIG)

    def one_shot(light: np.ndarray) -> Binned:
        rate, _ = noisy(light, rng)
        bins, one = Bins(RIG.camera.cfa, grid_step(RIG)), np.ones_like(rate)
        mean = bins.mean(rate)
        shot, rest = bins.variance(one / EXPOSURE_S / FRAMES), bins.variance(one * 25.0 / FRAMES / EXPOSURE_S**2)
        clipped = np.zeros(mean.shape, dtype=bool)
        return Binned(*(part[None] for part in (mean, shot, rest, clipped)), np.array([EXPOSURE_S]), np.array([np.nan]))

    dark = np.zeros((RIG.camera.rows, RIG.camera.columns))
    lit = [simulator.rate(one) for one in (WHITE, *SHOWN)]
    return BackscatterData(
        shots=Binned.joined([one_shot(light) for light in (*lit, dark)]),
        shown=np.stack([crop.of(one) for one in SHOWN]),
        crop=crop,
        names=tuple(f"picture_{seed}" for seed in range(len(SHOWN))),
    )


@pytest.fixture(scope="module")
def fitted(data: BackscatterData) -> FitResult[Backscatter]:
    return fit_backscatter(data, known_geometry(), RIG, BackscatterRules(positions=60))


def rate(term: Backscatter, shown: np.ndarray) -> np.ndarray:
    with jax.enable_x64(True):
        return np.asarray(backscatter_rate(term, shown))


def error_of_peak(term: Backscatter, shown: np.ndarray, simulator) -> float:  # type: ignore[no-untyped-def]
    truth = simulator.rate(shown)
    return float(np.sqrt(np.mean((rate(term, shown) - truth) ** 2)) / truth.max())


@pytest.mark.medium
def test_pictures_not_in_the_fit_are_predicted(fitted: FitResult[Backscatter], simulator) -> None:  # type: ignore[no-untyped-def]
    assert fitted.status is FitStatus.CONVERGED
    for seed in (100, 101):
        assert error_of_peak(fitted.term, picture(seed), simulator) < 0.02
    assert error_of_peak(fitted.term, WHITE, simulator) < 0.02


def test_a_shifted_picture_does_not_pass(fitted: FitResult[Backscatter], simulator) -> None:  # type: ignore[no-untyped-def]
    shifted = np.roll(picture(100), 2, axis=1)
    truth = simulator.rate(picture(100))
    error = np.sqrt(np.mean((rate(fitted.term, shifted) - truth) ** 2)) / truth.max()
    assert error > 0.02


def test_what_the_simulator_was_built_with_is_found(fitted: FitResult[Backscatter]) -> None:
    assert fitted.estimate("gamma").value == pytest.approx(TRUTH.panel.gamma, abs=0.01)
    assert fitted.estimate("standoff_mm").value == pytest.approx(-TRUTH.optics.pupil_mm[2], abs=0.3)
    nominal_px = known_geometry().pupil_mm[0] / RIG.panel.pitch_mm.value
    offset = nominal_px - TRUTH.optics.pupil_mm[0] / TRUTH.panel.pitch_mm
    assert fitted.term.emitters_px[1, 0] == pytest.approx(offset, abs=0.2)
    np.testing.assert_allclose(np.asarray(fitted.term.mix).sum(axis=1), 1.0, atol=1e-12)
    assert all(e.sigma >= 0 for e in fitted.estimates)


def test_the_map_of_sigma_is_below_that_of_white_alone(data: BackscatterData, fitted: FitResult[Backscatter]) -> None:
    """All pictures help: the mask is better known than by the frames of white, by at most their number."""
    assert fitted.map_sigma is not None
    assert fitted.map_sigma.shape[0] == 3
    white = np.sqrt(data.shots.variance(data.shots.rate)[0])
    ratio = float(np.median(fitted.map_sigma) / np.median(white))
    assert (len(SHOWN) + 1) ** -0.5 < ratio < 1.0


def test_what_was_known_before_is_the_rig_file(fitted: FitResult[Backscatter]) -> None:
    standoff, gamma = (fitted.estimate(name) for name in ("standoff_mm", "gamma"))
    assert standoff.prior is not None
    assert gamma.prior is not None
    assert standoff.prior.value == pytest.approx(RIG.mounting.standoff_mm.value)
    assert standoff.prior.sigma == pytest.approx(RIG.mounting.standoff_mm.tolerance + 0.1)
    assert gamma.prior.value == pytest.approx(RIG.panel.gamma.value)
    assert not gamma.by_prior


def test_the_candidate_of_the_largest_evidence_is_chosen(fitted: FitResult[Backscatter]) -> None:
    assert sum(c.chosen for c in fitted.candidates) == 1
    chosen = next(c for c in fitted.candidates if c.chosen)
    assert chosen.criterion == min(c.criterion for c in fitted.candidates)
    held_out = next(d for d in fitted.diagnostics if d.name == "held_out_without_noise_of_peak")
    assert 0 < held_out.value < 0.02


def test_what_the_model_leaves_out_counts_as_noise(fitted: FitResult[Backscatter]) -> None:
    """The simulator is not of the model's class: a model error in the result explains its chi2."""
    share = next(d.value for d in fitted.diagnostics if d.name == "model_error_of_white")
    assert 1e-4 < share < 0.01
    assert fitted.chi2_dof == pytest.approx(1.0, abs=0.15)
    assert any("counts as noise" in note for note in fitted.notes)


def test_a_clipped_white_is_saturated(data: BackscatterData) -> None:
    clipped = data.shots.clipped.copy()
    clipped[0] = np.random.default_rng(0).random(clipped[0].shape) < 0.3
    result = fit_backscatter(replace(data, shots=replace(data.shots, clipped=clipped)), known_geometry(), RIG)
    assert result.status is FitStatus.SATURATED
    assert rate(result.term, WHITE).max() == 0.0


def test_a_black_panel_is_absent(data: BackscatterData) -> None:
    """In each of 100 captures, and it costs nothing later."""
    rng = np.random.default_rng(0)
    for _ in range(100):
        black = data.shots.rate.copy()
        black[[0, -1]] = np.sqrt(data.shots.rest[0]) * rng.normal(size=(2, *black.shape[1:]))
        result = fit_backscatter(replace(data, shots=replace(data.shots, rate=black)), known_geometry(), RIG)
        assert result.status is FitStatus.ABSENT
    assert result.ok
    assert rate(result.term, WHITE).max() == 0.0


def test_few_pictures_are_too_few(data: BackscatterData) -> None:
    few = data.only(np.arange(len(data.names)) < 3)
    assert fit_backscatter(few, known_geometry(), RIG).status is FitStatus.TOO_FEW_DATA
    clipped = data.shots.clipped.copy()
    clipped[1:-1] = True
    bright = replace(data, shots=replace(data.shots, clipped=clipped))
    assert "clipped" in fit_backscatter(bright, known_geometry(), RIG).notes[0]


@pytest.mark.slow
def test_pictures_in_the_wrong_order_are_a_poor_fit(data: BackscatterData) -> None:
    backwards = replace(data, shown=data.shown[::-1].copy())
    result = fit_backscatter(backwards, known_geometry(), RIG, BackscatterRules(positions=60))
    assert not result.ok


@pytest.mark.medium
def test_bins_are_means_of_one_colour() -> None:
    rows, columns, step = 24, 32, 4
    channels = cfa_named("GBRG").channel_map(rows, columns)
    bins = Bins("GBRG", step)
    mean = bins.mean(np.array([10.0, 20.0, 30.0])[channels])
    np.testing.assert_allclose(mean, np.broadcast_to([[[10.0]], [[20.0]], [[30.0]]], (3, 6, 8)))
    rng = np.random.default_rng(0)
    many = np.stack([bins.mean(rng.normal(size=(rows, columns))) for _ in range(1000)])
    np.testing.assert_allclose(bins.variance(np.ones((rows, columns))), many.var(axis=0), rtol=0.2)
    rowwise = np.stack([bins.mean(np.repeat(rng.normal(size=(rows, 1)), columns, axis=1)) for _ in range(1000)])
    np.testing.assert_allclose(bins.row_variance(np.ones((rows, columns))), rowwise.var(axis=0), rtol=0.2)


@pytest.mark.parametrize(("most", "clipped"), [(0.98, 1), (0.5, 2), (1.0, 0)])
def test_a_bin_is_clipped_from_the_fraction_of_saturation_that_the_rules_say(most: float, clipped: int) -> None:
    noise = nominal_noise(RIG)
    mean = np.full((8, 8), float(noise.black_DN), np.float32)
    mean[0, 0], mean[0, 4] = 0.99 * float(noise.saturation_DN), 0.7 * float(noise.saturation_DN)
    average = Average(mean, np.ones_like(mean), FRAMES)
    found = binned([(average, EXPOSURE_S)], noise, np.ones(mean.shape), Bins("RGGB", 4), most)
    assert found.clipped.sum() == clipped


@pytest.mark.parametrize("cfa", ["RGGB", "BGGR", "GRBG", "GBRG", "quad"])
def test_every_colour_of_a_bin_is_of_its_centre(cfa: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A slanted plane: the mean of a block's own samples alone would be half a pixel off in red and blue."""
    monkeypatch.setitem(PATTERNS, "quad", Cfa("quad", ("RRGG", "RRGG", "GGBB", "GGBB"), ""))
    y, x = np.mgrid[0:24, 0:32].astype(float)
    mean = Bins(cfa, 4).mean(2 * x + 3 * y)
    centres_x, centres_y = 4 * np.arange(8) + 1.5, 4 * np.arange(6) + 1.5
    wanted = 2 * centres_x + 3 * centres_y[:, None]
    np.testing.assert_allclose(mean[:, 1:-1, 1:-1], np.broadcast_to(wanted, (3, 6, 8))[:, 1:-1, 1:-1], atol=1e-9)
    np.testing.assert_allclose(block_weights(24, slice(0, None, 2), 6, 4).sum(axis=1), 1.0)


@pytest.mark.parametrize("name", ["lg55-aca2040", "lg55-reduced", "mk31-imx1600"])
def test_the_grid_covers_the_sensor_and_resolves_the_ripple(name: str) -> None:
    rig = load_rig(name)
    step = grid_step(rig)
    period = rig.panel.pitch_mm.value / rig.mounting.standoff_mm.value * rig.focal_px
    assert step % 2 == 0
    assert step <= max(4, period / 6)
    assert rig.camera.columns % step < 4
    assert rig.camera.rows % step < 4


@pytest.mark.slow
def test_a_session(simulator, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    noise = nominal_noise(RIG)
    writer = SessionWriter.create(tmp_path / "s", RIG, CameraIdentity("a", "b", "c", "test"))
    rng = np.random.default_rng(4)

    def average(rate_e: np.ndarray) -> AveragedFrames:
        value, variance = noisy(rate_e, rng)
        gain = float(noise.K_DN_per_e)
        mean = float(noise.black_DN) + gain * EXPOSURE_S * value
        settings = Settings(EXPOSURE_S, 0.0, Region(0, 0, RIG.camera.columns, RIG.camera.rows))
        single = variance * FRAMES * (gain * EXPOSURE_S) ** 2
        return AveragedFrames(mean.astype(np.float32), single.astype(np.float32), FRAMES, settings, 0.0, 1.0)

    dark = np.zeros((RIG.camera.rows, RIG.camera.columns))
    writer.add_step("backscatter/dark", "backscatter", DarkSubject(), [average(dark)])
    for index, shown in enumerate([WHITE, *SHOWN]):
        name = "backscatter/white" if index == 0 else f"backscatter/picture_{index - 1}"
        subject = writer.store_picture(name, shown, "white" if index == 0 else "picture")
        writer.add_step(name, "backscatter", subject, [average(simulator.rate(shown))])
    session = Session.open(tmp_path / "s")
    data = read_backscatter(session, noise, known_geometry(), np.ones(dark.shape))
    result = fit_backscatter(data, known_geometry(), RIG, BackscatterRules(positions=60))
    assert result.status is FitStatus.CONVERGED
    assert error_of_peak(result.term, picture(100), simulator) < 0.02


def test_a_session_without_white_is_too_few_data(tmp_path: Path) -> None:
    SessionWriter.create(tmp_path / "s", RIG, CameraIdentity("a", "b", "c", "test"))
    flat = np.ones((RIG.camera.rows, RIG.camera.columns))
    data = read_backscatter(Session.open(tmp_path / "s"), nominal_noise(RIG), known_geometry(), flat)
    result = fit_backscatter(data, known_geometry(), RIG)
    assert result.status is FitStatus.TOO_FEW_DATA
    assert "backscatter/white" in result.notes[0]
