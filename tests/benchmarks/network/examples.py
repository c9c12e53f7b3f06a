"""What the network learns from: pictures blurred, sampled and filtered as restoration does, beside the truth."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Float32
from scipy import fft

from tests.benchmarks.network.pictures import Pictures, drawn_picture
from udccal.cfa import Cfa, cfa_named
from udccal.restoration.clipped import THOROUGH, completed
from udccal.restoration.colour_tables import THREE_COLOURS, colour_tables
from udccal.restoration.filter_tables import filter_tables
from udccal.restoration.kernel_grid import KernelGrid, centred
from udccal.restoration.mosaic_filter import Pattern, Tables, filtered_and_joined
from udccal.restoration.network import details, noise_planes, sharper
from udccal.restoration.shrink import BandNoise, measured_noise, shrunk
from udccal.restoration.tiles import GENERAL, TileLayout, layout_for
from udccal.rig import load_rig
from udccal.simulation.psf import captured_light
from udccal.simulation.truth import draw_truth

_TILE_PX, _CANVAS_PX = 256, 512
# The part of a tile that restoration uses, in whole places of the network's coarse level.
_USED_PX = 190
INNER_PX = 188
# Patches are cut of it. Much smaller ones would have more edge than the network ever sees at work.
PATCH_PX = 96
# Kernels of each simulated rig; and how their sizes vary, for rigs that nobody has drawn yet.
_RIGS = {"lg55-reduced": 40, "lg55-aca2040": 16, "mk31-imx1600": 16}
_STRETCH = (0.75, 1.35)
_LARGEST = (257, 129)
# Patterns of the kernels in turn: mosaics, grey ones, and pictures with all colours at every pixel.
_PATTERNS: tuple[Pattern, ...] = (
    *(cfa_named(name) for name in ("RGGB", "GBRG", "GRBG", "BGGR", "mono")),
    THREE_COLOURS,
)
# Part of the pictures that have lamps, which clip; and of those that are drawn.
_LIT = 0.3
_DRAWN = 0.35
_LOCAL_PX = (16, 16)


@dataclass(frozen=True)
class Optics:
    """One kernel per colour, with what restoration makes of it."""

    kernels: Float32[np.ndarray, "3 rows columns"]
    layout: TileLayout
    tables: Tables
    noise: BandNoise
    pattern: Pattern

    @classmethod
    def of(cls, kernels: Float32[np.ndarray, "3 rows columns"], turn: int) -> Optics:
        """Prepare the filter of one tile, for the next pattern in turn."""
        pattern = _PATTERNS[turn % len(_PATTERNS)]
        layout = layout_for(_USED_PX, _USED_PX, (2, 2), (_TILE_PX, _TILE_PX), (0, _USED_PX), GENERAL)
        grid = KernelGrid(np.zeros(1), np.zeros(1), kernels[None, None])
        whole = pattern is THREE_COLOURS
        tables = colour_tables(grid, layout, 1) if whole else filter_tables(grid, layout, pattern, 1)
        return cls(kernels, layout, tables, measured_noise(tables, layout, pattern, 1), pattern)

    @property
    def grey(self) -> bool:
        """Whether the sensor has no colours."""
        return len({site.channel for site in self.pattern.sites}) == 1


@dataclass(frozen=True)
class Example:
    """One tile's used part, in units of its noise.

    Attributes:
        detail: what the network sees of the pictures.
        noise: sigma that the filter leaves, by band.
        missing: the scene less the picture of the tier ``balanced``: what the network should give.
        weight: a display's error per error.
    """

    detail: Float32[np.ndarray, "rows columns 9"]
    noise: Float32[np.ndarray, "half_rows half_columns 12"]
    missing: Float32[np.ndarray, "rows columns 3"]
    weight: Float32[np.ndarray, "rows columns 3"]


def drawn_kernels(rng: np.random.Generator) -> list[Float32[np.ndarray, "3 rows columns"]]:
    """Return kernels of simulated rigs at places drawn over their sensors."""
    found = []
    for name, count in _RIGS.items():
        for _ in range(count):
            truth = draw_truth(load_rig(name), int(rng.integers(1000, 2**31)))
            camera, captures = truth.description.camera, truth.description.captures
            at = rng.uniform(0.02, 0.98, 2) * (camera.columns, camera.rows)
            size = captures.psf_region_rows + 1, captures.psf_region_columns + 1
            whole = captured_light(truth, at, *(min(a, b) for a, b in zip(size, _LARGEST, strict=True)))
            found.append(_stretched(whole, rng))
    return found


def _stretched(
    kernels: Float[np.ndarray, "3 rows columns"], rng: np.random.Generator
) -> Float32[np.ndarray, "3 rows columns"]:
    factors, (rows, columns) = np.exp(rng.uniform(*np.log(_STRETCH), 2)), kernels.shape[1:]
    # About the middle sample, which stays there.
    move = np.array([[1 / factors[1], 0, 0], [0, 1 / factors[0], 0]])
    move[:, 2] = (np.array([columns // 2, rows // 2])) - move[:, :2] @ (columns // 2, rows // 2)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    # Averaged first where it shrinks.
    wide = [cv2.GaussianBlur(k, (0, 0), 0.3) if factors.min() < 1 else k for k in kernels]
    moved = np.stack([cv2.warpAffine(k, move, (columns, rows), flags=flags) for k in wide])
    return (moved / moved.sum(axis=(1, 2), keepdims=True)).astype(np.float32)


class Examples:
    """Draws examples without end."""

    def __init__(self, optics: list[Optics], pictures: Pictures, seed: int) -> None:
        self._optics, self._photographs, self._rng = optics, pictures, np.random.default_rng(seed)

    def draw(self) -> Example:
        """Draw one."""
        rng = self._rng
        optics = self._optics[rng.integers(len(self._optics))]
        gains = np.ones(3) if optics.grey else rng.uniform(0.4, 1.0, 3)
        white = (np.exp(rng.uniform(np.log(300), np.log(15000))) * gains).astype(np.float32)
        lit = isinstance(optics.pattern, Cfa) and rng.uniform() < _LIT
        scene = self._scene(optics.grey) * (_lamps(_CANVAS_PX, rng)[..., None] if lit else 1.0) * white
        panel = white * rng.uniform(0, 1.5) ** 2 * (1.0 if optics.grey else rng.uniform(0.8, 1.2, 3))
        most_e = float(white.max() * rng.uniform(1.0, 1.4)) if lit else np.inf
        tile, variance = _samples(scene, optics, panel, rng.uniform(1.0, 6.0), most_e, rng)
        noise_e = np.sqrt(variance.mean(axis=(1, 2)))[None]
        given = optics.tables, optics.layout, optics.pattern
        if lit:
            tile = _clipped(tile, most_e, noise_e, given)
        chosen, strength = filtered_and_joined(tile[None], noise_e, *given)
        sharp, _ = filtered_and_joined(tile[None], noise_e, *given, sharper(strength))
        first = (_CANVAS_PX - _TILE_PX) // 2 - optics.layout.tops[0]
        truth = scene[first : first + _USED_PX, first : first + _USED_PX]
        first = -optics.layout.tops[0]
        local = cv2.blur(variance.mean(axis=0), _LOCAL_PX)[first : first + _USED_PX, first : first + _USED_PX]
        bands = optics.noise.of_tiles(strength)
        balanced = shrunk(chosen, noise_e, local, bands, optics.layout, 1)
        weight = _display_slope(cv2.blur(truth, (5, 5)) / white) * noise_e[0] / white
        inner = slice(INNER_PX)
        return Example(
            details(balanced, chosen, sharp, noise_e[0])[inner, inner],
            noise_planes(bands, noise_e, local, optics.layout)[: INNER_PX // 2, : INNER_PX // 2],
            ((truth - balanced) / noise_e[0])[inner, inner],
            weight.astype(np.float32)[inner, inner],
        )

    def _scene(self, grey: bool) -> Float32[np.ndarray, "canvas canvas 3"]:
        """Draw a picture in linear light, white being 1."""
        rng = self._rng
        if rng.uniform() < _DRAWN:
            picture = drawn_picture(_CANVAS_PX, rng)
        else:
            whole = self._photographs[rng.integers(len(self._photographs))]
            least = _CANVAS_PX / min(whole.shape[:2])
            larger = float(np.exp(rng.uniform(np.log(0.6), np.log(3.6))))
            size = int(_CANVAS_PX / max(larger, least))
            top, left = (int(rng.integers(extent - size + 1)) for extent in whole.shape[:2])
            part = whole[top : top + size, left : left + size]
            how = cv2.INTER_AREA if size > _CANVAS_PX else cv2.INTER_CUBIC
            picture = np.maximum(cv2.resize(part, (_CANVAS_PX, _CANVAS_PX), interpolation=how), 0.0)
        picture = np.repeat(picture.mean(axis=2, keepdims=True), 3, axis=2) if grey else picture
        turned = picture[:: rng.choice([-1, 1]), :: rng.choice([-1, 1])]
        return np.ascontiguousarray(turned[..., rng.permutation(3)] if rng.uniform() < 0.3 else turned)


def _clipped(
    tile: Float32[np.ndarray, "tile tile"],
    most_e: float,
    noise_e: Float32[np.ndarray, "1 3"],
    given: tuple[Tables, TileLayout, Pattern],
) -> Float32[np.ndarray, "tile tile"]:
    """Clip a tile, and complete it as restoration does."""
    held = np.minimum(tile, np.float32(most_e))
    tables, layout, pattern = given
    return completed(held, tile > most_e, noise_e[0], tables.at(0), layout, pattern, THOROUGH)


def _lamps(size: int, rng: np.random.Generator) -> Float32[np.ndarray, "size size"]:
    """Return factors of the light: large within a few ellipses, their edges as sharp as a picture's."""
    factors = np.ones((size, size), dtype=np.float32)
    for _ in range(int(rng.integers(1, 6))):
        at, axes = rng.uniform(0.2 * size, 0.8 * size, 2), np.exp(rng.uniform(np.log(2), np.log(40), 2))
        brighter = float(np.exp(rng.uniform(np.log(2), np.log(200))))
        cv2.ellipse(
            factors, np.rint(at).astype(int), np.rint(axes).astype(int), rng.uniform(0, 180), 0, 360, brighter, -1
        )
    return cv2.GaussianBlur(factors, (0, 0), 0.6)


