"""The PSNR that each tier is expected to reach on a frame, against a camera without a panel.

The three quicker tiers' pictures are made. What ``balanced`` takes out of that of ``fast`` is noise, and tells how
much noise it leaves. Each place also gets the variance of the detail that the tile's filter loses (``lost_detail``);
within a tile it follows the square of the light. How much detail there is where the filter finds none, the finest
detail that it finds tells: where two octaves of it hardly differ, the scene goes on as strong. The quicker tiers differ
from ``balanced`` by errors of their own, and all three leave the halos of lamps, which ``accurate`` takes off. Errors
of the profile, other light that clips, and what is left of the light of a panel whose picture is not known, are not
part of it.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final, final

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int, UInt8, UInt16

from udccal.restoration.lost_detail import LostDetail, lost_detail
from udccal.restoration.metrics import display_exposure, encode_srgb, least_squares_gain
from udccal.restoration.prepared import kept
from udccal.restoration.runtime import Restorer
from udccal.restoration.scene_prior import STRENGTHS
from udccal.restoration.sharpen import Sharpener, Solved
from udccal.restoration.shrink import split
from udccal.tiers import Tier

# Noise that ``balanced`` leaves, over what it takes out.
_LEFT: Final = 1.6
# Of the detail that a filter of some strength loses under the prior, the part that scenes have:
# FLAT flatness^EXPONENT + COARSE / (1 + strength). At little strength the filter loses coarse detail too, which all
# scenes have. These numbers were fitted to the scenes of docs/restoration.md, of which none is flatter than FLATTEST.
_FLAT, _EXPONENT, _COARSE, _FLATTEST = 0.41, 3.2, 0.3, 1.4
# Variance of the error of ``accurate`` over that of ``balanced``: the median of the same scenes.
_NETWORK: Final = 0.81
# Width in px over which light is averaged to tell bright places from dark ones.
_LOCAL_PX: Final = 16
# Every n-th row and column is looked at.
_SPARSE: Final = 3
_NODES, _WEIGHTS = np.polynomial.hermite_e.hermegauss(7)

Places = Float32[np.ndarray, "rows columns 3"]


@final
@dataclass(frozen=True)
class ExpectedError:
    """Errors expected of a frame, at places of the sensor; 1 is a display's white.

    Attributes:
        light: the scene.
        lost: variance of the detail that the filters lose.
        apart: mean square difference of quicker tiers' display-encoded pictures from that of ``balanced``.
        halos: the same of ``balanced`` with the halos of lamps and without.
    """

    light: Places
    lost: Places
    apart: dict[Tier, float]
    halos: float

    def psnr_dB(self, tier: Tier) -> float:
        """Return the PSNR of display-encoded values."""
        sigma, truth = np.sqrt(self.lost), encode_srgb(self.light)
        squared = [np.mean((encode_srgb(self.light + node * sigma) - truth) ** 2) for node in _NODES]
        balanced = _LEFT * self.apart[Tier.fast] + float(np.dot(_WEIGHTS, squared) / _WEIGHTS.sum())
        error = _NETWORK * balanced if tier is Tier.accurate else balanced + self.halos + self.apart.get(tier, 0.0)
        return float(-10.0 * np.log10(max(error, 1e-12)))


def expected_error(
    preview: Restorer,
    restorer: Restorer,
    mosaic: UInt16[np.ndarray, "rows columns"],
    exposure_s: float,
    panel_picture: UInt8[np.ndarray, "panel_rows panel_columns 3"] | None,
    keep: Path | None = None,
) -> ExpectedError:
    """Return the errors that a frame is expected to be restored with, what is left of the panel's light not counted.

    Args:
        preview, restorer: of the tiers preview and balanced, of the same profile, which has a psf.
        mosaic, exposure_s, panel_picture: as for ``Restorer.restore``, with its errors.
        keep: folder that keeps what depends on the profile alone; None to keep nothing.
    """
    sharpener = restorer.sharpener
    assert sharpener is not None
    depends_on, source = (sharpener.grid, sharpener.layout, sharpener.cfa), (sharpener.layout, sharpener.cfa)
    lost = kept(keep, LostDetail, depends_on, lambda: lost_detail(sharpener.tables, *source))
    light = restorer.scene_light(mosaic, exposure_s, panel_picture)
    given = light.signal_e, light.variance_e2, light.clipped
    solved, balanced = sharpener.solved(*given), sharpener.apply(*given)
    white_e = np.float32(1 / display_exposure(balanced))
    view = restorer.strip_rectification
    best, found = (view.apply(picture) / white_e for picture in (balanced, solved.picture))
    quick = preview.restore(mosaic, exposure_s, panel_picture) * (np.float32(exposure_s) / white_e)
    dark = sharpener.without_lamps(*given)
    halos = 0.0
    if dark.white_e is not None:
        without = sharpener.apply(dark.signal_e, light.variance_e2, dark.clipped)
        halos = _apart(view.apply(dark.put_back(without, sharpener.layout.inner)) / white_e, best)
    apart = {Tier.preview: _apart(quick, best), Tier.fast: _apart(found, best)}
    flatness = min(_flatness(encode_srgb(balanced / white_e)), _FLATTEST)
    part = _FLAT * flatness**_EXPONENT + _COARSE / (1 + solved.strengths)
    of_tile = lost.variance[sharpener.layout.kernel, np.searchsorted(STRENGTHS, solved.strengths)] * part[:, None]
    return ExpectedError(*_at_places(sharpener, solved, of_tile, white_e), apart, halos)


def _apart(picture: Places, best: Places) -> float:
    """Return the mean square difference of display-encoded pictures after the least-squares gain of each colour."""
    gain = least_squares_gain(np.clip(picture, 0.0, 1.0), np.clip(best, 0.0, 1.0)).astype(np.float32)
    return float(np.mean((encode_srgb(picture * gain) - encode_srgb(best)) ** 2))


def _flatness(shown: Places) -> float:
    """Return the energy of the finest octave of detail over that of the next."""
    energy = []
    for plane in cv2.split(shown):
        for _ in range(2):
            bands, smooth = split(plane)
            energy.append(sum(float(np.mean(band**2)) for band in bands))
            plane = np.ascontiguousarray(smooth[::2, ::2])
    return sum(energy[::2]) / max(sum(energy[1::2]), 1e-12)


def _at_places(
    sharpener: Sharpener, solved: Solved, lost: Float32[np.ndarray, "tiles 3"], white_e: np.float32
) -> tuple[Places, Places]:
    """Return the light and the variance of lost detail, given by tile in units of its noise."""
    tile, some = _nearest_tile(sharpener), np.s_[::_SPARSE, ::_SPARSE]
    light = np.maximum(solved.picture, np.float32(0))
    contrast = _relative(cv2.blur(light, (_LOCAL_PX, _LOCAL_PX))[some] ** 2, tile)
    return light[some] / white_e, (lost * (solved.noise_e / white_e) ** 2)[tile] * contrast


def _nearest_tile(sharpener: Sharpener) -> Int[np.ndarray, "rows columns"]:
    """Return the tile whose centre is nearest to each place."""
    layout = sharpener.layout
    centres = layout.by_place(layout.centres_px)
    rows, columns = layout.covered
    y, x = np.arange(0, rows, _SPARSE) + layout.first_row, np.arange(0, columns, _SPARSE)
    down = np.abs(y[:, None] - centres[:, 0, 1]).argmin(axis=1)
    across = np.abs(x[:, None] - centres[0, :, 0]).argmin(axis=1)
    return down[:, None] * centres.shape[1] + across


def _relative(values: Float[np.ndarray, "rows columns k"], tile: Int[np.ndarray, "rows columns"]) -> np.ndarray:
    """Return values relative to the mean of their tile."""
    planes = [np.bincount(tile.ravel(), plane.ravel()) for plane in np.moveaxis(values, -1, 0)]
    means = np.stack(planes, axis=-1) / np.bincount(tile.ravel())[:, None]
    return (values / np.maximum(means[tile], 1e-12)).astype(np.float32)
