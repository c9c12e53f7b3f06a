"""Undistortion and virtual rotation in one resampling."""

from __future__ import annotations

import enum
import functools
from dataclasses import dataclass

import cv2
import jax
import numpy as np
from jaxtyping import Float, Float32, Int16, Real, UInt16

from udccal.errors import RestorationError
from udccal.models.geometry import Geometry, VirtualView, view_to_sensor
from udccal.numerics import in_float64

# Steps of a pixel, and pixels that the widest interpolation reads along one axis, that many of them before the place.
_STEPS, _WIDEST, _BEFORE = 32, 8, 3


class Interpolation(enum.IntEnum):
    """How a picture is resampled: over 2 x 2, 4 x 4 or 8 x 8 pixels."""

    LINEAR = cv2.INTER_LINEAR
    CUBIC = cv2.INTER_CUBIC
    LANCZOS = cv2.INTER_LANCZOS4


@dataclass(frozen=True)
class Rectification:
    """Maps from every pixel of the view to the sensor pixel (x, y) that it looks at."""

    map_x: Float32[np.ndarray, "rows columns"]
    map_y: Float32[np.ndarray, "rows columns"]

    @classmethod
    def of(cls, geometry: Geometry, view: VirtualView) -> Rectification:
        """Evaluate the map once."""
        pixels = _sensor_pixels(geometry, view)
        return cls(*(np.ascontiguousarray(pixels[..., axis], dtype=np.float32) for axis in range(2)))

    @classmethod
    def within(cls, geometry: Geometry, view: VirtualView, sensor_columns: int, sensor_rows: int) -> Rectification:
        """Evaluate the map as ``of`` does, and check that every pixel of the view looks at the sensor.

        Raises:
            RestorationError: when a pixel inside the view looks past the sensor: the distortion folds.
        """
        found = cls.of(geometry, view)
        for places, size in ((found.map_x, sensor_columns), (found.map_y, sensor_rows)):
            if not np.all((places > -1) & (places < size)):
                raise RestorationError(
                    "Expected every pixel of the view to look at the sensor, found some that look past it. Check the "
                    "geometry term's distortion, or calibrate the rig again."
                )
        return found

    @property
    def rows(self) -> tuple[int, int]:
        """First row of the sensor that resampling reads, and the row after the last one; they may lie outside it."""
        reach = 4
        return int(np.floor(self.map_y.min())) - reach, int(np.ceil(self.map_y.max())) + reach + 1

    def from_row(self, first: int) -> Rectification:
        """Return the maps for pictures that begin at a row of the sensor."""
        return Rectification(self.map_x, self.map_y - np.float32(first))

    @functools.cached_property
    def fixed(self) -> tuple[Int16[np.ndarray, "rows columns 2"], UInt16[np.ndarray, "rows columns"]]:
        """Both maps as OpenCV uses them: whole pixels, and 1024 steps of 1/32 px."""
        return cv2.convertMaps(self.map_x, self.map_y, cv2.CV_16SC2)

    def apply(
        self, picture: Real[np.ndarray, "rows columns 3"], interpolation: Interpolation = Interpolation.LANCZOS
    ) -> Real[np.ndarray, "view_rows view_columns 3"]:
        """Resample a sensor picture onto the view; its type, float32 or 8 bits, is kept."""
        return cv2.remap(picture, *self.fixed, interpolation, borderMode=cv2.BORDER_REFLECT_101)


def interpolation_taps(interpolation: Interpolation) -> tuple[int, Float32[np.ndarray, "32 taps"]]:
    """Return how many px before a place OpenCV begins to read, and its weights at each step of 1/32 px."""
    # What it makes of single points.
    x = np.tile(_BEFORE + np.arange(_STEPS, dtype=np.float32) / _STEPS, (_WIDEST, 1))
    y = np.tile(np.arange(_WIDEST, dtype=np.float32)[:, None], (1, _STEPS))
    taps = cv2.remap(np.eye(_WIDEST, dtype=np.float32), x, y, interpolation).T
    used = np.flatnonzero(np.any(taps != 0, axis=0))
    return _BEFORE - int(used[0]), taps[:, used[0] : used[-1] + 1]


_sensor_places = jax.jit(view_to_sensor)


@in_float64
def _sensor_pixels(geometry: Geometry, view: VirtualView) -> Float[np.ndarray, "rows columns 2"]:
    x, y = np.arange(view.columns, dtype=np.float64), np.arange(view.rows, dtype=np.float64)
    return np.asarray(_sensor_places(geometry, view, np.stack(np.meshgrid(x, y), axis=-1)))
