"""Stamps of two Gaussians, one of them brighter towards one side: the truth is known, and not of the model's making."""

from __future__ import annotations

import numpy as np

from udccal.fitting.psf_stamps.data import Stamps
from udccal.fitting.psf_stamps.search import Orders
from udccal.fitting.psf_stamps.term import StampsPsf

SENSOR = np.array([1000, 800])
READ_E = 4.0
ORDERS = Orders(warp=2, image=1, spacing_px=1.0)


def kernel(position: np.ndarray, shift: np.ndarray, size: int, wider: float = 1.0) -> np.ndarray:
    """Two Gaussians; wider towards the corners, one of them brighter towards the right."""
    x, y = 2 * position / SENSOR - 1
    stretch = wider * (1 + 0.15 * (x * x + y * y))
    v, u = np.mgrid[:size, :size] - size // 2
    u, v = (u - shift[0]) / stretch, (v - shift[1]) / stretch
    core = np.exp(-0.5 * (u**2 + v**2) / 1.3**2) / (2 * np.pi * 1.3**2)
    lobe = np.exp(-0.5 * ((u - 3) ** 2 + v**2) / 1.5**2) / (2 * np.pi * 1.5**2)
    return (core + 0.1 * (1 + 0.4 * x) * lobe) / 1.1 / stretch**2


def places(rng: np.random.Generator, count: int) -> np.ndarray:
    """A jittered grid over the sensor."""
    across = int(np.ceil(np.sqrt(1.25 * count)))
    grid = np.stack(np.meshgrid(np.arange(across), np.arange(-(-count // across))), axis=-1).reshape(-1, 2)[:count]
    cells = np.array([across, -(-count // across)])
    return (grid + 0.5 + rng.uniform(-0.3, 0.3, grid.shape)) / cells * SENSOR


def make(seed: int, count: int = 30, size: int = 15, light_e: float = 1e5) -> tuple[Stamps, np.ndarray]:
    """Stamps and the shifts of their light."""
    rng = np.random.default_rng(seed)
    position = places(rng, count)
    middle = np.rint(position).astype(np.int64)
    light = light_e * rng.uniform(0.5, 1.5, count)
    values = [f * kernel(p, p - m, size) for f, p, m in zip(light, position, middle, strict=True)]
    noisy = rng.poisson(values) + READ_E * rng.standard_normal(np.shape(values))
    return Stamps(noisy, middle, READ_E), position - middle


def held_out_places() -> np.ndarray:
    return np.random.default_rng(99).uniform(0.1, 0.9, (12, 2)) * SENSOR


def centred(term: StampsPsf, position: np.ndarray, wider: float = 1.0) -> np.ndarray:
    """The truth in the term's convention: it sums to 1, its centroid under the term's Gaussian is zero."""
    v, u = np.mgrid[: term.rows, : term.columns] - term.rows // 2
    weight, shift = np.exp(-0.5 * (u**2 + v**2) / term.window_px**2), np.zeros(2)
    for _ in range(60):
        light = weight * kernel(position, shift, term.rows, wider)
        shift = shift - 1.5 * np.array([(u * light).sum(), (v * light).sum()]) / light.sum()
    found = kernel(position, shift, term.rows, wider)
    return found / found.sum()


def errors(term: StampsPsf) -> tuple[np.ndarray, np.ndarray]:
    """Of held-out kernels: relative L2, and every pixel in units of its sigma."""
    held_out = held_out_places()
    truth = np.array([centred(term, p) for p in held_out])
    off = term.predict(held_out) - truth
    return np.linalg.norm(off, axis=(1, 2)) / np.linalg.norm(truth, axis=(1, 2)), off / term.sigma(held_out)
