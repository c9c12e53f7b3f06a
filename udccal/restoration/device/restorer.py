"""A prepared restorer on a device of JAX: one compiled function takes a raw frame to 8 bits."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8, UInt16

from udccal.errors import RestorationError
from udccal.restoration.backscatter import UNKNOWN_ERROR, refuse_excess_of
from udccal.restoration.device.bands import Bands
from udccal.restoration.device.finish import Resampling, plausible, rgb8
from udccal.restoration.device.learned import Learned
from udccal.restoration.device.light import Excess, Exposed, FrontEnd, Mosaic, PanelRows
from udccal.restoration.device.planes import box_mean
from udccal.restoration.device.tile_filter import TileFilter
from udccal.restoration.linear import dark_DN, variance_floor_e2
from udccal.restoration.mosaic_filter import STRENGTHS
from udccal.restoration.network import SHARPER
from udccal.restoration.runtime import Restorer, check_frame, check_panel_picture
from udccal.restoration.sharpen import LOCAL_PX
from udccal.restoration.tone import CODES, Tone
from udccal.tiers import Tier

Picture = UInt8[np.ndarray, "view_rows view_columns 3"]
PanelPicture = UInt8[np.ndarray, "panel_rows panel_columns 3"]


class _Stages(eqx.Module):
    """Everything that a frame passes, by arrays on the device."""

    front: FrontEnd
    tiles: TileFilter
    bands: Bands | None
    learned: Learned | None
    resampling: Resampling
    codes: UInt8[Array, " levels"]
    error_known: float = eqx.field(static=True)

    @jax.jit
    def shown(
        self, mosaic: UInt16[Array, "rows columns"], exposed: Exposed, scale: Float[Array, "3"]
    ) -> tuple[UInt8[Array, "view_rows view_columns 3"], Excess]:
        """Return what a display shows, and how the frame's light compares with the panel's."""
        with jax.default_matmul_precision("highest"):
            signal, variance, clipped, panel, excess = self.front.light(mosaic, exposed)
            sharp = self._sharp(signal, variance, clipped)
            if self.front.white is not None:
                error = jnp.where(exposed.known, self.error_known, max(self.error_known, UNKNOWN_ERROR))
                sharp = jnp.where(error > 0, plausible(sharp, error * panel[self._rows]), sharp)
            return rgb8(self.resampling.apply(sharp), scale, self.codes), excess

    @property
    def _rows(self) -> slice:
        return slice(self.tiles.layout.first_row, self.tiles.layout.last_row)

    def _sharp(self, signal: Mosaic, variance_e2: Mosaic, clipped: Array) -> Float[Array, "3 covered_rows columns"]:
        """Demosaic and deblur as ``Sharpener.apply`` does."""
        tiles, strengths = self.tiles, jnp.asarray(STRENGTHS)
        found = tiles.completed(tiles.whitened(tiles.cut(signal), tiles.noise(variance_e2)), clipped)
        chosen = tiles.join(tiles.pictures(found, strengths[found.strength]))
        if self.bands is None:
            return chosen
        bands, local = self.bands.of_tiles(found.strength), box_mean(variance_e2, LOCAL_PX)[self._rows]
        balanced = self.bands.shrunk(chosen, found.noise_e, local, bands)
        if self.learned is None:
            return balanced
        sharper = jnp.minimum(strengths[found.strength] * SHARPER, STRENGTHS[-1])
        sharp = tiles.join(tiles.pictures(found, sharper))
        best = self.learned.refined(balanced, chosen, sharp, found.noise_e, local, bands)
        rest = tiles.whitened(tiles.cut(self._rest(best, signal, clipped)), found.noise_e)
        return best + tiles.join(tiles.pictures(rest, strengths[rest.strength]))

    def _rest(self, picture: Float[Array, "3 covered_rows columns"], signal: Mosaic, clipped: Array) -> Mosaic:
        """Return what the samples have more or less than a picture gives, in the rows that it covers."""
        assert self.learned is not None
        channels = self.tiles.cfa.channel_map(*signal.shape)[self._rows]
        expected = jnp.take_along_axis(self.learned.blurred(picture), channels[None], axis=0)[0]
        rest = jnp.zeros_like(signal).at[self._rows].set(signal[self._rows] - expected)
        return jnp.where(clipped, jnp.maximum(rest, 0), rest)


@final
@dataclass
class _Latest:
    """The latest picture of a panel, and its backscatter on the device."""

    picture: PanelPicture | None
    rate: Mosaic


@final
@dataclass(frozen=True)
class DeviceRestorer:
    """A restorer whose tables lie on a device.

    It shows what ``Restorer.display`` shows, but for rounding. The first frame takes the seconds of a compilation.
    Three things are done another way. Every strength of a tile's prior is tried, not only those beside the best of
    some. A tile where clipped samples are completed has no picture of its own before that. Whether a scene has dark
    places is decided by all of its rows.

    Attributes:
        restorer: as prepared. device: of JAX. stages: what frames pass. panel: backscatter of known pictures.
    """

    restorer: Restorer
    device: jax.Device
    stages: _Stages
    panel: PanelRows | None
    latest: _Latest

    @classmethod
    def of(cls, restorer: Restorer, device: jax.Device | None = None) -> DeviceRestorer:
        """Take a restorer to a device.

        Args:
            restorer: of a tier that deblurs.
            device: of JAX; None for the first one, which is a GPU where JAX has one.

        Raises:
            RestorationError: when the restorer does not deblur, or its frames do not have whole cells of the pattern.
        """
        sharpener = restorer.sharpener
        if sharpener is None:
            raise RestorationError(
                f"Expected a restorer that deblurs, found tier '{restorer.tier}' of rig '{restorer.rig.name}', which "
                "does not. Use Restorer.display, which takes some milliseconds."
            )
        camera, cfa, layout = restorer.rig.camera, sharpener.cfa, sharpener.layout
        if camera.rows % cfa.rows or camera.columns % cfa.columns:
            raise RestorationError(
                f"Expected frames of whole {cfa.columns} x {cfa.rows} cells, found {camera.columns} x {camera.rows} "
                "samples. Use Restorer.display."
            )
        device = jax.devices()[0] if device is None else device
        maps = restorer.rectification.from_row(layout.first_row)
        learned = None
        if restorer.tier is Tier.accurate:
            learned = Learned.of(sharpener.grid, layout, restorer.options.network_views)
        stages = _Stages(
            FrontEnd.of(restorer),
            TileFilter.of(sharpener.tables, layout, cfa),
            None if sharpener.noise is None else Bands.of(sharpener.noise, layout),
            learned,
            Resampling.of(maps, restorer.options.interpolation),
            jnp.asarray(CODES),
            0.0 if restorer.mask is None else restorer.mask.error,
        )
        panel = None if restorer.panel is None else PanelRows.of(restorer.panel)
        dark = jnp.zeros((camera.rows, camera.columns), jnp.float32)
        stages, panel, dark = jax.device_put((stages, panel, dark), device)
        return cls(restorer, device, stages, panel, _Latest(None, dark))

    @property
    def table_bytes(self) -> int:
        """Bytes of the filters' tables on the device."""
        return sum(leaf.nbytes for leaf in jax.tree_util.tree_leaves(self.stages.tiles))

    def display(
        self,
        mosaic: UInt16[np.ndarray, "frame_rows frame_columns"],
        exposure_s: float,
        tone: Tone,
        panel_picture: PanelPicture | None = None,
    ) -> Picture:
        """Restore a frame for a display as ``Restorer.display`` does; arguments and errors are the same."""
        check_frame(mosaic, exposure_s, self.restorer.rig)
        check_panel_picture(panel_picture, self.restorer.rig)
        noise, known = self.restorer.noise, panel_picture is not None and self.panel is not None
        numbers = exposure_s, dark_DN(noise, exposure_s), variance_floor_e2(noise, exposure_s)
        rate = self.latest.rate if panel_picture is None else self._rate(panel_picture)
        scale = replace(tone, exposure=tone.exposure / exposure_s).scale()
        small = *(np.float32(each) for each in numbers), np.bool_(known)
        raw, factors, *scalars = jax.device_put((mosaic, scale, *small), self.device)
        shown, excess = jax.device_get(self.stages.shown(raw, Exposed(*scalars, rate), factors))
        if known:
            refuse_excess_of(float(excess.seen_e), float(excess.expected_e), int(excess.samples))
        return np.asarray(shown)

    def _rate(self, picture: PanelPicture) -> Mosaic:
        """Return the backscatter of a picture; the latest picture's is kept."""
        latest = self.latest
        if self.panel is not None and (latest.picture is None or not np.array_equal(latest.picture, picture)):
            latest.picture, latest.rate = picture.copy(), self.panel.rate(jax.device_put(picture, self.device))
        return latest.rate
