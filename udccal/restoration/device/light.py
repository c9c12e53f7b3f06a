"""From raw samples to the scene's light on a device: black level, defects, wire, backscatter."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt8, UInt16

from udccal.cfa import Cfa, cfa_named
from udccal.models.noise import linear_signal
from udccal.restoration.backscatter import BLOCK, PERCENTILE, SPARSE, PanelLight
from udccal.restoration.defects import OUTLIER_RATIO, OUTLIER_SIGMA
from udccal.restoration.device.planes import apart, together
from udccal.restoration.linear import least_saturated_DN, scalar
from udccal.restoration.runtime import Restorer

Mosaic = Float[Array, "rows columns"]
_AROUND = tuple((down, across) for down in range(3) for across in range(3) if (down, across) != (1, 1))


class Exposed(eqx.Module):
    """What depends on a frame's exposure, and on the panel's picture.

    Attributes:
        exposure_s: time. dark_DN: what a sample reads without light. floor_e2: variance of a sample without light.
        known: whether the panel's picture is known. rate: its backscatter in e-/s; anything when it is not.
    """

    exposure_s: Float[Array, ""]
    dark_DN: Float[Array, ""]
    floor_e2: Float[Array, ""]
    known: Bool[Array, ""]
    rate: Mosaic


class Excess(eqx.Module):
    """Sums over some samples, by which ``refuse_excess`` tells a frame that is darker than its panel's light.

    Attributes:
        seen_e: the frame's light. expected_e: the panel's. samples: how many.
    """

    seen_e: Float[Array, ""]
    expected_e: Float[Array, ""]
    samples: Int[Array, ""]


class FrontEnd(eqx.Module):
    """Noise, wire and mask of a rig.

    Attributes:
        wire: map to divide by. white: backscatter of a white panel in e-/s. None where the restorer has none.
        cfa: the colour pattern. The others: of the noise term.
    """

    wire: Mosaic | None
    white: Mosaic | None
    cfa: Cfa = eqx.field(static=True)
    K_DN_per_e: float = eqx.field(static=True)
    black_DN: float = eqx.field(static=True)
    bend_per_DN: float = eqx.field(static=True)
    sigma_d_e: float = eqx.field(static=True)
    saturated_DN: float = eqx.field(static=True)

    @classmethod
    def of(cls, restorer: Restorer) -> FrontEnd:
        """Take over what a restorer has."""
        noise = restorer.noise
        return cls(
            None if restorer.wire is None else jnp.asarray(restorer.wire),
            None if restorer.mask is None else jnp.asarray(restorer.mask.white),
            cfa_named(restorer.rig.camera.cfa),
            scalar(noise.K_DN_per_e),
            scalar(noise.black_DN),
            scalar(noise.bend_per_DN),
            scalar(noise.sigma_d_e),
            least_saturated_DN(noise),
        )

    def light(
        self, mosaic: UInt16[Array, "rows columns"], exposed: Exposed
    ) -> tuple[Mosaic, Mosaic, Bool[Array, "rows columns"], Mosaic, Excess]:
        """Return signal, variance, clipped samples and the panel's light as ``Restorer.scene_light`` does, in e-."""
        signal = self._without_defects(self._electrons(mosaic.astype(jnp.float32), exposed.dark_DN))
        variance = jnp.maximum(signal, 0) + exposed.floor_e2
        if self.wire is not None:
            signal, variance = signal / self.wire, variance / self.wire / self.wire
        clipped, panel = mosaic >= self.saturated_DN, jnp.zeros_like(signal)
        if self.white is not None:
            white, rate = self.white, signal / exposed.exposure_s
            panel = exposed.exposure_s * jax.lax.cond(
                exposed.known, lambda: exposed.rate, lambda: self._unknown(rate, white)
            )
        use = ~clipped[SPARSE]
        sums = (jnp.sum(jnp.where(use, light[SPARSE], 0)) for light in (signal, panel))
        return signal - panel, variance, clipped, panel, Excess(*sums, jnp.count_nonzero(use))

    def _electrons(self, mosaic_DN: Mosaic, dark_DN: Float[Array, ""]) -> Mosaic:
        if self.bend_per_DN == 0:
            return (mosaic_DN - dark_DN) / self.K_DN_per_e
        straight = linear_signal(mosaic_DN - self.black_DN, self.bend_per_DN)
        return (straight - (dark_DN - self.black_DN)) / self.K_DN_per_e

    def _without_defects(self, signal_e: Mosaic) -> Mosaic:
        """Replace the samples that ``defects.without_defects`` does, by the same medians."""
        planes = apart(signal_e, (self.cfa.rows, self.cfa.columns))
        (_, rows, columns), wide = planes.shape, jnp.pad(planes, ((0, 0), (1, 1), (1, 1)), mode="reflect")
        around = [wide[:, down : down + rows, across : across + columns] for down, across in _AROUND]
        high, low = jnp.max(jnp.stack(around), 0), jnp.min(jnp.stack(around), 0)
        sigma = jnp.sqrt(jnp.maximum(high, 0) + self.sigma_d_e**2)
        allowed = jnp.maximum(OUTLIER_SIGMA * sigma, OUTLIER_RATIO * (high - low))
        wrong = (planes > high + allowed) | (planes < low - allowed)

        def mended() -> Mosaic:
            median = jnp.median(jnp.stack([planes, *around]), axis=0)
            return together(jnp.where(wrong, median, planes), (self.cfa.rows, self.cfa.columns))

        return jax.lax.cond(jnp.any(wrong), mended, lambda: signal_e)

    def _unknown(self, rate: Mosaic, white: Mosaic) -> Mosaic:
        """Return the mask at the levels that ``PanelMask.levels`` finds, in e-/s."""
        cell, channels = (self.cfa.rows, self.cfa.columns), np.array([site.channel for site in self.cfa.sites])
        both = [_block_means(apart(light, cell), cell) for light in (rate, white)]
        levels = []
        for channel in range(3):
            seen, possible = (each[channels == channel].sum(axis=0) for each in both)
            ratio = jnp.where(possible > 0, seen / possible, jnp.nan)
            levels.append(jnp.clip(jnp.nan_to_num(jnp.nanpercentile(ratio, PERCENTILE)), 0, 1))
        return together(jnp.stack(levels)[channels, None, None] * apart(white, cell), cell)


