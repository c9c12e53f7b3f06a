"""How the light of an even field is spread over the sensor, and how noisy samples of it are."""

from __future__ import annotations

from typing import final

import jax
import numpy as np
from jaxtyping import Float, Int
from scipy.ndimage import map_coordinates

from udccal.cfa import cell_channels
from udccal.models.wire import Wire, wire_values
from udccal.numerics import in_float64
from udccal.planning.state import WHITE, RigState

# Shading is smooth; the ripple of rows on top of it hardly matters to how many electrons there are.
_GRID = (49, 65)
_wire_values = jax.jit(wire_values, static_argnums=(2, 3))


@final
class EvenField:
    """An even white field as one rig sees it, 1 at its brightest: as the wire measured it, or the cos^4 law."""

    def __init__(self, state: RigState) -> None:
        camera = state.rig.camera
        self._size = np.array([camera.columns, camera.rows])
        self._cell = np.asarray(cell_channels(camera.cfa), dtype=np.int64)
        y, x = (np.linspace(0, size - 1, count) for size, count in zip(self._size[::-1], _GRID, strict=True))
        pixels = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        values = _by_field_angle(state, pixels) if state.wire is None else _by_wire(state.wire, pixels, *self._size)
        self._grid = (values / values.max()).reshape(_GRID)

    def at(self, pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
        """Light at pixels, by linear interpolation."""
        places = (pixels / (self._size - 1) * (np.array(_GRID[::-1]) - 1)).T[::-1]
        return np.asarray(map_coordinates(self._grid, places, order=1, mode="nearest"))

    def channels(self, pixels: Float[np.ndarray, "n 2"]) -> Int[np.ndarray, " n"]:
        """Colour (0, 1, 2 for R, G, B) of the samples at pixels."""
        x, y = np.round(pixels).astype(np.int64).T
        return np.asarray(self._cell[y % 2, x % 2])

    def signal(self, pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
        """What samples of a white field give, 1 for the brightest of all."""
        return np.asarray(self.at(pixels) * (np.array(WHITE) / max(WHITE))[self.channels(pixels)])


def _by_field_angle(state: RigState, pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
    ideal = (pixels - np.asarray(state.geometry.centre)) / np.asarray(state.geometry.focal)
    return np.asarray((1 + (ideal**2).sum(axis=1)) ** -2.0)


@in_float64
def _by_wire(wire: Wire, pixels: Float[np.ndarray, "n 2"], columns: int, rows: int) -> Float[np.ndarray, " n"]:
    return np.asarray(_wire_values(wire, pixels, int(rows), int(columns)), dtype=np.float64)


def sample_variance_e(state: RigState, signal_e: Float[np.ndarray, "*n"], exposure_s: float) -> Float[np.ndarray, "*n"]:
    """Temporal variance of single samples in e-^2 (EMVA 1288: shot, dark current, dark noise, quantisation)."""
    noise = state.noise
    K, q_DN, sigma_d = (float(np.asarray(part)) for part in (noise.K_DN_per_e, noise.q_DN, noise.sigma_d_e))
    dark = float(np.asarray(noise.dark_current_e_per_s)) * exposure_s
    return np.asarray(np.maximum(signal_e, 0.0) + dark + sigma_d**2 + (q_DN / K) ** 2 / 12)
