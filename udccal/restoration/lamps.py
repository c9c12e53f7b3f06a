"""Lamps beyond the sensor's range: their halo is taken off the frame, and the lamp put back white.

A lamp thirty times as bright as the range has a halo that reaches as far as the kernel. ``clipped`` does not tell how
bright it is, so that streaks and squares stay in the picture. What clips in one piece, small enough that its halo tells
of all its light, is fitted (``lamp_fit``). A piece whose likeliest light is several times the range, in every colour,
is a lamp: its halo is subtracted, and hidden samples get what the rest of the tile says of them. All other pieces stay
as they are, windows and skies too: they are hardly brighter than they seem, and no halo tells of their middle.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final, final

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64

from udccal.cfa import Cfa
from udccal.restoration.filter_tables import FilterTables
from udccal.restoration.kernel_grid import KernelGrid, interpolated_kernels
from udccal.restoration.lamp_fit import Responses, lamp_light
from udccal.restoration.lamp_pieces import Piece, hidden_samples, lamp_pieces
from udccal.restoration.mosaic_filter import likeliest_strength
from udccal.restoration.tiles import TileLayout

# Hidden samples this far from a piece are solved for with it, at most so many; farther ones count as even.
_NEAR, _MOST_HIDDEN = np.ones((81, 33), dtype=np.uint8), 1500
# A lamp's mean light over the range, in its weakest colour; how far it lowers twice the negative log likelihood.
# Its colours are white more or less: what a scene has beside it, taken for its halo, is not so in every colour.
_LEAST_RATIO, _LEAST_EVIDENCE, _MOST_COLOURED = 3.0, 50.0, 3.0
# The first round knows nothing of other pieces' halos: it leaves those that have hardly any light.
ROUNDS: Final = 2
_HARDLY_ANY: Final = 1.0
# A lamp is white where its smooth light is this many times the range; the fit also starts there.
_WHITE: Final = 2.0

Mosaic = Float32[np.ndarray, "rows columns"]
Clipped = Bool[np.ndarray, "rows columns"]


@final
@dataclass(frozen=True)
class Lamp:
    """What is found of a piece.

    Attributes:
        piece: what clips.
        range_e: the light at which it clips.
        light_e: of its pixels, by colour of the pattern.
        window: rows and columns of the strip that its halo reaches.
        halo_e: its light behind the kernel, in the colour of each sample there.
        hidden: samples of its tile that were solved for with it.
        without_e: what they have without it.
        evidence: by how much it lowers twice the negative log likelihood.
    """

    piece: Piece
    range_e: float
    light_e: Float64[np.ndarray, "colours pixels"]
    window: tuple[slice, slice]
    halo_e: Float32[np.ndarray, "high wide"]
    hidden: Clipped
    without_e: Float32[np.ndarray, " hidden"]
    evidence: float

    @property
    def ratio(self) -> float:
        """Mean light over the range, in the weakest colour."""
        return float(self.light_e.sum(axis=1).min()) / (self.piece.area * self.range_e)

    @property
    def found(self) -> bool:
        """Whether the piece is a lamp."""
        by_colour = self.light_e.sum(axis=1)
        white = float(by_colour.max()) <= _MOST_COLOURED * float(by_colour.min())
        return white and self.ratio >= _LEAST_RATIO and self.evidence >= _LEAST_EVIDENCE


@final
@dataclass(frozen=True)
class WithoutLamps:
    """A frame without its lamps.

    Attributes:
        signal_e: the strip without their halos; as it was where there are none.
        clipped: samples that say less than their light was, lamps not counted.
        white_e: the lamps, as bright as the range, on the strip; None where there are none.
    """

    signal_e: Mosaic
    clipped: Clipped
    white_e: Mosaic | None

    def put_back(
        self, picture: Float32[np.ndarray, "covered_rows columns 3"], inner: slice
    ) -> Float32[np.ndarray, "covered_rows columns 3"]:
        """Return a picture of the strip's rows ``inner`` with the lamps."""
        if self.white_e is None:
            return picture
        white = self.white_e[inner, :, None]
        return np.where(white > 0, np.maximum(picture, white), picture)


