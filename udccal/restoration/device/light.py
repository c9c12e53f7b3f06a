"""The scene's light on a device, of raw samples: black level, defects, wire, backscatter, and places it leaves dark."""

from __future__ import annotations

import cv2
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import log_ndtr
from jaxtyping import Array, Bool, Float, Int, UInt8, UInt16

from udccal.cfa import Cfa
from udccal.models.noise import Noise, linear_signal
from udccal.restoration.backscatter import SPARSE
from udccal.restoration.dark_places import LEAST_E, NEGLIGIBLE, STEP
from udccal.restoration.defects import OUTLIER_RATIO, OUTLIER_SIGMA
from udccal.restoration.device.planes import Mosaic, apart, box_mean, resized, together
from udccal.restoration.mosaic_filter import channels_of
from udccal.restoration.panel_mask import BLOCK, PERCENTILE, SIGMAS, STRIPS
from udccal.restoration.scene_prior import COLOURFUL

_AROUND = tuple((down, across) for down in range(3) for across in range(3) if (down, across) != (1, 1))

# Sigmas below 0 from which the mean of what is not negative is taken from a series.
_FAR = 8.0


class FrontEnd(eqx.Module):
    """What the rows of a frame pass before they are deblurred.

    Attributes:
        wire: map to divide by. white: backscatter of a white panel in e-/s. None where the restorer has none.
        noise: the noise term. saturated_DN: from where on a sample counts as saturated. cfa: the colour pattern.
    """

    wire: Mosaic | None
    white: Mosaic | None
    noise: Noise
    saturated_DN: Float[Array, ""]
    cfa: Cfa = eqx.field(static=True)

    def light(
        self, mosaic: UInt16[Array, "rows columns"], exposed: Float[Array, "3"], known: Bool[Array, ""], rate: Mosaic
    ) -> tuple[Mosaic, Mosaic, Bool[Array, "rows columns"], Mosaic, Float[Array, "3"], Float[Array, "3"]]:
        """Return signal, variance, clipped samples and the panel's light as ``Restorer.scene_light`` does, in e-.

        Then follow the panel's levels, 0 where its picture is known, and arguments of ``refuse_excess_of``.

        Args:
            mosaic: rows of a frame in DN. exposed: exposure in s, DN and variance in e-^2 of a sample without light.
            known: whether the panel's picture is known. rate: its backscatter in e-/s; anything when it is not.
        """
        exposure_s, dark_DN, floor_e2 = exposed
        signal = self._without_defects(self._electrons(mosaic.astype(jnp.float32), dark_DN))
        clipped = signal >= self._electrons(self.saturated_DN, dark_DN)
        variance = jnp.maximum(signal, 0) + floor_e2
        if self.wire is not None:
            signal, variance = signal / self.wire, variance / self.wire / self.wire
        panel, levels = jnp.zeros_like(signal), jnp.zeros(3, signal.dtype)
        if self.white is not None:
            white, given, none = self.white, (signal, exposure_s, floor_e2), levels
            levels = jax.lax.cond(known, lambda: none, lambda: self._levels(*given))
            panel = exposure_s * jax.lax.cond(known, lambda: rate, lambda: self._of_mask(levels, white))
        use = ~clipped[SPARSE]
        sums = (jnp.sum(light[SPARSE], where=use) for light in (signal, panel))
        excess = jnp.stack([*sums, jnp.count_nonzero(use)])
        return signal - panel, variance, clipped, panel, levels, excess

    def put_back(
        self, picture_e: Float[Array, "3 some_rows columns"], levels: Float[Array, "3"], first: int, exposed: Array
    ) -> Float[Array, "3 some_rows columns"]:
        """Return a deblurred picture with the light that was too much to subtract, as ``PanelMask.put_back`` does.

        Args:
            picture_e: light in e-. levels: at which backscatter was subtracted; 0 leaves the picture as it is.
            first: row of the picture, among those of the mask. exposed: as for ``light``.
        """
        if self.white is None:
            return picture_e
        exposure_s, _, floor_e2 = exposed
        rows, columns = picture_e.shape[1:]
        white = self._blocks(self.white)[:, first // BLOCK :][:, : max(rows // BLOCK, 1)]
        seen = (
            resized(picture_e, (white.shape[1], white.shape[2]), cv2.INTER_AREA)
            + exposure_s * levels[:, None, None] * white
        )
        too_much = jnp.maximum(levels - self._highest(seen, white, exposure_s, floor_e2), 0)
        return picture_e + resized(exposure_s * too_much[:, None, None] * white, (rows, columns), cv2.INTER_LINEAR)

    def _electrons(self, value_DN: Float[Array, "*n"], dark_DN: Float[Array, ""]) -> Float[Array, "*n"]:
        black = self.noise.black_DN
        straight = linear_signal(value_DN - black, self.noise.bend_per_DN)
        return (straight - (dark_DN - black)) / self.noise.K_DN_per_e

    def _without_defects(self, signal_e: Mosaic) -> Mosaic:
        """Replace the samples that ``defects.without_defects`` does, by the same medians."""
        planes = apart(signal_e, self.cfa)
        (_, rows, columns), wide = planes.shape, jnp.pad(planes, ((0, 0), (1, 1), (1, 1)), mode="reflect")
        around = [wide[:, down : down + rows, across : across + columns] for down, across in _AROUND]
        high, low = jnp.max(jnp.stack(around), 0), jnp.min(jnp.stack(around), 0)
        sigma = jnp.sqrt(jnp.maximum(high, 0) + self.noise.sigma_d_e**2)
        allowed = jnp.maximum(OUTLIER_SIGMA * sigma, OUTLIER_RATIO * (high - low))
        wrong = (planes > high + allowed) | (planes < low - allowed)

        def mended() -> Mosaic:
            median = jnp.median(jnp.stack([planes, *around]), axis=0)
            return together(jnp.where(wrong, median, planes), self.cfa)

        return jax.lax.cond(jnp.any(wrong), mended, lambda: signal_e)

    def _levels(self, signal: Mosaic, exposure_s: Float[Array, ""], floor_e2: Float[Array, ""]) -> Float[Array, "3"]:
        """Return the levels that ``PanelMask.levels`` finds."""
        assert self.white is not None
        return self._highest(self._blocks(signal), self._blocks(self.white), exposure_s, floor_e2)

    def _of_mask(self, levels: Float[Array, "3"], white: Mosaic) -> Mosaic:
        """Return the mask at these levels, in e-/s."""
        return together(levels[channels_of(self.cfa), None, None] * apart(white, self.cfa), self.cfa)

    def _blocks(self, mosaic: Mosaic) -> Float[Array, "3 down across"]:
        """Return each colour's mean in blocks."""
        down, across = (max(most // BLOCK, 1) for most in mosaic.shape)
        sites, channels = apart(mosaic[: down * BLOCK, : across * BLOCK], self.cfa), channels_of(self.cfa)
        blocks = resized(sites, (down, across), cv2.INTER_AREA)
        return jnp.stack([blocks[channels == channel].mean(axis=0) for channel in range(3)])

    def _highest(
        self,
        seen_e: Float[Array, "3 down across"],
        white: Float[Array, "3 down across"],
        exposure_s: Float[Array, ""],
        floor_e2: Float[Array, ""],
    ) -> Float[Array, "3"]:
        """Return the highest levels that light in blocks allows."""
        assert self.white is not None
        channels, levels = channels_of(self.cfa), []
        for channel, (seen, possible) in enumerate(zip(seen_e, white, strict=True)):
            samples = np.count_nonzero(channels == channel) * min(BLOCK**2, self.white.size) / len(channels)
            seen += SIGMAS * jnp.sqrt((jnp.maximum(seen, 0) + floor_e2) / samples)
            ratio = jnp.where(possible > 0, seen / (possible * exposure_s), jnp.nan).ravel()
            strips = jnp.array_split(ratio, min(STRIPS, ratio.size))
            lowest = jnp.nanmin(jnp.stack([jnp.nanpercentile(strip, PERCENTILE) for strip in strips]))
            levels.append(jnp.clip(jnp.nan_to_num(lowest), 0, 1))
        return jnp.stack(levels)


class PanelTables(eqx.Module):
    """The arrays of ``PanelSums``, by the same names, on a device. cfa: the colour pattern."""

    shares: Float[Array, "3 shares"]
    pixels: Int[Array, " shares"]
    starts: Int[Array, " places_and_end"]
    gain: Float[Array, "3 places"]
    mix: Float[Array, "3 3"]
    light: Float[Array, " 256"]
    down: Float[Array, "rows grid_rows"]
    across: Float[Array, "columns grid_columns"]
    cfa: Cfa = eqx.field(static=True)

    @jax.jit
    def rate(self, seen: UInt8[Array, "seen_rows seen_columns 3"]) -> Mosaic:
        """Return the backscatter of a panel's picture in e-/s as ``PanelLight.rate`` does.

        Args:
            seen: the part of what the panel shows that the camera sees.
        """
        light = self.light[seen].reshape(-1, 3).T
        shares, places = (self.shares * light[:, self.pixels]).T, len(self.starts) - 1
        place = jnp.repeat(jnp.arange(places), jnp.diff(self.starts), total_repeat_length=len(shares))
        collected = jax.ops.segment_sum(shares, place, places, indices_are_sorted=True)
        with jax.default_matmul_precision("highest"):
            grid = (self.gain * (self.mix @ collected.T)).reshape(3, self.down.shape[1], -1)
            whole = self.down @ grid @ self.across.T
        sites = [apart(whole[site.channel], self.cfa)[at] for at, site in enumerate(self.cfa.sites)]
        return together(jnp.stack(sites), self.cfa)


def plausible(picture_e: Float[Array, "3 rows columns"], error_e: Mosaic) -> Float[Array, "3 rows columns"]:
    """Correct brightness and colour of dark places, as ``dark_places.plausible`` does.

    Args:
        picture_e: restored picture in e-. error_e: sigma of the light that was subtracted, in e-.
    """
    rows, columns = error_e.shape
    size = max(rows // STEP, 1), max(columns // STEP, 1)
    smooth = box_mean(resized(picture_e, size, cv2.INTER_AREA), 3)
    error = jnp.maximum(resized(error_e, size, cv2.INTER_AREA), LEAST_E)
    grey = smooth.mean(axis=0)
    doubt = error**2 / (COLOURFUL * jnp.maximum(grey, 0) ** 2 + error**2)
    # The errors of three colours average.
    sigma = error / np.sqrt(np.float32(3))
    # The normal density over its integral; both underflow far below 0, where their ratio is a series.
    ratio = grey / sigma
    low, high = jnp.minimum(ratio, -_FAR), jnp.maximum(ratio, -_FAR)
    far = -grey / (1 - low**-2 + 3 * low**-4)
    near = sigma * jnp.exp(-(high**2) / 2 - log_ndtr(high)) / np.sqrt(np.float32(2 * np.pi))
    lift = jnp.where(ratio > -_FAR, near, far)
    change = resized(doubt * (grey - smooth) + lift, (rows, columns), cv2.INTER_LINEAR)
    return jnp.where(doubt.max() < NEGLIGIBLE, picture_e, picture_e + change)
