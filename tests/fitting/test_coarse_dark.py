"""The dark level under light: by dark frames, or by the noise term where codes are too coarse to tell it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import equinox as eqx
import numpy as np
import pytest

from udccal.cameras.protocol import CameraIdentity, Region, Settings
from udccal.fitting.backscatter.read import read_backscatter
from udccal.fitting.noise.fit import nominal_noise
from udccal.fitting.nominal import nominal_geometry
from udccal.fitting.wire.data import WireData, read_wire
from udccal.models.noise import Noise
from udccal.rig import load_rig
from udccal.sessions.captured import AveragedFrames
from udccal.sessions.schema import DarkSubject, FlatSubject, PanelSubject
from udccal.sessions.store import Session
from udccal.sessions.writer import SessionWriter

SHAPE, FRAMES, EXPOSURE_S, BLACK_DN = (64, 80), 16, 0.01, 5.193
SIGNAL_DN = 120.0


def noise_of(black_DN: float = BLACK_DN) -> Noise:
    values = {"K_DN_per_e": 0.0168, "black_DN": black_DN, "saturation_DN": 255.0, "dark_current_e_per_s": 200.0}
    term = nominal_noise(load_rig("lg55-reduced"))
    names = list(values)
    return eqx.tree_at(lambda n: [getattr(n, name) for name in names], term, list(values.values()))


def session_of(folder: Path, spread_DN: float, black_DN: float = BLACK_DN) -> Session:
    """Even light and dark frames whose codes are rounded, of a sensor with this read noise."""
    rig, rng = load_rig("lg55-reduced"), np.random.default_rng(3)
    level = black_DN + 0.0168 * 200.0 * EXPOSURE_S
    codes = np.maximum(np.rint(level + spread_DN * rng.standard_normal((FRAMES, *SHAPE))), 0)
    codes[:, 5, 7] = 40
    dark = AveragedFrames(
        codes.mean(axis=0, dtype=np.float32),
        codes.var(axis=0, ddof=1).astype(np.float32),
        FRAMES,
        Settings(EXPOSURE_S, 0.0, Region(0, 0, SHAPE[1], SHAPE[0])),
        0.0,
        1.0,
    )
    flat = replace(dark, mean=np.full(SHAPE, np.float32(level + SIGNAL_DN)), variance=np.full(SHAPE, np.float32(2.0)))
    writer = SessionWriter.create(folder, rig, CameraIdentity("maker", "model", "1", "test"))
    writer.add_step("wire/dark", "wire", DarkSubject(), [dark])
    writer.add_step("wire/flat", "wire", FlatSubject(), [flat])
    white = PanelSubject(picture="white.png", picture_sha256="0" * 64, role="white")
    writer.add_step("backscatter/white", "backscatter", white, [flat])
    writer.add_step("backscatter/dark", "backscatter", DarkSubject(), [dark])
    return Session.open(folder)


def read(folder: Path, noise: Noise, spread_DN: float, black_DN: float = BLACK_DN) -> WireData:
    session = session_of(folder, spread_DN, black_DN)
    return read_wire(session, noise, nominal_geometry(session.rig), black_sigma_DN=0.01)


@pytest.mark.parametrize(
    ("spread_DN", "black_DN"), [(0.04, BLACK_DN), (0.15, 5.4), (1.5, 0.3)], ids=["one code", "two codes", "cut off"]
)
def test_coarse_codes_do_not_shift_the_signal(tmp_path: Path, spread_DN: float, black_DN: float) -> None:
    data = read(tmp_path / "s", noise_of(black_DN), spread_DN, black_DN)
    assert np.median(data.signal) == pytest.approx(SIGNAL_DN, abs=0.005)
    assert data.dark_sigma == 0.01
    # A hot pixel stays one.
    assert data.signal[5, 7] < SIGNAL_DN - 30


def test_codes_that_noise_spreads_tell_their_level(tmp_path: Path) -> None:
    """Pixel by pixel, and whatever the term says of black."""
    data = read(tmp_path / "s", noise_of(6.1), 0.8)
    assert np.mean(data.signal) == pytest.approx(SIGNAL_DN, abs=0.05)
    assert np.ptp(data.signal[:4]) > 0.3
    assert data.dark_sigma == 0.0


def test_a_term_of_another_black_is_not_believed(tmp_path: Path) -> None:
    data = read(tmp_path / "s", noise_of(64.0), 0.04)
    assert np.median(data.signal) == pytest.approx(SIGNAL_DN + 0.2, abs=0.05)
    assert data.dark_sigma == 0.0


@pytest.mark.parametrize(("spread_DN", "off_DN"), [(0.04, 0.19), (0.8, 0.0)], ids=["coarse", "fine"])
def test_the_panels_light_is_counted_from_the_same_level(tmp_path: Path, spread_DN: float, off_DN: float) -> None:
    session = session_of(tmp_path / "s", spread_DN)

    def light_DN(noise: Noise) -> float:
        seen = read_backscatter(session, noise, nominal_geometry(session.rig), np.ones(SHAPE)).shots.excess[0]
        return float(np.median(seen)) * 0.0168 * EXPOSURE_S

    assert light_DN(noise_of()) == pytest.approx(SIGNAL_DN, abs=0.02)
    # By the codes' own mean, where the term is of another camera.
    assert light_DN(noise_of(BLACK_DN + 30)) == pytest.approx(SIGNAL_DN + off_DN, abs=0.05)