@final
@dataclass(frozen=True)
class LampFinder:
    """Finds the lamps of a rig's frames.

    Attributes:
        grid: kernels over the sensor.
        layout: the tiles.
        tables: of the filters, by kernel.
        cfa: the colour pattern.
        most: pieces that are tried.
    """

    grid: KernelGrid
    layout: TileLayout
    tables: FilterTables
    cfa: Cfa
    most: int

    def without(self, signal_e: Mosaic, noise_e: Float32[np.ndarray, "tiles 3"], clipped: Clipped) -> WithoutLamps:
        """Take the lamps off a frame.

        Args:
            signal_e: signal in e- of the frame's rows ``layout.reach``, without backscatter.
            noise_e: sigma of a sample of each colour in each tile.
            clipped: samples whose light was more than they say.
        """
        pieces = lamp_pieces(clipped, self.layout, self.most, self.grid.kernels.shape[-2])
        if not pieces:
            return WithoutLamps(signal_e, clipped, None)
        hidden = hidden_samples(clipped)
        untried = hidden.copy()
        for piece in pieces:
            untried[piece.tile][piece.own] = False
        frame = _Frame(signal_e, noise_e, clipped, hidden, untried)
        lamps: dict[int, Lamp] = {}
        for after in range(ROUNDS):
            for number, piece in enumerate(pieces):
                before = lamps.pop(number, None)
                if after == 0 or before is not None:
                    lamp = self._fitted(piece, before, _halos(lamps.values(), signal_e.shape), frame)
                    if lamp is not None and lamp.ratio > _HARDLY_ANY:
                        lamps[number] = lamp
        return self._taken_off([lamp for lamp in lamps.values() if lamp.found], signal_e, clipped)

    @property
    def _size(self) -> tuple[int, int]:
        return self.layout.rows, self.layout.columns

    def _fitted(self, piece: Piece, before: Lamp | None, others: Mosaic, frame: _Frame) -> Lamp | None:
        """Fit a piece's light, the others' halos taken off; None where too much around it is hidden."""
        tile, missing = frame.signal_e[piece.tile] - others[piece.tile], frame.hidden[piece.tile]
        near = cv2.dilate(piece.own.astype(np.uint8), _NEAR) > 0
        hidden = missing & near
        # Halos of what is too large to be tried would count as the piece's.
        if np.count_nonzero(frame.untried[piece.tile] & near) > np.count_nonzero(piece.own):
            return None
        channel, colours = self.cfa.channel_map(*self._size), list(self.cfa.colours)
        noise_e = frame.noise_e[piece.index]
        known = [tile[~missing & (channel == colour)] for colour in range(len(noise_e))]
        if np.count_nonzero(hidden) > _MOST_HIDDEN or min(known[colour].size for colour in colours) == 0:
            return None
        range_e = float(np.median(tile[piece.own & frame.clipped[piece.tile]]))
        if range_e <= 0:  # the panel's light alone fills the range
            return None
        level_e = np.array([np.median(each) if each.size else 0.0 for each in known])[channel]
        clean = np.where(missing, level_e, tile).astype(np.float32)
        light_e = np.full((len(colours), np.count_nonzero(piece.inside)), _WHITE * range_e)
        if before is not None:
            light_e = before.light_e
            clean -= np.where(missing, 0, _halos([before], frame.signal_e.shape)[piece.tile])
            clean[before.hidden] = before.without_e
        kernel = int(self.layout.kernel[piece.index])
        tables, px = self.tables.at(kernel), self.layout.kernel_px[kernel : kernel + 1]
        kernels: np.ndarray = interpolated_kernels(self.grid, px)[0]
        strength = likeliest_strength(clean, noise_e, tables, self.layout, self.cfa)
        responses = Responses.of(tables, strength, kernels, self.cfa, self._size)
        scale, by_colour = noise_e[channel].astype(float), noise_e[colours, None].astype(float)
        rest = np.where(missing & ~hidden, 0.0, (tile - level_e) / scale)
        rest[~hidden] *= self.layout.taper[~hidden]
        unclipped = ~frame.clipped[piece.tile]
        found = lamp_light(rest, level_e / scale, hidden, unclipped, piece.inside, light_e / by_colour, responses)
        without_e = (found.hidden * scale[hidden] + level_e[hidden]).astype(np.float32)
        light_e = found.light * by_colour
        halo = self._halo(piece, light_e, kernels, frame.signal_e.shape)
        return Lamp(piece, range_e, light_e, *halo, hidden, without_e, found.evidence)

    def _halo(
        self,
        piece: Piece,
        light_e: Float64[np.ndarray, "colours pixels"],
        kernels: Float32[np.ndarray, "channels ky kx"],
        shape: tuple[int, ...],
    ) -> tuple[tuple[slice, slice], Float32[np.ndarray, "high wide"]]:
        """Return a piece's light behind its kernel, in the colour of each sample, and where it reaches."""
        down, across = (
            slice(max(part.start - size // 2, 0), min(part.stop + size // 2, most))
            for part, size, most in zip(piece.tile, kernels.shape[1:], shape, strict=True)
        )
        channel = self.cfa.channel_map(*shape)[down, across]
        sharp, halo = (np.zeros(channel.shape, dtype=np.float32) for _ in range(2))
        row, column = np.nonzero(piece.inside)
        at = row + piece.tile[0].start - down.start, column + piece.tile[1].start - across.start
        for colour, light in zip(self.cfa.colours, light_e, strict=True):
            sharp[at] = light
            # A correlation, so the kernel is turned round.
            blurred = cv2.filter2D(sharp, -1, kernels[colour][::-1, ::-1], borderType=cv2.BORDER_CONSTANT)
            halo[channel == colour] = blurred[channel == colour]
        return (down, across), halo

    @staticmethod
    def _taken_off(lamps: list[Lamp], signal_e: Mosaic, clipped: Clipped) -> WithoutLamps:
        if not lamps:
            return WithoutLamps(signal_e, clipped, None)
        rest, still = signal_e - _halos(lamps, signal_e.shape), clipped.copy()
        white = np.zeros_like(signal_e)
        for lamp in lamps:
            piece, own = lamp.piece, lamp.piece.own[lamp.hidden]
            rest[piece.tile][lamp.hidden & piece.own] = lamp.without_e[own]
            still[piece.tile][piece.own] = False
            white[piece.tile] = np.maximum(white[piece.tile], _white(lamp))
        return WithoutLamps(rest, still, white)


@final
@dataclass(frozen=True)
class _Frame:
    """A strip.

    Attributes:
        signal_e: its signal.
        noise_e: of the layout's tiles.
        clipped: samples that say less than their light was.
        hidden: these, and those beside them. untried: hidden ones that no piece has.
    """

    signal_e: Mosaic
    noise_e: Float32[np.ndarray, "tiles 3"]
    clipped: Clipped
    hidden: Clipped
    untried: Clipped


def _halos(lamps: Iterable[Lamp], shape: tuple[int, ...]) -> Mosaic:
    total = np.zeros(shape, dtype=np.float32)
    for lamp in lamps:
        total[lamp.window] += lamp.halo_e
    return total


def _white(lamp: Lamp) -> Mosaic:
    """Return a lamp on its tile, as bright as the range. A sharper edge would ring when the picture is resampled."""
    inside = lamp.piece.inside
    light = np.zeros(inside.shape, dtype=np.float32)
    light[inside] = lamp.light_e.mean(axis=0)
    smooth = cv2.blur(light, (3, 3)) / np.maximum(cv2.blur(inside.astype(np.float32), (3, 3)), np.float32(1 / 9))
    shape = inside & (smooth > _WHITE * lamp.range_e)
    return np.float32(lamp.range_e) * cv2.blur(shape.astype(np.float32), (3, 3))
