"""A prepared restorer on a device of JAX: one compiled function takes the rows of a raw frame to 8 bits."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, UInt8, UInt16

from udccal.arguments import check_kind
from udccal.errors import RestorationError
from udccal.models.noise import dark_DN
from udccal.restoration.backscatter import refuse_excess_of
from udccal.restoration.checks import check_frame, check_panel_picture
from udccal.restoration.clipped import effort_of
from udccal.restoration.device.bands import blurred, refined, shrunk
from udccal.restoration.device.light import FrontEnd, PanelTables, plausible
from udccal.restoration.device.planes import Mosaic, box_mean, cut, resampled
from udccal.restoration.device.tile_filter import TileFilter
from udccal.restoration.kernel_grid import interpolated_kernels
from udccal.restoration.lamp_pieces import lamp_pieces
from udccal.restoration.linear import least_saturated_DN, saturated, variance_floor_e2
from udccal.restoration.network import SHARPER, Weights, network_weights
from udccal.restoration.rectify import interpolation_taps
from udccal.restoration.runtime import Restorer
from udccal.restoration.scene_prior import STRENGTHS
from udccal.restoration.sharpen import LOCAL_PX
from udccal.restoration.tone import CODES, TONE_ADVICE, Tone
from udccal.tiers import Tier

PanelPicture = UInt8[np.ndarray, "panel_rows panel_columns 3"]


class _Lamps(eqx.Module):
    """What ``WithoutLamps`` has, on a device.

    Attributes:
        change: of the signal in e-, where halos are taken off. others: clipped samples that are no lamps.
        white: the lamps, as bright as the range.
    """

    change: Mosaic
    others: Bool[Array, "rows columns"]
    white: Mosaic


class _Stages(eqx.Module):
    """Everything that a frame passes, by arrays on the device.

    Attributes:
        front, tiles: as they say. bands: what ``BandNoise`` has. learned: the network's weights, the tiles' kernels.
        maps: arguments of ``resampled``. views: ways round in which the network sees a picture.
        error: sigma of the panel's light over the light.
    """

    front: FrontEnd
    tiles: TileFilter
    bands: tuple[Array, Array] | None
    learned: tuple[Weights, Array] | None
    maps: tuple[Array, Array, Array]
    views: int = eqx.field(static=True)
    error: float = eqx.field(static=True)

    @jax.jit
    def shown(
        self,
        raw: UInt16[Array, "rows columns"],
        scale: Array,
        exposed: Array,
        known: Array,
        rate: Mosaic,
        lamps: _Lamps | None,
    ) -> tuple[UInt8[Array, "view_rows view_columns 3"], Float[Array, "3"]]:
        """Return what a display shows of some rows, and the arguments of ``refuse_excess_of``."""
        with jax.default_matmul_precision("highest"):
            signal, variance, clipped, panel, levels, excess = self.front.light(raw, exposed, known, rate)
            inner = self.tiles.layout.inner
            if lamps is not None:
                signal, clipped = signal + lamps.change, clipped & lamps.others
            sharp = self._sharp(signal, variance, clipped)
            if lamps is not None:
                sharp = jnp.where(lamps.white[inner] > 0, jnp.maximum(sharp, lamps.white[inner]), sharp)
            of_unknown = sharp, levels, inner.start, exposed
            sharp = jax.lax.cond(known, lambda: sharp, lambda: self.front.put_back(*of_unknown))
            if self.error > 0:
                sharp = plausible(sharp, self.error * panel[inner])
            # The table of ``Tone.rgb8``.
            steps = jnp.round(resampled(sharp, *self.maps) * scale * (len(CODES) - 1))
            return jnp.asarray(CODES)[jnp.clip(steps, 0, len(CODES) - 1).astype(jnp.int32)], excess

    def _sharp(self, signal: Mosaic, variance_e2: Mosaic, clipped: Array) -> Float[Array, "3 covered_rows columns"]:
        """Demosaic and deblur as ``Sharpener.apply`` does."""
        tiles, strengths, layout = self.tiles, jnp.asarray(STRENGTHS), self.tiles.layout
        found = tiles.completed(tiles.whitened(cut(signal, *layout.samples), tiles.noise(variance_e2)), clipped)
        chosen = tiles.join(tiles.pictures(found, strengths[found.strength]))
        if self.bands is None:
            return chosen
        variance, probe = self.bands
        noise = found.noise_e, box_mean(variance_e2, LOCAL_PX)[layout.inner], variance[probe, found.strength]
        balanced = shrunk(chosen, noise, layout)
        if self.learned is None:
            return balanced
        sharper = jnp.minimum(strengths[found.strength] * SHARPER, STRENGTHS[-1])
        (weights, kernels), sharp = self.learned, tiles.join(tiles.pictures(found, sharper))
        best = refined(weights, [balanced, chosen, sharp], noise, layout, self.views)
        # What the samples have more or less than the picture gives.
        channels = tiles.cfa.channel_map(*signal.shape)[layout.inner]
        expected = jnp.take_along_axis(blurred(best, kernels, layout), channels[None], axis=0)[0]
        rest = jnp.zeros_like(signal).at[layout.inner].set(signal[layout.inner] - expected)
        rest = jnp.where(clipped, jnp.maximum(rest, 0), rest)
        against = tiles.whitened(cut(rest, *layout.samples), found.noise_e)
        return best + tiles.join(tiles.pictures(against, strengths[against.strength]))


@final
@dataclass(eq=False)
class DeviceRestorer:
    """A restorer whose tables lie on a device.

    It shows what ``Restorer.display`` shows, but for rounding. The first frame takes the seconds of a compilation.
    Lamps beyond the range are fitted by the processor, as long as that takes. Three things are done another way. Every
    strength of a tile's prior is tried, not only those beside the best of some. A tile where clipped samples are
    completed has no picture of its own before that. Whether a scene has dark places is decided by all of its rows.

    Attributes:
        restorer: as prepared. stages: what frames pass. panel: sums over the panel's pixels.
        latest: picture of the panel. rate: its backscatter in e-/s.
        no_lamps: of a frame without any; None for a tier that leaves their halos.
    """

    restorer: Restorer
    stages: _Stages
    panel: PanelTables | None
    latest: PanelPicture
    rate: Mosaic
    no_lamps: _Lamps | None

    @classmethod
    def of(cls, restorer: Restorer, device: jax.Device | None = None) -> DeviceRestorer:
        """Take a restorer to a device.

        Args:
            restorer: of a tier that deblurs.
            device: of JAX; None for the first one, which is a GPU where JAX has one.

        Raises:
            RestorationError: when the restorer does not deblur, or its frames do not have whole cells of the pattern.
        """
        check_kind(restorer, Restorer, "Prepare one by Restorer.load(path).", RestorationError)
        sharpener, camera, options = restorer.sharpener, restorer.rig.camera, restorer.options
        if sharpener is None:
            raise RestorationError(
                f"Expected a restorer that deblurs, found tier '{restorer.tier}' of rig '{restorer.rig.name}', which "
                "does not. Use Restorer.display, which takes some milliseconds."
            )
        cfa, layout, noise = sharpener.cfa, sharpener.layout, sharpener.noise
        if camera.rows % cfa.rows or camera.columns % cfa.columns:
            raise RestorationError(
                f"Expected frames of whole {cfa.columns} x {cfa.rows} cells, found {camera.columns} x {camera.rows} "
                "samples. Use Restorer.display."
            )
        tables, kernels = sharpener.tables.at(layout.kernel), interpolated_kernels(sharpener.grid, layout.kernel_px)
        white, error = (None, 0.0) if restorer.mask is None else (restorer.mask.white, restorer.mask.error)
        pixel, index = restorer.rectification.from_row(layout.first_row).fixed
        before, taps = interpolation_taps(options.interpolation)
        dark = np.zeros((layout.reach.stop - layout.reach.start, camera.columns), np.float32)
        accurate = restorer.tier is Tier.accurate
        front, filters, bands, learned, maps, panel, dark, lamps = jax.device_put(
            (
                (restorer.blind.wire, white, restorer.noise, least_saturated_DN(restorer.noise)),
                (tables.matched, tables.vectors, tables.values),
                None if noise is None else (noise.variance, noise.probe),
                (network_weights(), kernels) if accurate else None,
                (pixel.astype(np.int32) - before, np.stack([index % len(taps), index // len(taps)], axis=-1), taps),
                None if restorer.panel is None else vars(restorer.panel.sums),
                dark,
                (dark, dark == 0, dark) if accurate else None,
            ),
            device or jax.devices()[0],
        )
        tiles = TileFilter(*filters, layout, cfa, effort_of(restorer.tier))
        stages = _Stages(FrontEnd(*front, cfa), tiles, bands, learned, maps, options.network_views, error)
        sums = (
            None
            if panel is None
            else PanelTables(**{name: part for name, part in panel.items() if name != "region"}, cfa=cfa)
        )
        return cls(restorer, stages, sums, np.empty((0, 0, 3), np.uint8), dark, lamps and _Lamps(*lamps))

    def display(
        self,
        mosaic: UInt16[np.ndarray, "frame_rows frame_columns"],
        exposure_s: float,
        tone: Tone,
        panel_picture: PanelPicture | None = None,
    ) -> UInt8[np.ndarray, "view_rows view_columns 3"]:
        """Restore a frame for a display as ``Restorer.display`` does; arguments and errors are the same."""
        check_frame(mosaic, exposure_s, self.restorer.rig)
        check_panel_picture(panel_picture, self.restorer.rig)
        check_kind(tone, Tone, TONE_ADVICE, RestorationError)
        noise, panel = self.restorer.noise, self.restorer.panel
        known = panel_picture is not None and panel is not None
        # A panel that stands still costs a comparison.
        if panel_picture is not None and panel is not None and self.panel is not None:
            seen = panel.sums.seen(panel_picture)
            if not np.array_equal(self.latest, seen):
                self.latest = seen.copy()
                self.rate = self.panel.rate(jax.device_put(self.latest, self.rate.device))
        exposed = np.array([exposure_s, dark_DN(noise, exposure_s), variance_floor_e2(noise, exposure_s)], np.float32)
        scale = tone.of_electrons(exposure_s).scale()
        rows = self.restorer.blind.mended(mosaic[self.restorer.rows], exposure_s)
        given = jax.device_put((rows, scale, exposed, np.bool_(known)), self.rate.device)
        lamps = self._lamps(mosaic, exposure_s, panel_picture)
        shown, excess = jax.device_get(self.stages.shown(*given, self.rate, lamps))
        if known:
            refuse_excess_of(*map(float, excess))
        return np.asarray(shown)

    def _lamps(
        self,
        mosaic: UInt16[np.ndarray, "frame_rows frame_columns"],
        exposure_s: float,
        panel_picture: PanelPicture | None,
    ) -> _Lamps | None:
        """Return the lamps of a frame, fitted by the processor where any piece that clips may be one."""
        restorer, sharpener = self.restorer, self.restorer.sharpener
        if self.no_lamps is None or sharpener is None:
            return None
        clipped, rows = saturated(mosaic[restorer.rows], restorer.noise), sharpener.grid.kernels.shape[-2]
        if not lamp_pieces(clipped, sharpener.layout, sharpener.options.lamps, rows):
            return self.no_lamps
        light = restorer.scene_light(mosaic, exposure_s, panel_picture)
        dark = sharpener.without_lamps(light.signal_e, light.variance_e2, light.clipped)
        if dark.white_e is None:
            return self.no_lamps
        change = dark.signal_e - light.signal_e
        return _Lamps(*jax.device_put((change, dark.clipped, dark.white_e), self.rate.device))
