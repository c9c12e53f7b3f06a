"""Light on one rig's sensor for each arrangement: y = [(x * k) + b] w, in e-/s behind the colour filters, no noise.

Wire map, blur and response to the panel's light depend on the rig alone. They are computed when first needed, and kept.
"""

from __future__ import annotations

from functools import cached_property, lru_cache
from typing import final

import numpy as np
from jaxtyping import Float, UInt8

from udccal.arrangements import Board, Led, Photograph
from udccal.cameras.protocol import Region
from udccal.cfa import cfa_named
from udccal.simulation.backscatter import Backscatterer, backscatterer
from udccal.simulation.blur import SpaceVariantBlur, build_blur
from udccal.simulation.psf import captured_light, spread_at
from udccal.simulation.scene import render_board, render_photograph
from udccal.simulation.spread import AngularSpread
from udccal.simulation.truth import RigTruth
from udccal.simulation.wire import wire_map

# Response of the camera's red, green and blue to the white LED light of the flat field and of the small LED.
LED_WHITE = np.array([0.6, 1.0, 0.7])
_FLAT_FILL, _FLAT_EXPOSURE_S = 0.65, 8e-3
_LED_FILL, _LED_EXPOSURE_S = 0.8, 100e-6
# A board is located by its corners: light scattered far from them, or a percent of the kernel, does not matter.
_BOARD_BLUR = (8, 129, 65)  # rank, rows, columns
# Each pattern takes about 50 MB at full size. The psf procedure's shifts of an LED lie within one Bayer cell.
_KEPT_SPREADS = 4
_CELL_PX = 2
# Patterns reach a multiple of this far, so that one serves an LED that is nudged: each takes seconds to compute.
_REACH_PX = 32


@final
class RigLight:
    """The deterministic part of a simulated rig: everything in front of the photodiodes."""

    def __init__(self, truth: RigTruth) -> None:
        self.truth = truth
        self._peaks: dict[float, float] = {}
        self._spread_at = lru_cache(maxsize=_KEPT_SPREADS)(
            lambda x, y, reach_x, reach_y: spread_at(truth, np.array([x, y]), (reach_x, reach_y))
        )

    @cached_property
    def wire(self) -> Float[np.ndarray, "rows columns"]:
        """The true wire map, mean 1."""
        return wire_map(self.truth)

    @cached_property
    def backscatterer(self) -> Backscatterer:
        """The true response to panel light."""
        return backscatterer(self.truth)

    @cached_property
    def blur(self) -> SpaceVariantBlur:
        """The true blur of photographs."""
        captures = self.truth.description.captures
        rows, columns = captures.psf_region_rows | 1, captures.psf_region_columns | 1
        return build_blur(self.truth, max(captures.psf_columns, 5), max(captures.psf_rows, 4), rows, columns)

    @cached_property
    def board_blur(self) -> SpaceVariantBlur:
        """The blur of boards, with smaller kernels and a lower rank."""
        return self.blur.smaller(*_BOARD_BLUR)

    def flat(self) -> Float[np.ndarray, "rows columns"]:
        """Return the light of an even white field that fills the wells to about 65 % (green, mean) in 8 ms."""
        camera = self.truth.description.camera
        rate = _FLAT_FILL * self.truth.sensor.full_well_e / _FLAT_EXPOSURE_S
        return rate * LED_WHITE[cfa_named(camera.cfa).channel_map(camera.rows, camera.columns)] * self.wire

    def board(self, board: Board) -> Float[np.ndarray, "rows columns"]:
        """Return the light of a board in even surroundings."""
        return self._mosaic(render_board(self.truth, board, self.board_blur)) * self.wire

    def panel(self, picture: UInt8[np.ndarray, "panel_rows panel_columns 3"]) -> Float[np.ndarray, "rows columns"]:
        """Return the panel's own light in a dark room."""
        return self.backscatterer.rate(picture) * self.wire

    def photograph(self, photograph: Photograph) -> Float[np.ndarray, "rows columns"]:
        """Return the light of a scene through the panel, which may be lit."""
        scene = self._mosaic(render_photograph(self.truth, photograph, self.blur))
        if photograph.panel_picture is not None:
            scene = scene + self.backscatterer.rate(photograph.panel_picture)
        return scene * self.wire

    def led(self, led: Led, image_px: tuple[float, float], region: Region) -> Float[np.ndarray, "rows columns"]:
        """Return the light in ``region`` of a small LED whose image is centred at ``image_px``."""
        disc_px = self.led_disc_px(led)
        rows, columns = region.rows | 1, region.columns | 1
        middle = np.array([region.x + columns // 2, region.y + rows // 2], dtype=float)
        offset = (float(image_px[0] - middle[0]), float(image_px[1] - middle[1]))
        spread = self._spread_near(led, region)
        light = captured_light(self.truth, middle, rows, columns, offset, disc_px, spread=spread)
        light = light[:, : region.rows, : region.columns]
        down, across = slice(region.y, region.y + region.rows), slice(region.x, region.x + region.columns)
        channels = cfa_named(self.truth.description.camera.cfa).channel_map(region.rows, region.columns)
        coloured = LED_WHITE[channels] * np.take_along_axis(light, channels[None], axis=0)[0]
        return self._led_flux(disc_px) * coloured * self.wire[down, across]

    def _spread_near(self, led: Led, region: Region) -> AngularSpread:
        """Return the diffraction pattern at the centre of the cell that the LED is aimed at, for all of the region.

        The pattern depends on the cell, not on the previous LED, so that a resumed session sees the same light as an
        uninterrupted one.
        """
        x, y = (_CELL_PX * np.floor(v / _CELL_PX) + _CELL_PX / 2 for v in (led.x_px, led.y_px))
        reach_x = max(x - region.x, region.x + region.columns - x)
        reach_y = max(y - region.y, region.y + region.rows - y)
        reach = (float(_REACH_PX * np.ceil(part / _REACH_PX)) for part in (reach_x, reach_y))
        return self._spread_at(float(x), float(y), *reach)

    def led_disc_px(self, led: Led) -> float:
        """Return the diameter of the LED's image in px."""
        distance = led.distance_mm - float(self.truth.optics.pupil_mm[2])
        return led.diameter_mm / distance * self.truth.optics.fx_px

    def _led_flux(self, disc_px: float) -> float:
        """Return the LED's total light in e-/s: its brightest pixel reaches 80 % of the full well in 100 us."""
        if disc_px not in self._peaks:
            camera = self.truth.description.camera
            middle = np.array([camera.columns // 2, camera.rows // 2], dtype=float)
            light = captured_light(self.truth, middle, 9, 9, source_disc_px=disc_px)
            self._peaks[disc_px] = float((light.max(axis=(1, 2)) * LED_WHITE).max() * self.wire.max())
        return _LED_FILL * self.truth.sensor.full_well_e / _LED_EXPOSURE_S / self._peaks[disc_px]

    def _mosaic(self, colours: Float[np.ndarray, "rows columns 3"]) -> Float[np.ndarray, "rows columns"]:
        mosaic = np.empty(colours.shape[:2])
        for site in cfa_named(self.truth.description.camera.cfa).sites:
            mosaic[site.samples] = colours[(*site.samples, site.channel)]
        return mosaic
