"""From a sharp picture on the sensor to 8 bits on the view, on a device: dark places, resampling, tone."""

from __future__ import annotations

import cv2
import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import log_ndtr
from jaxtyping import Array, Float, Float32, Int, UInt8

from udccal.restoration.dark_places import COLOURFUL, LEAST_E, NEGLIGIBLE, STEP
from udccal.restoration.device.planes import box_mean, resized, resizing
from udccal.restoration.rectify import Interpolation, Rectification
from udccal.restoration.tone import CODES

Planes = Float[Array, "3 rows columns"]
# Steps of a pixel, and pixels that the widest interpolation reads along one axis, that many of them before the place.
_STEPS, _WIDEST, _BEFORE = 32, 8, 3


def plausible(picture_e: Planes, error_e: Float[Array, "rows columns"]) -> Planes:
    """Correct brightness and colour of dark places, as ``dark_places.plausible`` does.

    Args:
        picture_e: restored picture in e-. error_e: sigma of the light that was subtracted, in e-.
    """
    rows, columns = error_e.shape
    size = max(rows // STEP, 1), max(columns // STEP, 1)
    # Areas of a dozen pixels and more: a product with a whole matrix is quicker than gathers.
    down, across = (resizing(of, to, cv2.INTER_AREA) for of, to in zip(error_e.shape, size, strict=True))
    smooth, error = box_mean(down @ picture_e @ across.T, 3), jnp.maximum(down @ error_e @ across.T, LEAST_E)
    grey = smooth.mean(axis=0)
    doubt = error**2 / (COLOURFUL * jnp.maximum(grey, 0) ** 2 + error**2)
    # The errors of three colours average.
    sigma = error / np.sqrt(np.float32(3))
    ratio = grey / sigma
    lift = sigma * jnp.exp(-(ratio**2) / 2 - log_ndtr(ratio)) / np.sqrt(np.float32(2 * np.pi))
    change = resized(doubt * (grey - smooth) + lift, (rows, columns), cv2.INTER_LINEAR)
    return jnp.where(doubt.max() < NEGLIGIBLE, picture_e, picture_e + change)


class Resampling(eqx.Module):
    """Maps from the view to the picture, in steps of 1/32 px as OpenCV has them.

    Attributes:
        pixel: (x, y) of each place of the view. step: (x, y) beyond it.
        taps: weights of the pixels around at each step. before: how many of them lie before the pixel.
    """

    pixel: Int[Array, "view_rows view_columns 2"]
    step: UInt8[Array, "view_rows view_columns 2"]
    taps: Float[Array, "32 taps"]
    before: int = eqx.field(static=True)

    @classmethod
    def of(cls, rectification: Rectification, interpolation: Interpolation) -> Resampling:
        """Take over the maps, and ask OpenCV for its weights."""
        pixel, index = rectification.fixed
        step = np.stack([index % _STEPS, index // _STEPS], axis=-1)
        taps = _taps(interpolation)
        used = np.flatnonzero(np.any(taps != 0, axis=0))
        some = taps[:, used[0] : used[-1] + 1]
        return cls(jnp.asarray(pixel), jnp.asarray(step, jnp.uint8), jnp.asarray(some), _BEFORE - int(used[0]))

    def apply(self, picture: Planes) -> Float[Array, "view_rows view_columns 3"]:
        """Resample a picture; its borders are mirrored."""
        size, taps = picture.shape[:0:-1], self.taps[self.step]
        flat = jnp.moveaxis(picture, 0, -1).reshape(-1, 3)
        at = [
            _mirrored(self.pixel[..., axis] + tap - self.before, size[axis])
            for axis in (0, 1)
            for tap in range(taps.shape[-1])
        ]
        x, y = at[: taps.shape[-1]], at[taps.shape[-1] :]
        result = jnp.zeros(())
        for down, row in enumerate(y):
            line = sum(taps[..., 0, right, None] * flat[row * size[0] + column] for right, column in enumerate(x))
            result += taps[..., 1, down, None] * line
        return result


def _mirrored(index: Int[Array, "*n"], count: int) -> Int[Array, "*n"]:
    period = max(2 * (count - 1), 1)
    index = index.astype(jnp.int32) % period
    return jnp.minimum(index, period - index)


def _taps(interpolation: Interpolation) -> Float32[np.ndarray, "32 8"]:
    """Return the weights that OpenCV gives to pixels around a place, by its step: what it makes of single points."""
    x = np.tile(_BEFORE + np.arange(_STEPS, dtype=np.float32) / _STEPS, (_WIDEST, 1))
    y = np.tile(np.arange(_WIDEST, dtype=np.float32)[:, None], (1, _STEPS))
    return cv2.remap(np.eye(_WIDEST, dtype=np.float32), x, y, interpolation).T


def rgb8(
    linear: Float[Array, "rows columns 3"], scale: Float[Array, "3"], codes: UInt8[Array, " levels"]
) -> UInt8[Array, "rows columns 3"]:
    """Encode linear light for a display by the table of ``tone``, as ``Tone.rgb8`` does."""
    top = len(CODES) - 1
    return codes[jnp.clip(jnp.round(linear * scale * top), 0, top).astype(jnp.int32)]
