"""LED shots of a blur without diffraction, of known degree."""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Float
from scipy.special import ndtr

from udccal.cfa import cfa_named
from udccal.fitting.hdr.merge import HdrMerge
from udccal.fitting.psf.data import PsfRules, Shots, joined
from udccal.fitting.psf.image import Sources
from udccal.fitting.psf.orders import select_field
from udccal.fitting.psf.start import cut_crop
from udccal.models.fields import polynomial_basis, polynomial_terms
from udccal.numerics import in_float64

DEGREES: Final = (0, 1, 2)


_CFA: Final = "RGGB"


_HALF: Final = (12, 6)


_SENSOR_PX: Final = np.array([1024.0, 768.0])


_POSITIONS, _SHIFTS = (5, 4), 3


_SPARE: Final = 6


_DISC_PX: Final = 1.0


_FLUX: Final = 1e8 * np.array([0.7, 1.0, 0.6])


# Of the samples' noise: a part of the light, and e-/s.
_NOISE: Final = (0.003, 20.0)


# (light, sigma across, sigma down) of what a kernel is mixed from; how much of each, position by position, is drawn.
_CORE, _TAILS = (0.85, 0.9, 1.0), ((1.3, 3.5), (2.2, 1.6), (1.0, 4.5), (1.8, 2.6), (1.4, 1.2), (2.6, 3.0))


_MIXED: Final = 0.12


def chosen(degree: int, seed: int) -> int:
    """Degree of the image that is chosen; -1 where diffraction keeps a part."""
    rng = np.random.default_rng([seed, degree])
    mix = _MIXED * rng.choice([-1.0, 1.0], polynomial_terms(degree))
    return _select(_shots(mix, degree, rng))


def unit_of(place_px: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    """Positions scaled to about [-1, 1]."""
    half = (_SENSOR_PX - 1) / 2
    return (place_px - half) / half


@in_float64
def _select(shots: Shots) -> int:
    colour = np.eye(3)[shots.channel]
    light = np.einsum("syx,syxc->sc", shots.rate, colour) * [4.0, 2.0, 4.0]
    # Diffraction that is nothing like the kernel: an even disc.
    explained = np.full(shots.rate.shape, 1.0 / shots.rate[0].size)
    sources = Sources(shots.centre_px, light, np.zeros(shots.count))
    unit = unit_of(shots.positions_px())
    order = select_field(shots, sources, explained, unit, 0.0, PsfRules()).trial.order
    return order.degree if order.free else -1


def _shots(mix: Float[np.ndarray, " terms"], degree: int, rng: np.random.Generator) -> Shots:
    """Crops of LEDs all over the sensor whose kernel's tails are mixed by polynomials of the position."""
    x, y = (np.linspace(60, size - 60, n) for size, n in zip(_SENSOR_PX, _POSITIONS, strict=True))
    crops, aims = [], []
    for place in np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2).round():
        for _ in range(_SHIFTS):
            aim = place + rng.uniform(0, 2, 2)
            source = aim + rng.uniform(-1, 1, 2)
            rows, columns = (2 * (half + _SPARE) + 1 for half in _HALF)
            corner = (np.round(aim).astype(int) - [columns // 2, rows // 2]) // 2 * 2
            light = _light(source, corner, (rows, columns), mix, degree)
            rate = light * _FLUX[cfa_named(_CFA).channel_map(rows, columns)]
            sigma = np.hypot(_NOISE[0] * rate, _NOISE[1])
            seen = rate + sigma * rng.standard_normal(rate.shape)
            merged = HdrMerge(seen, sigma, np.ones(rate.shape, dtype=np.int64))
            at, aimed = (int(corner[0]), int(corner[1])), (float(aim[0]), float(aim[1]))
            crop = cut_crop(merged, at, aimed, _CFA, _HALF, _DISC_PX)
            assert crop is not None
            crops.append(crop)
            aims.append(aim)
    return joined(crops, np.array(aims))


def _light(
    source: Float[np.ndarray, "2"],
    corner: np.ndarray,
    size: tuple[int, int],
    mix: Float[np.ndarray, " terms"],
    degree: int,
) -> Float[np.ndarray, "rows columns"]:
    """Per unit of light: a core, and tails that take more or less of the rest as the position has it."""
    share, across, down = _CORE
    image = share * _gaussian(source, corner, size, across, down)
    basis = np.asarray(polynomial_basis(unit_of(source[None]), degree))[0]
    parts = [_gaussian(source, corner, size, *sigmas) for sigmas in _TAILS[: len(basis)]]
    even = _gaussian(source, corner, size, 1.6, 2.4)
    for value, part in zip(basis * mix, parts, strict=True):
        image = image + value * (part - even)
    return np.asarray(image + (1 - share) * even)


def _gaussian(
    source: Float[np.ndarray, "2"], corner: np.ndarray, size: tuple[int, int], across: float, down: float
) -> Float[np.ndarray, "rows columns"]:
    """A Gaussian blurred by the LED's disc, integrated over pixels."""
    y, x = (
        np.diff(ndtr((np.arange(n + 1) - 0.5 - at) / np.hypot(sigma, _DISC_PX / 4)))
        for n, at, sigma in ((size[0], source[1] - corner[1], down), (size[1], source[0] - corner[0], across))
    )
    return np.outer(y, x)
