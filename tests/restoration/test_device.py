"""The device path shows what the numpy path shows. Here the device is JAX's CPU."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.scenes.toy_restorer import COLUMNS, EXPOSURE_S, ROWS, exposed, made
from udccal.cfa import cfa_named
from udccal.errors import RestorationError
from udccal.fitting.nominal import nominal_geometry
from udccal.models.noise import Noise
from udccal.restoration import dark_places
from udccal.restoration.backscatter import PanelLight, PanelSums
from udccal.restoration.device.light import plausible as dark_on_device
from udccal.restoration.device.restorer import DeviceRestorer
from udccal.restoration.kernel_grid import KernelGrid
from udccal.restoration.panel_mask import PanelMask
from udccal.restoration.runtime import Restorer
from udccal.restoration.shrink import linear_weights
from udccal.restoration.tone import Tone
from udccal.rig import RigDescription
from udccal.tiers import Tier

TONE = Tone(EXPOSURE_S / 6000.0)
FRAME_ROWS = 200
TIERS = (Tier.fast, Tier.balanced, Tier.accurate)
Broken = Callable[[DeviceRestorer], DeviceRestorer]


def panel_light(rig: RigDescription) -> PanelLight:
    """Up to six pixels of the panel, anywhere, give light to each place of a grid over the sensor."""
    rng, nodes = np.random.default_rng(4), (8, 12)
    starts = np.concatenate([[0], np.cumsum(rng.integers(1, 7, nodes[0] * nodes[1]))]).astype(np.int32)
    down, across = (
        linear_weights(np.linspace(0, size - 1, count), np.arange(size))
        for count, size in zip(nodes, (rig.camera.rows, rig.camera.columns), strict=True)
    )
    sums = PanelSums(
        np.array([3, rig.panel.rows, 5, rig.panel.columns - 2], dtype=np.int32),
        rng.uniform(0.1, 0.4, (3, starts[-1])).astype(np.float32),
        rng.integers(0, (rig.panel.rows - 3) * (rig.panel.columns - 7), starts[-1]).astype(np.int32),
        starts,
        np.full((3, nodes[0] * nodes[1]), 5e4, np.float32),
        (np.eye(3) + 0.1).astype(np.float32),
        ((np.arange(256) / 255) ** 2.2).astype(np.float32),
        down,
        across,
    )
    return PanelLight(sums, cfa_named(rig.camera.cfa))


@pytest.fixture(scope="module")
def restorers(small_rig: RigDescription, toy_noise: Noise, toy_grid: KernelGrid) -> dict[Tier, Restorer]:
    """Every stage has something to do, and the view and its tiles need the lower rows of a frame only."""
    rig = small_rig.model_copy(update={"camera": small_rig.camera.model_copy(update={"rows": FRAME_ROWS})})
    panel, geometry, found = panel_light(rig), nominal_geometry(rig), {}
    white = panel.rate(np.full((rig.panel.rows, rig.panel.columns, 3), 255, np.uint8))
    for tier in TIERS:
        whole = made(tier, rig, toy_noise, geometry, toy_grid, needed_alone=True)
        rows = whole.rows
        assert rows.start > 0
        mask, wire = PanelMask(white[rows], panel.cfa, 0.02), whole.wire[rows]
        found[tier] = replace(whole, wire=wire, mask=mask, panel=panel.of_rows(rows))
    return found


@pytest.fixture(scope="module")
def devices(restorers: dict[Tier, Restorer]) -> dict[Tier, DeviceRestorer]:
    return {tier: DeviceRestorer.of(restorer, jax.devices("cpu")[0]) for tier, restorer in restorers.items()}


@pytest.fixture(scope="module")
def picture(small_rig: RigDescription) -> np.ndarray:
    return np.random.default_rng(5).integers(0, 256, (small_rig.panel.rows, small_rig.panel.columns, 3), np.uint8)


@pytest.fixture(scope="module")
def frame(restorers: dict[Tier, Restorer], toy_grid: KernelGrid, toy_scene: np.ndarray) -> np.ndarray:
    """A dark corner, a lamp that clips, and two defects; more light than the panel gives."""
    scene = toy_scene.copy()
    scene[:30, :40] *= 0.002
    scene[60:72, 50:62] = 1.4e4
    rig = restorers[Tier.fast].rig
    wide = rig.model_copy(update={"camera": rig.camera.model_copy(update={"rows": ROWS, "columns": COLUMNS})})
    wire = np.ones((ROWS, COLUMNS), np.float32)
    raw = exposed(replace(restorers[Tier.fast], rig=wide, wire=wire), toy_grid, scene + 500.0)[10:74, 10:106].copy()
    raw[20, 31], raw[41, 60] = 3900, 0
    return np.tile(raw, (4, 1))[:FRAME_ROWS]


def off(restorer: Restorer, device: DeviceRestorer, frame: np.ndarray, shown: np.ndarray | None) -> np.ndarray:
    """By how many codes the device's picture differs."""
    expected = restorer.display(frame, EXPOSURE_S, TONE, shown)
    assert expected.std() > 20
    return np.abs(device.display(frame, EXPOSURE_S, TONE, shown).astype(int) - expected)


