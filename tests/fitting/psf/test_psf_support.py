"""How far a kernel reaches, on pictures whose light ends where it is known to, or does not end."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from pathlib import Path

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given

from udccal.cameras.protocol import CameraIdentity, Frame, Region, Settings
from udccal.cfa import cfa_named
from udccal.fitting.engine.orders import Attempt, choose
from udccal.fitting.noise.fit import nominal_noise
from udccal.fitting.nominal import absent_wire, nominal_geometry
from udccal.fitting.psf.fit import nominal_psf
from udccal.fitting.psf.held_out import (
    Compared,
    Support,
    choose_support,
    wide_support,
    windows_to_try,
    with_support,
)
from udccal.fitting.psf.image import Sources
from udccal.fitting.psf.start import read_psf
from udccal.kernels import fitted_size, kernel_size, kernels_at
from udccal.models.psf import PsfField
from udccal.rig import load_rig
from udccal.sessions.captured import SingleFrame
from udccal.sessions.schema import LedSubject
from udccal.sessions.store import Session
from udccal.sessions.writer import SessionWriter

HALF = (64, 16)
SHOTS = 6
ROWS, COLUMNS = windows_to_try(HALF[0]), windows_to_try(HALF[1])


def half_px(support: Support) -> tuple[int, int]:
    """(Rows, columns) to either side of the source."""
    down, across = support
    return down.best.fit, across.best.fit


def cross() -> np.ndarray:
    """Light of a streak along columns and a fainter one along rows, 1 at the peak."""
    y, x = (np.abs(np.arange(-half, half + 1)) for half in HALF)
    down, across = 1.0 / (1.0 + (y / 1.5) ** 2), 1.0 / (1.0 + (x / 1.0) ** 2)
    return np.outer(down, np.exp(-0.5 * (x / 0.8) ** 2)) + 0.3 * np.outer(np.exp(-0.5 * (y / 0.8) ** 2), across)


def compared_of(true_half: tuple[int, int], rng: np.random.Generator, background: float = 0.0) -> Compared:
    """Pictures whose light ends at ``true_half``, under a model whose light goes on; noise of 1e-4 of the peak."""
    light = np.broadcast_to(cross(), (SHOTS, *cross().shape)).copy()
    y, x = (np.abs(np.arange(-half, half + 1)) for half in HALF)
    inside = (y <= true_half[0])[:, None] & (x <= true_half[1])
    sigma = np.hypot(1e-4, 2e-3 * light)
    residual = sigma * rng.standard_normal(light.shape) - light * ~inside + background
    known, channel = np.ones(light.shape, dtype=bool), np.zeros(light.shape, dtype=np.int64)
    return Compared(residual, light, sigma**2, sigma**2, light, known, channel, np.ones(light.shape), 0.0)


def test_the_right_window_is_chosen_in_95_of_100_runs() -> None:
    rng = np.random.default_rng(7)
    right = 0
    for _ in range(100):
        true = (int(rng.choice(ROWS)), int(rng.choice(COLUMNS)))
        right += half_px(choose_support(compared_of(true, rng))) == true
    assert right >= 95


@given(st.integers(0, 400))
def test_windows_rise_to_the_largest(largest: int) -> None:
    steps = windows_to_try(largest)
    assert steps[-1] == largest
    assert all(a < b <= 1.51 * a for a, b in itertools.pairwise(steps))


def test_light_up_to_the_border_has_no_end() -> None:
    found = choose_support(compared_of(HALF, np.random.default_rng(1)))
    assert half_px(found) == HALF
    found = choose_support(compared_of((HALF[0], 8), np.random.default_rng(1)))
    assert half_px(found) == (HALF[0], 8)


def test_an_even_background_is_no_light_of_the_kernel() -> None:
    assert half_px(choose_support(compared_of((16, 8), np.random.default_rng(2), background=3e-3))) == (16, 8)


def test_hits_are_no_light_of_the_kernel() -> None:
    compared = compared_of((16, 8), np.random.default_rng(3))
    compared.residual[:, 5::40, ::7] += 0.3
    assert half_px(choose_support(compared)) == (16, 8)


def test_no_light_and_no_sample_is_the_narrowest_window() -> None:
    compared = compared_of((16, 8), np.random.default_rng(3))
    assert half_px(choose_support(replace(compared, known=np.zeros_like(compared.known)))) == (ROWS[0], COLUMNS[0])
    dark = replace(compared, residual=compared.residual * 0.0 - compared.light)
    assert half_px(choose_support(dark)) == (ROWS[0], COLUMNS[0])


@dataclass(frozen=True)
class Captured:
    session: Session
    places: np.ndarray
    term: PsfField


def captured(folder: Path, ends_px: int) -> Captured:
    """Brackets of four LEDs whose kernel is the rig's nominal one, but ends ``ends_px`` rows from its middle."""
    rig = load_rig("lg55-reduced")
    geometry, noise, rng = nominal_geometry(rig), nominal_noise(rig), np.random.default_rng(4)
    term = nominal_psf(rig, geometry, absent_wire(rig, geometry))
    places = np.array([[200.0, 200.0], [800.0, 200.0], [200.0, 600.0], [800.0, 600.0]])
    rows, columns = kernel_size(rig)
    writer = SessionWriter.create(folder, rig, CameraIdentity("maker", "model", "1", "test"))
    for index, (place, kernel) in enumerate(zip(places, kernels_at(term, places, rows, columns), strict=True)):
        region = Region(int(place[0]) - 24, int(place[1]) - 72, 48, 144)
        lit = np.zeros((3, 144, 48))
        most = min(ends_px, rows // 2)
        left = 24 - columns // 2
        lit[:, 72 - most : 73 + most, left : left + columns] = kernel[:, rows // 2 - most : rows // 2 + most + 1]
        light = np.take_along_axis(lit, cfa_named(rig.camera.cfa).channel_map(144, 48)[None], 0)[0]
        frames = [bracketed(light, exposure, noise, region, rng) for exposure in 1e-4 * 4.0 ** np.arange(7)]
        subject = LedSubject(x_px=float(place[0]), y_px=float(place[1]), distance_mm=2000.0, diameter_mm=0.01)
        writer.add_step(f"psf/p{index:02d}_s0", "psf", subject, frames)
    return Captured(Session.open(folder), places, term)


def bracketed(light, exposure, noise, region, rng) -> SingleFrame:
    electrons = rng.poisson(6000.0 * light / light.max() * exposure / 1e-4)
    counts = 64.0 + float(noise.K_DN_per_e) * electrons + rng.normal(0, 1.5, light.shape)
    frame = Frame(np.clip(counts.round(), 0, 4095).astype(np.uint16), Settings(exposure, 0.0, region), 0.0, 0, True)
    return SingleFrame(frame)


@pytest.mark.parametrize("ends_px", [23, 200])
@pytest.mark.medium
def test_whole_pictures_show_where_light_ends(tmp_path: Path, ends_px: int) -> None:
    made = captured(tmp_path / "session", ends_px)
    rig = made.session.rig
    data = read_psf(made.session, nominal_noise(rig), np.ones((rig.camera.rows, rig.camera.columns)))
    assert data.shots is not None
    sources = Sources(made.places, np.full((4, 3), 1e8), np.zeros(4))
    support = wide_support(data.shots, sources, made.term, rig)
    assert [one.tried[-1].fit for one in support] == [64, 16]
    assert half_px(support)[0] == min(ends_px, 64)
    term, notes = with_support(made.term, support, rig)
    rows, _ = fitted_size(term, rig)
    assert rows == (47 if ends_px == 23 else kernel_size(rig)[0])
    assert any("as far as was looked" in note for note in notes) == (ends_px == 200 or half_px(support)[1] == 16)


def test_an_image_ends_where_it_ends() -> None:
    rig = load_rig("lg55-reduced")
    geometry = nominal_geometry(rig)
    term = nominal_psf(rig, geometry, absent_wire(rig, geometry))
    image = replace(term, diffraction_fraction=np.float64(0.0), residual=np.ones((1, 3, 21, 11)))
    support = tuple(choose([Attempt("widest", 0, 0.0, half)]) for half in (10, 5))
    found, notes = with_support(image, support, rig)
    np.testing.assert_array_equal(found.support_px, [5, 10])
    assert fitted_size(found, rig) == (21, 11)
    assert not notes
