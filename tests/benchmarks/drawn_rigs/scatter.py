"""The panel's light in the lens of a drawn rig: defocused images of its emitters, directly and by way of the glass."""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.interpolate import RectBivariateSpline

from tests.benchmarks.drawn_rigs.draw import Rig
from tests.benchmarks.drawn_rigs.optics import directions, footprint, mosaic

# Grid positions per ripple of the panel's pixels, and points that make up an emitter along each side.
_PER_RIPPLE, _PER_SIDE = 7, 3


class Scatter:
    """Response to the panel's pictures, computed once on a grid of sensor positions."""

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        ripple_px = rig.lens.focal_px.mean() * rig.true("pitch_mm") / rig.true("standoff_mm")
        step = max(2, int(ripple_px / _PER_RIPPLE))
        self.x, self.y = (
            np.arange(-2 * step, count + 3 * step, step, dtype=float) for count in (rig.columns, rig.rows)
        )
        rays = directions(rig, np.stack(np.meshgrid(self.x, self.y), axis=-1).reshape(-1, 2))
        lobe, emission = rays[:, 2] ** rig.emission.lobe, rig.emission
        self._shares = [
            sparse.csr_array(
                _shares(rig, rays, primary, 0.0, lobe / (1 + emission.reflected))
                + _shares(
                    rig, rays, primary, emission.reflected_mm, lobe * emission.reflected / (1 + emission.reflected)
                )
            )
            for primary in range(3)
        ]

    def rate(self, picture: np.ndarray) -> np.ndarray:
        """e-/s of the mosaic while the panel shows an 8-bit RGB picture; the wire is not in it."""
        linear = (picture.reshape(-1, 3) / 255.0) ** self.rig.emission.gamma
        seen = np.stack([share @ linear[:, k] for k, share in enumerate(self._shares)])
        colours = (self.rig.emission.mix @ seen).reshape(3, self.y.size, self.x.size)
        at = np.arange(self.rig.rows), np.arange(self.rig.columns)
        fine = [RectBivariateSpline(self.y, self.x, one, kx=3, ky=3)(*at) for one in colours]
        return np.maximum(mosaic(self.rig, np.stack(fine, axis=-1)), 0.0)


def _shares(rig: Rig, rays: np.ndarray, primary: int, plane_mm: float, weight: np.ndarray) -> sparse.csr_array:
    """Matrix from panel pixels to rays: the part of each emitter inside a ray's footprint, about 1 in all."""
    pitch, emission = rig.true("pitch_mm"), rig.emission
    centre, shape = (part / pitch for part in footprint(rig, rays, plane_mm))
    inverse = np.linalg.inv(shape * np.array(emission.stretch))
    half = np.linalg.norm(shape, axis=-1).max(axis=0) * (1 + emission.edge) + 1.0
    columns, rows = rig.panel
    first = np.floor(centre - half).astype(int)
    spots = (np.arange(_PER_SIDE) + 0.5) / _PER_SIDE - 0.5
    spots = np.stack(np.meshgrid(spots, spots), axis=-1).reshape(-1, 2) * emission.sizes[primary]
    place, value, ray = [], [], []
    for j in range(int(2 * half[1]) + 2):
        for i in range(int(2 * half[0]) + 2):
            pixel = first + np.array([i, j])
            away = pixel + emission.places[primary] - centre
            inside = sum(_inside(inverse, away + spot, emission.edge) for spot in spots) / len(spots) * weight
            used = (inside > 0) & (pixel >= 0).all(axis=1) & (pixel < [columns, rows]).all(axis=1)
            place.append(pixel[used, 1] * columns + pixel[used, 0])
            value.append(inside[used])
            ray.append(np.flatnonzero(used))
    # Of an even panel the mean ray collects its weight.
    scale = np.pi * np.abs(np.linalg.det(shape)).mean()
    entries = np.concatenate(value) / scale, (np.concatenate(ray), np.concatenate(place))
    return sparse.csr_array(sparse.coo_array(entries, shape=(len(rays), rows * columns)))


def _inside(inverse: np.ndarray, away: np.ndarray, edge: float) -> np.ndarray:
    """1 inside the ellipse, 0 outside; linear over its soft edge."""
    u = inverse[:, 0, 0] * away[:, 0] + inverse[:, 0, 1] * away[:, 1]
    v = inverse[:, 1, 0] * away[:, 0] + inverse[:, 1, 1] * away[:, 1]
    return np.clip(0.5 - (np.sqrt(u * u + v * v) - 1) / (2 * edge), 0, 1)