def agree(codes: np.ndarray, most: int = 1) -> bool:
    return bool(np.mean(codes > 0) < 0.05 and np.mean(codes > most) < 1e-3)


@pytest.mark.medium
@pytest.mark.parametrize("tier", TIERS)
def test_a_device_shows_what_the_cpu_shows(
    restorers: dict[Tier, Restorer],
    devices: dict[Tier, DeviceRestorer],
    frame: np.ndarray,
    picture: np.ndarray,
    tier: Tier,
) -> None:
    for shown in (picture, np.zeros_like(picture), None):
        assert agree(off(restorers[tier], devices[tier], frame, shown), 2 if tier is Tier.accurate else 1)


@pytest.mark.medium
def test_halos_of_lamps_are_taken_off_on_a_device_too(
    toy_rig: RigDescription, toy_noise: Noise, toy_grid: KernelGrid
) -> None:
    rows, columns = 160, 128
    rig = toy_rig.model_copy(update={"camera": toy_rig.camera.model_copy(update={"rows": rows, "columns": columns})})
    restorer = made(Tier.accurate, rig, toy_noise, nominal_geometry(rig), toy_grid)
    y, x = np.mgrid[:rows, :columns]
    scene = np.repeat(2e3 * (1 + 0.8 * np.sin(x / 7 + y / 9))[..., None], 3, axis=2)
    scene[116:124, 60:68] = 6e5
    frame = exposed(restorer, toy_grid, scene)
    device = DeviceRestorer.of(restorer, jax.devices("cpu")[0])
    assert agree(off(restorer, device, frame, None), 2)
    assert restorer.sharpener is not None
    halos = replace(restorer, sharpener=replace(restorer.sharpener, options=replace(restorer.options, lamps=0)))
    assert not agree(off(halos, device, frame, None), 2)
    # Of a frame without a lamp, nothing is taken to the device.
    assert device._lamps(np.minimum(frame, 2000), EXPOSURE_S, None) is device.no_lamps


def test_of_an_unknown_panel_something_is_put_back(restorers: dict[Tier, Restorer], frame: np.ndarray) -> None:
    """So that the comparison of devices sees it."""
    restorer = restorers[Tier.fast]
    light, sharpener = restorer.scene_light(frame, EXPOSURE_S), restorer.sharpener
    assert light.levels is not None
    assert restorer.mask is not None
    assert sharpener is not None
    sharp = sharpener.apply(light.signal_e, light.variance_e2, light.clipped)
    back = restorer.mask.put_back(sharp, light.levels, sharpener.layout.inner.start, EXPOSURE_S, restorer.noise)
    assert np.abs(back - sharp).max() > 3.0 / TONE.exposure * EXPOSURE_S / 255


@pytest.mark.medium
def test_blind_and_dead_rows_are_filled_for_a_device(
    restorers: dict[Tier, Restorer], frame: np.ndarray, picture: np.ndarray
) -> None:
    wire, dead = restorers[Tier.fast].wire.copy(), frame.copy()
    wire[30:33] = 1e-4
    dim = replace(restorers[Tier.fast], wire=wire)
    dead[-20], dead[dim.rows][30:33] = 64, 64
    assert agree(off(dim, DeviceRestorer.of(dim, jax.devices("cpu")[0]), dead, picture))


def with_tables(kind: jnp.dtype) -> Broken:
    """Return what rounds the eigenvectors to numbers of 16 bits."""

    def broken(device: DeviceRestorer) -> DeviceRestorer:
        vectors = device.stages.tiles.vectors
        rounded = (part.astype(kind).astype(jnp.float32) for part in (vectors.real, vectors.imag))
        return replace(device, stages=eqx.tree_at(lambda s: s.tiles.vectors, device.stages, jax.lax.complex(*rounded)))

    return broken


