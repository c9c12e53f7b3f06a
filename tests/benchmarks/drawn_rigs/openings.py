"""The open part of a panel's period as lines of intervals; what is made of it: Fourier coefficients and areas."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tests.benchmarks.drawn_rigs.draw import Shape

LINES, _NODES = 1024, 256


@dataclass(frozen=True)
class Openings:
    """Of one period, from -1/2 to 1/2: on each of ``LINES`` lines along x, two intervals and the line's open part."""

    begin: np.ndarray
    end: np.ndarray
    part: np.ndarray

    @property
    def lines(self) -> np.ndarray:
        """y of the lines' middles."""
        return (np.arange(LINES) + 0.5) / LINES - 0.5

    def coefficients(self, highest_y: int, highest_x: int) -> np.ndarray:
        """C[m, n] of the Fourier series of the open part, sum C exp(2 pi i (n x + m y)), from -highest to highest."""
        n = np.arange(-highest_x, highest_x + 1)
        wave = -2j * np.pi * np.where(n == 0, 1, n)
        across = (np.exp(wave * self.end[..., None]) - np.exp(wave * self.begin[..., None])) / wave
        across = np.where(n == 0, (self.end - self.begin)[..., None], across).sum(axis=0)
        m = np.arange(-highest_y, highest_y + 1)
        down = np.exp(-2j * np.pi * m[:, None] * self.lines) * self.part / LINES
        return down @ across

    def table(self) -> np.ndarray:
        """Open area of the period above and left of nodes: LINES + 1 in y, ``_NODES`` + 1 in x."""
        x = np.linspace(-0.5, 0.5, _NODES + 1)
        along = np.clip(x - self.begin[..., None], 0.0, (self.end - self.begin)[..., None]).sum(axis=0)
        area = np.cumsum(along * self.part[:, None] / LINES, axis=0)
        return np.concatenate([np.zeros((1, _NODES + 1)), area])


def openings(shape: Shape, slope: tuple[float, float]) -> Openings:
    """What is open for rays of a slope: they pass the opening, and the same one moved by the depth times the slope."""
    dx, dy = shape.depth[0] * slope[0], shape.depth[1] * slope[1]
    y = (np.arange(LINES) + 0.5) / LINES - 0.5
    half = shape.height / 2
    part = _overlap(y, max(-half, -half - dy), min(half, half - dy))
    (left, right), (far_left, far_right) = _edges(shape, y), _edges(shape, y + dy)
    left, right = np.maximum(left, far_left - dx), np.minimum(right, far_right - dx)
    # The line through the opening has two shadows, which touch or overlap.
    first, last = (shape.trace_at + side * shape.trace / 2 for side in (-1, 1))
    if shape.upright and shape.trace:
        first, last = min(first, first - dx), max(last, last - dx)
    elif shape.trace:
        part = part - np.minimum(part, _overlap(y, min(first, first - dy), max(last, last - dy)))
        first = last = 0.0
    else:
        first = last = 0.0
    begin, end = np.stack([left, np.maximum(left, last)]), np.stack([np.minimum(right, first), right])
    return Openings(begin, np.maximum(begin, end), part)


def _edges(shape: Shape, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Left and right edge of the opening on lines at y, beyond its own height as at its ends."""
    half = shape.height / 2
    y = np.clip(y, -half, half)
    wide = shape.width / 2 + shape.slant / 2 * y / half
    if shape.corner:
        into = np.clip((np.abs(y) - (half - shape.corner)) / shape.corner, 0.0, 1.0)
        wide = wide - shape.corner * (1 - np.sqrt(1 - into**2))
    return -wide, wide


def _overlap(y: np.ndarray, low: float, high: float) -> np.ndarray:
    """Part of each line between ``low`` and ``high``."""
    edges = np.minimum(y + 0.5 / LINES, high) - np.maximum(y - 0.5 / LINES, low)
    return np.clip(edges * LINES, 0.0, 1.0)


def area_below(table: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Open area above and left of points (in periods) of the whole panel, up to a constant that rectangles cancel."""
    i, j = np.floor(x + 0.5), np.floor(y + 0.5)
    across, down = (x + 0.5 - i) * (table.shape[1] - 1), (y + 0.5 - j) * (table.shape[0] - 1)
    a, b = np.minimum(across.astype(int), table.shape[1] - 2), np.minimum(down.astype(int), table.shape[0] - 2)
    s, t = across - a, down - b
    flat, width = table.ravel(), table.shape[1]
    corner = b * width + a
    top = flat[corner] * (1 - s) + flat[corner + 1] * s
    bottom = flat[corner + width] * (1 - s) + flat[corner + width + 1] * s
    whole_rows = table[-1, a] * (1 - s) + table[-1, a + 1] * s
    whole_columns = table[b, -1] * (1 - t) + table[b + 1, -1] * t
    return top * (1 - t) + bottom * t + j * whole_rows + i * whole_columns + i * j * table[-1, -1]
