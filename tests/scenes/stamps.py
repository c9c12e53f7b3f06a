"""Stamps of point sources whose psf is of any shape, drawn from wide families; the truth is known in closed form."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float

from udccal.fitting.psf_stamps.data import Stamps
from udccal.fitting.psf_stamps.term import StampsPsf

SENSOR = np.array([2000.0, 1500.0])

# Light per pixel at (u, v) px from the middle of the light, for a position scaled to about [-1, 1].
Density = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
Round = Callable[[np.ndarray, np.ndarray], np.ndarray]

# Gauss's abscissae and weights: pixels integrate light.
_INSIDE = np.array([-0.5, 0.0, 0.5]) * np.sqrt(0.6)
_PART = np.array([5.0, 8.0, 5.0]) / 18.0


@final
@dataclass(frozen=True)
class Shape:
    """A psf that varies over the field.

    Attributes:
        name: of its family.
        grid: light at samples of (u, v), given as an axis each: columns u, rows v.
    """

    name: str
    grid: Density

    def kernel(self, position_px: np.ndarray, shift_px: np.ndarray, size: int) -> Float[np.ndarray, "size size"]:
        """Integrate over pixels of a stamp whose light is ``shift_px`` (x, y) from the middle sample."""
        middle = np.arange(size)[:, None] - size // 2 + _INSIDE
        light = self.grid((middle - shift_px[0]).ravel(), (middle - shift_px[1]).ravel(), 2 * position_px / SENSOR - 1)
        return np.einsum("iajb,a,b->ij", light.reshape(size, 3, size, 3), _PART, _PART)

    def centred(self, term: StampsPsf, position_px: np.ndarray) -> Float[np.ndarray, "rows columns"]:
        """Return the truth in a term's convention: it sums to 1, its centroid under the term's Gaussian is zero."""
        v, u = np.mgrid[: term.rows, : term.columns] - term.rows // 2
        weight, shift, step = np.exp(-0.5 * (u**2 + v**2) / term.window_px**2), np.zeros(2), 1e-3

        def centroid(shift: np.ndarray) -> np.ndarray:
            light = weight * self.kernel(position_px, shift, term.rows)
            return np.array([(u * light).sum(), (v * light).sum()]) / light.sum()

        for _ in range(12):
            at = centroid(shift)
            slope = np.stack([(centroid(shift + step * e) - at) / step for e in np.eye(2)], axis=1)
            shift = shift - np.clip(np.linalg.solve(slope, at), -0.5, 0.5)
        found = self.kernel(position_px, shift, term.rows)
        return np.asarray(found / found.sum())


def shape(name: str, rng: np.random.Generator, varies: float = 1.0) -> Shape:
    """Draw a shape of a family; ``varies`` scales its change over the field."""
    if name in _PUPILS:
        return Shape(name, _PUPILS[name](rng, varies))
    return Shape(name, _gridded(_FORMS[name](rng, varies)))


def _gridded(density: Density) -> Density:
    return lambda u, v, at: density(*np.meshgrid(u, v), at)


def _stretched(rng: np.random.Generator, varies: float, density: Round) -> Density:
    """Stretch a shape towards the corners, with a tilt over the field."""
    radial, around, tilt = varies * rng.uniform([0.0, 0.0, -0.08], [0.15, 0.2, 0.08])

    def light(u: np.ndarray, v: np.ndarray, at: np.ndarray) -> np.ndarray:
        scale = np.eye(2) * (1 + radial * (at @ at) + tilt * at[0]) + around * np.outer(at, at)
        inverse = np.linalg.inv(scale)
        p, q = inverse[0, 0] * u + inverse[0, 1] * v, inverse[1, 0] * u + inverse[1, 1] * v
        return np.asarray(density(p, q) / np.linalg.det(scale))

    return light


def _gauss(rng: np.random.Generator, varies: float) -> Density:
    s = rng.uniform(1.0, 2.5)
    return _stretched(rng, varies, lambda u, v: np.exp(-0.5 * (u**2 + v**2) / s**2) / (2 * np.pi * s**2))


def _undersampled(rng: np.random.Generator, varies: float) -> Density:
    s = rng.uniform(0.35, 0.6)
    return _stretched(rng, varies, lambda u, v: np.exp(-0.5 * (u**2 + v**2) / s**2) / (2 * np.pi * s**2))


def _moffat(rng: np.random.Generator, varies: float) -> Density:
    a, b = rng.uniform([1.2, 2.0], [2.5, 4.0])
    return _stretched(rng, varies, lambda u, v: (b - 1) / (np.pi * a**2) * (1 + (u**2 + v**2) / a**2) ** -b)


def _diffraction(rng: np.random.Generator, varies: float) -> Density:
    """Orders of rows and columns of openings, whose strength changes over the field, and a halo."""
    a, away = rng.uniform([1.8, 4.5], [3.0, 7.0])
    strength, change = rng.uniform(0.01, 0.06, 3), varies * rng.uniform(-0.4, 0.4, 3)
    halo = rng.uniform(0.0, 0.02)

    def core(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        return np.asarray(np.sinc(u / a) ** 2 * np.sinc(v / a) ** 2 / a**2)

    def light(u: np.ndarray, v: np.ndarray, at: np.ndarray) -> np.ndarray:
        out = core(u, v) + halo / a**2 * (1 + (u**2 + v**2) / 16) ** -1.5
        for s in (-1.0, 1.0):
            out += strength[0] * (1 + change[0] * s * at[0]) * core(u - s * away, v)
            out += strength[1] * (1 + change[1] * s * at[1]) * core(u, v - s * away)
            out += 0.3 * strength[2] * (1 + change[2] * at[0] * at[1]) * core(u - 2 * s * away, v)
        return out

    return lambda u, v, at: _tilted(light, 0.15 * varies, u, v, at)


def _tilted(light: Density, radial: float, u: np.ndarray, v: np.ndarray, at: np.ndarray) -> np.ndarray:
    scale = 1 + radial * (at @ at)
    return np.asarray(light(u / scale, v / scale, at) / scale**2)


_FORMS = {"gauss": _gauss, "undersampled": _undersampled, "moffat": _moffat, "diffraction": _diffraction}

_ACROSS, _COLOURS = 33, (0.94, 1.0, 1.06)


def _pupil(lens: float, obstruction: float, waves: Density) -> Density:
    """Light behind a round pupil with a wavefront error in waves; ``lens`` is wavelength times f-number in px."""
    y, x = np.mgrid[-1 : 1 : _ACROSS * 1j, -1 : 1 : _ACROSS * 1j]
    radius = np.hypot(x, y)
    # A soft edge, so that the grid does not show.
    open_ = np.clip((1 - radius) * _ACROSS / 2 + 0.5, 0, 1) * np.clip((radius - obstruction) * _ACROSS / 2 + 0.5, 0, 1)
    axis = x[0]

    def light(u: np.ndarray, v: np.ndarray, at: np.ndarray) -> np.ndarray:
        field, out = open_ * np.exp(2j * np.pi * waves(x, y, at)), 0.0
        for colour in _COLOURS:
            by_u, by_v = (np.exp(-1j * np.pi * np.outer(part, axis) / (lens * colour)) for part in (u, v))
            out = out + np.abs(by_v @ field @ by_u.T) ** 2 / colour**2
        step = axis[1] - axis[0]
        return np.asarray(out * step**2 / (4 * lens**2 * (open_**2).sum() * len(_COLOURS)))

    return light


def _airy(rng: np.random.Generator, varies: float) -> Density:
    curved = varies * rng.uniform(-0.2, 0.2)
    lens = rng.uniform(1.6, 3.0)
    return _pupil(lens, 0.0, lambda x, y, at: curved * (at @ at) * (x**2 + y**2))


def _coma(rng: np.random.Generator, varies: float) -> Density:
    size, (axis_x, axis_y) = varies * rng.uniform(0.4, 0.9), rng.uniform(-0.2, 0.2, 2)

    def waves(x: np.ndarray, y: np.ndarray, at: np.ndarray) -> np.ndarray:
        along = (at[0] - axis_x) * x + (at[1] - axis_y) * y
        return np.asarray(size * along * (x**2 + y**2 - 2 / 3))

    return _pupil(rng.uniform(1.6, 2.5), 0.0, waves)


def _astigmatism(rng: np.random.Generator, varies: float) -> Density:
    size, curved = varies * rng.uniform([0.2, -0.2], [0.5, 0.2])

    def waves(x: np.ndarray, y: np.ndarray, at: np.ndarray) -> np.ndarray:
        return np.asarray(size * (at[0] * x + at[1] * y) ** 2 + curved * (at @ at) * (x**2 + y**2))

    return _pupil(rng.uniform(1.6, 2.5), 0.0, waves)


def _donut(rng: np.random.Generator, varies: float) -> Density:
    """Out of focus behind an obstruction; the focus changes over the field."""
    size, obstruction = rng.uniform([0.7, 0.25], [1.3, 0.4])
    tilt, curved = varies * rng.uniform(-0.25, 0.25, 2)
    waves = lambda x, y, at: (size + tilt * at[0] + curved * (at @ at)) * (x**2 + y**2)  # noqa: E731
    return _pupil(rng.uniform(1.4, 2.0), obstruction, waves)


_PUPILS = {"airy": _airy, "coma": _coma, "astigmatism": _astigmatism, "donut": _donut}
SHAPES = (*_FORMS, *_PUPILS)


@final
@dataclass(frozen=True)
class Drawn:
    """Stamps and their truth.

    Attributes:
        position_px: of the sources.
        background_e: light in every sample of a stamp that is not the source's.
        light_e: of the sources.
    """

    shape: Shape
    stamps: Stamps
    position_px: Float[np.ndarray, "stars 2"]
    background_e: Float[np.ndarray, " stars"]
    light_e: Float[np.ndarray, " stars"]

    def held_out(self, count: int = 12) -> Float[np.ndarray, "count 2"]:
        """Return places between the stamps."""
        return np.random.default_rng(99).uniform(0.12, 0.88, (count, 2)) * SENSOR

    def errors(self, term: StampsPsf, count: int = 12) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return relative L2 errors of held-out kernels, those stated, and every pixel's error over its sigma."""
        places = self.held_out(count)
        truth = np.array([self.shape.centred(term, p) for p in places])
        off, sigma = term.predict(places) - truth, term.sigma(places)
        size = np.linalg.norm(truth, axis=(1, 2))
        return np.linalg.norm(off, axis=(1, 2)) / size, np.linalg.norm(sigma, axis=(1, 2)) / size, off / sigma