def changed(where: Callable, to: Callable) -> Broken:
    return lambda device: replace(device, stages=eqx.tree_at(where, device.stages, replace_fn=to))


BROKEN: dict[str, Broken] = {
    "bfloat16": with_tables(jnp.dtype(jnp.bfloat16)),
    "matched": changed(lambda s: s.tiles.matched, lambda table: 1.05 * table),
    "another tile's tables": changed(lambda s: s.tiles.vectors, lambda table: table[::-1]),
    "wire": changed(lambda s: s.front.wire, lambda wire: wire[::-1]),
    "mask": changed(lambda s: s.front.white, lambda white: 0.5 * white),
    "bands": changed(lambda s: s.bands[0], lambda variance: 2 * variance),
    "kernels": changed(lambda s: s.learned[1], lambda kernels: kernels[..., ::-1]),
    "network": changed(lambda s: s.learned[0]["out"], lambda kernel: -kernel),
    "maps": changed(lambda s: s.maps[1], lambda step: step[..., ::-1]),
}


@pytest.mark.medium
@pytest.mark.parametrize("name", BROKEN)
def test_the_comparison_sees_a_wrong_table(
    restorers: dict[Tier, Restorer], devices: dict[Tier, DeviceRestorer], frame: np.ndarray, name: str
) -> None:
    broken = BROKEN[name](devices[Tier.accurate])
    assert not agree(off(restorers[Tier.accurate], broken, frame, None), 2)


@pytest.mark.medium
def test_the_comparison_sees_another_panel_picture(
    restorers: dict[Tier, Restorer], devices: dict[Tier, DeviceRestorer], frame: np.ndarray, picture: np.ndarray
) -> None:
    expected = restorers[Tier.fast].display(frame, EXPOSURE_S, TONE, picture)
    shown = devices[Tier.fast].display(frame, EXPOSURE_S, TONE, np.ascontiguousarray(picture[::-1]))
    assert not agree(np.abs(shown.astype(int) - expected))


@pytest.mark.medium
def test_what_the_cpu_refuses_is_refused(devices: dict[Tier, DeviceRestorer], frame: np.ndarray) -> None:
    panel = devices[Tier.fast].restorer.rig.panel
    white = np.full((panel.rows, panel.columns, 3), 255, np.uint8)
    with pytest.raises(RestorationError, match="as bright as the panel's own light"):
        devices[Tier.fast].display(np.full_like(frame, 80), 1.0, TONE, white)
    with pytest.raises(RestorationError, match="96 x 200 samples"):
        devices[Tier.fast].display(frame[:-2], EXPOSURE_S, TONE)
    with pytest.raises(RestorationError, match="positive exposure"):
        devices[Tier.fast].display(frame, 0.0, TONE)
    display = inspect.unwrap(DeviceRestorer.display)  # programs do not have the tests' own check of types
    with pytest.raises(RestorationError, match="Expected a Tone, found 'x'"):
        display(devices[Tier.fast], frame, EXPOSURE_S, "x")


def test_what_a_device_cannot_do_is_refused(restorers: dict[Tier, Restorer]) -> None:
    restorer = restorers[Tier.fast]
    with pytest.raises(RestorationError, match="a restorer that deblurs"):
        DeviceRestorer.of(replace(restorer, sharpener=None, tier=Tier.preview))
    odd = restorer.rig.camera.model_copy(update={"rows": 199})
    with pytest.raises(RestorationError, match="whole 2 x 2 cells"):
        DeviceRestorer.of(replace(restorer, rig=restorer.rig.model_copy(update={"camera": odd})))


@pytest.mark.parametrize("light_e", [-5e4, -2000.0, -30.0, -1.0, 0.5, 40.0])
@pytest.mark.parametrize("sigma_e", [1e-6, 2.0, 200.0])
@pytest.mark.medium
def test_dark_places_are_those_of_the_cpu_however_far_below_zero(light_e: float, sigma_e: float) -> None:
    picture = np.broadcast_to(np.float32([1.0, 0.5, 1.5]) * np.float32(light_e), (64, 80, 3)).copy()
    error = np.full(picture.shape[:2], sigma_e, np.float32)
    found = np.moveaxis(
        np.asarray(dark_on_device(jnp.moveaxis(jnp.asarray(picture), -1, 0), jnp.asarray(error))), 0, -1
    )
    expected = dark_places.plausible(picture, error)
    np.testing.assert_allclose(found, expected, atol=1e-3 * max(sigma_e, 1e-3 * abs(light_e), 1e-2))
