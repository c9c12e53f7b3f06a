"""Light of a small distant source behind the panel of a drawn rig: |FT of the open pupil|^2 over the spectrum.

The field behind the panel is the footprint times the openings. Its power at the spatial frequency nu (cycles per mm)
goes to the direction cosines l0 + lambda nu (Goodman, Introduction to Fourier Optics, section 3.10).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.fft
from scipy.ndimage import map_coordinates, spline_filter
from scipy.special import j1

from tests.benchmarks.drawn_rigs.draw import Rig
from tests.benchmarks.drawn_rigs.openings import openings
from tests.benchmarks.drawn_rigs.optics import directions, footprint

# Cells of the spread per pixel, points per pixel along each side, zeros around the footprint, and nodes kept below 0.
# Orders of few rows are lines of a fifteenth of a pixel: coarser cells and points made kernels wrong by 5 %.
_CELLS, _POINTS, _PADDING, _HEADROOM, _BELOW = 16, 8, 2.0, 1.1, 12


@dataclass(frozen=True)
class Spread:
    """Light by direction cosines relative to a source: spline coefficients of the power in even cells, by colour."""

    cell: float
    power: np.ndarray


def spread_of(rig: Rig, source_px: np.ndarray, reach_px: tuple[float, float], disc_px: float = 0.0) -> Spread:
    """The spread of a source whose image is a disc, out to ``reach_px`` (x, y); it serves sources close by, too."""
    ray = directions(rig, source_px)
    unit = 1.0 / rig.lens.focal_px.mean()
    cell, count = unit / _CELLS, [int(np.ceil((px + 4) * _CELLS)) for px in reach_px]
    limit = np.array(count) * cell / (rig.wavelengths_nm[0] * 1e-6)
    below, step = _power_below(rig, ray, limit)
    total = np.zeros((3, count[1] + 1, 2 * count[0] + 1))
    for nm, band, weight in zip(rig.wavelengths_nm, np.gradient(rig.wavelengths_nm), rig.spectrum.T, strict=True):
        width, of_node = (cell, band / nm), nm * 1e-6 * step
        columns = _between(below, cell * np.arange(-count[0], count[0] + 1), width, of_node[0], below.shape[0] // 2)
        # Rows from the source's own on: power is the same on both sides of the source.
        rows = _between(columns.T, cell * np.arange(count[1] + 1), width, of_node[1], _BELOW)
        total += rows * weight[:, None, None]
    whole = np.concatenate([total[:, :0:-1, ::-1], total], axis=1)
    blurred = (_blurred(rig, one, source_px, c, disc_px) for c, one in enumerate(whole))
    return Spread(cell, np.stack([spline_filter(one, order=3) for one in blurred]))


def light(rig: Rig, spread: Spread, source_px: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Part of a source's light on pixels of columns ``x`` and rows ``y``, by colour: rows x columns x 3.

    Args:
        rig: the rig.
        spread: of this source, or of one nearby.
        source_px: (x, y) of its image.
        x, y: evenly spaced by 1.
    """
    _, rows, columns = spread.power.shape
    fine = [(np.arange(len(p) * _POINTS) + 0.5) / _POINTS + p[0] - 0.5 for p in (x, y)]
    points = directions(rig, np.stack(np.meshgrid(*fine), axis=-1))[..., :2] - directions(rig, source_px)[:2]
    at = [points[..., 1] / spread.cell + rows // 2, points[..., 0] / spread.cell + columns // 2]
    down, across = (np.gradient(points, axis=axis) for axis in (0, 1))
    area = np.abs(down[..., 1] * across[..., 0] - down[..., 0] * across[..., 1]) / spread.cell**2
    found = [map_coordinates(one, at, order=3, mode="constant", prefilter=False) * area for one in spread.power]
    parts = np.stack(found, axis=-1).reshape(len(y), _POINTS, len(x), _POINTS, 3)
    return np.maximum(parts.sum(axis=(1, 3)), 0.0)


def kernel(rig: Rig, place_px: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """The kernel of a point imaged at its middle sample's middle, colour x rows x columns; each colour sums to 1."""
    place = np.asarray(place_px, float)
    spread = spread_of(rig, place, (columns / 2 + 1, rows / 2 + 1))
    x, y = (at + np.arange(count) - count // 2 for at, count in zip(place, (columns, rows), strict=True))
    found = np.moveaxis(light(rig, spread, place, x, y), -1, 0)
    return found / found.sum(axis=(1, 2), keepdims=True)


def _power_below(rig: Rig, ray: np.ndarray, limit: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Power up to nodes of nu_x (axis 0, its middle is 0) and of nu_y (from a few below 0 on); steps (x, y) per mm."""
    centre, shape = footprint(rig, ray)
    half, step = np.linalg.norm(shape, axis=1), 0.5 / (_HEADROOM * limit)
    samples = [np.arange(-np.ceil(h / s) - 1, np.ceil(h / s) + 2) * s for h, s in zip(half, step, strict=True)]
    size = [scipy.fft.next_fast_len(int(_PADDING * len(one)) // 2) * 2 for one in samples]
    pitch = rig.true("pitch_mm")
    highest = [int(pitch / (2 * s)) for s in step]
    opened = openings(rig.shape, tuple(ray[:2] / ray[2])).coefficients(highest[1], highest[0])
    waves = [
        np.exp(2j * np.pi * np.outer((one + c) / pitch - o, np.arange(-h, h + 1)))
        for one, c, o, h in zip(samples, centre, rig.shape.offset, highest, strict=True)
    ]
    mask = (waves[0] @ opened.T @ waves[1].T).real
    field = (mask * _covered(samples, shape, step)).astype(np.float32)
    power = np.abs(scipy.fft.rfft2(field, s=size)) ** 2
    # The other half is this one turned about 0.
    turned = np.roll(power[::-1], 1, axis=0)[:, _BELOW:0:-1]
    power = scipy.fft.fftshift(np.concatenate([turned, power], axis=1), axes=0)
    below = np.zeros((power.shape[0] + 1, power.shape[1] + 1))
    np.cumsum(np.cumsum(power, axis=1, dtype=np.float64), axis=0, out=below[1:, 1:])
    return below / float((field.astype(np.float64) ** 2).sum() * size[0] * size[1]), 1 / (np.array(size) * step)


def _covered(samples: list[np.ndarray], shape: np.ndarray, step: np.ndarray) -> np.ndarray:
    """The part of each sample's cell that is inside the ellipse; x along axis 0."""
    (a, b), (c, d) = np.linalg.inv(shape)
    x, y = samples[0][:, None], samples[1]
    u, v = a * x + b * y, c * x + d * y
    radius = np.maximum(np.hypot(u, v), 1e-9)
    cell = (np.abs(a * u + c * v) * step[0] + np.abs(b * u + d * v) * step[1]) / radius
    return np.clip(0.5 - (radius - 1) / np.maximum(cell, 1e-12), 0, 1)


def _between(
    below: np.ndarray, middle: np.ndarray, width: tuple[float, float], per_node: float, zero: int
) -> np.ndarray:
    """Power in cells about ``middle`` along axis 0; a band of wavelengths smears each by the second of ``width``."""
    window = np.hypot(width[0], middle * width[1])
    found = np.zeros((len(middle), below.shape[1]))
    for sign in (1, -1):
        # Node ``zero`` is where the sample of frequency 0 begins.
        node = np.clip((middle + sign * window / 2) / per_node + zero + 0.5, 0, len(below) - 1.001)
        first, part = node.astype(int), (node % 1)[:, None]
        found += sign * (below[first] * (1 - part) + below[first + 1] * part)
    return found * (width[0] / window)[:, None]


def _blurred(rig: Rig, power: np.ndarray, source_px: np.ndarray, colour: int, disc_px: float) -> np.ndarray:
    """One colour of the spread after the lens's further blur and over the source's disc, which are round on the sensor.

    Power is over direction cosines of the panel: their frequencies become the sensor's by the source's own Jacobian.
    """
    rows, columns = power.shape
    size = [scipy.fft.next_fast_len(n + 8 * _CELLS) for n in (rows, columns)]
    nu = np.stack(np.meshgrid(scipy.fft.rfftfreq(size[1]), scipy.fft.fftfreq(size[0])), axis=-1)
    steps = np.concatenate([np.eye(2), -np.eye(2)]) / 2
    right, below, left, above = directions(rig, source_px + steps)[:, :2]
    per_px = np.stack([right - left, below - above], axis=1)
    nu = np.linalg.norm(nu @ per_px, axis=-1) * _CELLS * rig.lens.focal_px.mean()
    z = np.maximum(np.pi * disc_px * nu, 1e-9)
    field = np.linalg.norm((source_px - rig.lens.centre_px) / [rig.columns / 2, rig.rows / 2]) / np.sqrt(2)
    sigma = rig.lens.blur_px[colour] * (1 + rig.lens.blur_growth * field**2)
    transfer = np.exp(-2 * (np.pi * nu * sigma) ** 2) * 2 * j1(z) / z
    return scipy.fft.irfft2(scipy.fft.rfft2(power, s=size) * transfer, s=size)[:rows, :columns]