def drawn(
    name: str,
    seed: int,
    count: int = 60,
    size: int = 31,
    light_e: float = 1e5,
    read_e: float = 4.0,
    background_e: tuple[float, float] = (0.0, 0.0),
    varies: float = 1.0,
) -> Drawn:
    """Draw stamps of a family; the background is a mean over stamps and its scatter from stamp to stamp."""
    rng = np.random.default_rng([seed, SHAPES.index(name)])
    own = shape(name, rng, varies)
    across = int(np.ceil(np.sqrt(4 / 3 * count)))
    down = -(-count // across)
    grid = np.stack(np.meshgrid(np.arange(across), np.arange(down)), axis=-1).reshape(-1, 2)[:count]
    position = (grid + 0.5 + rng.uniform(-0.3, 0.3, grid.shape)) / [across, down] * SENSOR
    middle = np.rint(position).astype(np.int64)
    light = light_e * rng.uniform(0.5, 1.5, count)
    background = background_e[0] + background_e[1] * rng.standard_normal(count)
    clean = np.array([own.kernel(p, p - m, size) for p, m in zip(position, middle, strict=True)])
    mean = light[:, None, None] * clean + background[:, None, None]
    noisy = rng.poisson(np.maximum(mean, 0.0)) + np.minimum(mean, 0.0) + read_e * rng.standard_normal(mean.shape)
    return Drawn(own, Stamps(noisy, middle, read_e), position, background, light)