def _block_means(
    planes: Float[Array, "sites rows columns"], cell: tuple[int, int]
) -> Float[Array, "sites down across"]:
    """Return each site's mean in blocks of the mosaic."""
    (down, high), (across, wide) = (
        (max(most // (BLOCK // step), 1), min(most, BLOCK // step))
        for most, step in zip(planes.shape[1:], cell, strict=True)
    )
    cut = planes[:, : down * high, : across * wide]
    return cut.reshape(-1, down, high, across, wide).mean(axis=(2, 4))


class PanelRows(eqx.Module):
    """``PanelSums`` with as many shares in every row, filled up with zeros, so that a sum is a gather and a reduction.

    Attributes:
        shares, blocks: of each place. gain, mix, light, down, across: as in ``PanelSums``.
        block: pixels across a block. cfa: the colour pattern.
    """

    shares: Float[Array, "places most 3"]
    blocks: Int[Array, "places most"]
    gain: Float[Array, "3 places"]
    mix: Float[Array, "3 3"]
    light: Float[Array, " 256"]
    down: Float[Array, "rows grid_rows"]
    across: Float[Array, "columns grid_columns"]
    block: int = eqx.field(static=True)
    cfa: Cfa = eqx.field(static=True)

    @classmethod
    def of(cls, panel: PanelLight) -> PanelRows:
        """Rearrange the sums of a panel."""
        sums = panel.sums
        counts = np.diff(sums.starts)
        at = (
            np.repeat(np.arange(len(counts)), counts),
            np.arange(len(sums.blocks)) - np.repeat(sums.starts[:-1], counts),
        )
        shares = np.zeros((len(counts), int(counts.max()), 3), np.float32)
        blocks = np.zeros(shares.shape[:2], np.int32)
        shares[at], blocks[at] = sums.shares.T, sums.blocks
        tables = (
            jnp.asarray(each) for each in (shares, blocks, sums.gain, sums.mix, sums.light, sums.down, sums.across)
        )
        return cls(*tables, panel.block, panel.cfa)

    @jax.jit
    def rate(self, picture: UInt8[Array, "panel_rows panel_columns 3"]) -> Mosaic:
        """Return the backscatter in e-/s as ``PanelLight.rate`` does."""
        light, n = self.light[picture], self.block
        rows, columns, _ = light.shape
        # At the panel's edge a block goes on mirrored.
        light = jnp.pad(light, ((0, -rows % n), (0, -columns % n), (0, 0)), mode="symmetric")
        light = light.reshape(-(-rows // n), n, -(-columns // n), n, 3).mean(axis=(1, 3)).reshape(-1, 3)
        collected = jnp.sum(self.shares * light[self.blocks], axis=1)
        with jax.default_matmul_precision("highest"):
            grid = self.gain * (self.mix @ collected.T)
            grid = grid.reshape(3, self.down.shape[1], self.across.shape[1])
            sites = [
                self.down[site.row :: self.cfa.rows]
                @ grid[site.channel]
                @ self.across[site.column :: self.cfa.columns].T
                for site in self.cfa.sites
            ]
        return together(jnp.stack(sites), (self.cfa.rows, self.cfa.columns))