def _samples(
    scene: Float32[np.ndarray, "canvas canvas 3"],
    optics: Optics,
    panel_e: Float[np.ndarray, "3"],
    read_e: float,
    most_e: float,
    rng: np.random.Generator,
) -> tuple[Float32[np.ndarray, "*colours tile tile"], Float32[np.ndarray, "3 tile tile"]]:
    """Return the middle of what the sensor sees without the panel's light, with noise, and the noise's variance.

    Light beyond ``most_e`` will clip; it has no more noise than that.
    """
    transfer = fft.rfft2(np.stack([centred(k, _CANVAS_PX, _CANVAS_PX) for k in optics.kernels]).astype(np.float32))
    blurred = fft.irfft2(fft.rfft2(np.moveaxis(scene, -1, 0)) * transfer, s=scene.shape[:2])
    first = (_CANVAS_PX - _TILE_PX) // 2
    middle = blurred[:, first : first + _TILE_PX, first : first + _TILE_PX]
    variance = (np.clip(middle, 0, most_e) + panel_e[:, None, None] + read_e**2).astype(np.float32)
    noisy = (middle + np.sqrt(variance) * rng.standard_normal(middle.shape, dtype=np.float32)).astype(np.float32)
    if not isinstance(optics.pattern, Cfa):
        return noisy, variance
    channels = optics.pattern.channel_map(_TILE_PX, _TILE_PX)
    return np.ascontiguousarray(np.take_along_axis(noisy, channels[None], axis=0)[0]), variance


def _display_slope(light: Float32[np.ndarray, "rows columns 3"]) -> Float32[np.ndarray, "rows columns 3"]:
    """Return the slope of sRGB's encoding; what is brighter than white counts little, as a display clips it."""
    slope = 1.055 / 2.4 * np.maximum(light, 0.004) ** np.float32(1 / 2.4 - 1)
    return np.where(light > 1.0, np.float32(0.1), slope)


def patch(example: tuple[np.ndarray, ...], rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """Cut a patch, at whole places of the coarse level, and mirror it."""
    y, x = (4 * int(rng.integers((INNER_PX - PATCH_PX) // 4 + 1)) for _ in range(2))
    down, across = rng.choice([-1, 1], 2)
    parts = []
    for index, array in enumerate(example):
        step = 2 if index == 1 else 1
        cut = array[y // step : (y + PATCH_PX) // step, x // step : (x + PATCH_PX) // step]
        parts.append(cut[::down, ::across])
    return tuple(parts)
