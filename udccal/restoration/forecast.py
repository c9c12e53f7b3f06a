"""The PSNR that each tier is expected to reach on a frame, against a camera without a panel.

Each place of the picture gets the variance of its error: the tile's noise times what its filter passes, and the detail
that the filter loses (``filter_error``). Within a tile, noise follows the light, and detail its square. The preview has
the detail that its blur changes instead, and the panel's light that the mean of a mask misses. The error then passes
the display's tone curve. Errors of the profile, and light that clips, are not part of it.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final, final

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int, UInt8, UInt16

from udccal.restoration.demosaic import demosaic
from udccal.restoration.filter_error import FilterError, filter_error
from udccal.restoration.metrics import display_exposure, encode_srgb, least_squares_gain
from udccal.restoration.mosaic_filter import STRENGTHS
from udccal.restoration.prepared import kept
from udccal.restoration.runtime import Restorer
from udccal.restoration.sharpen import Sharpener, Solved
from udccal.tiers import Tier

# Part of the prior's detail beyond what the filter finds that photographs have: the prior's power falls slowly and
# without end. Fitted to the scenes of docs/restoration.md.
_DETAIL: Final = 0.25
# Part of the noise that a tier leaves. Shrinkage takes out 1.6 times the noise where nothing else is, little at edges;
# the network's part was fitted to what it gains on eight of these scenes.
_LEFT: Final = {Tier.preview: 0.0, Tier.fast: 1.0, Tier.balanced: 0.5, Tier.accurate: 0.36}
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
        noise: variance of the noise that the filters pass.
        lost: variance of the detail that they lose.
        blur: variance of what the kernels change.
        panel: backscatter that a preview misses.
    """

    light: Places
    noise: Places
    lost: Places
    blur: Places
    panel: Places

    def psnr_dB(self, tier: Tier) -> float:
        """Return the PSNR of display-encoded values after the least-squares gain of each colour."""
        seen = self.light + self.panel if tier is Tier.preview else self.light
        detail = self.blur if tier is Tier.preview else self.lost
        sigma = np.sqrt(_LEFT[tier] * self.noise + _DETAIL * detail)
        gain = least_squares_gain(np.clip(seen, 0.0, 1.0), np.minimum(self.light, 1.0)).astype(np.float32)
        truth = encode_srgb(self.light)
        squared = [np.mean((encode_srgb((seen + node * sigma) * gain) - truth) ** 2) for node in _NODES]
        return float(-10.0 * np.log10(max(np.dot(_WEIGHTS, squared) / _WEIGHTS.sum(), 1e-12)))


def expected_error(
    restorer: Restorer,
    mosaic: UInt16[np.ndarray, "rows columns"],
    exposure_s: float,
    panel_picture: UInt8[np.ndarray, "panel_rows panel_columns 3"] | None,
    keep: Path | None = None,
) -> ExpectedError | None:
    """Return the errors that a frame is expected to be restored with; None where a profile has no psf.

    Args:
        restorer: of the tier fast or balanced.
        mosaic, exposure_s, panel_picture: as for ``Restorer.restore``, with its errors.
        keep: folder that keeps what depends on the profile alone; None to keep nothing.
    """
    sharpener = restorer.sharpener
    if sharpener is None:
        return None
    source = sharpener.grid, sharpener.tables, sharpener.layout, sharpener.cfa
    error = kept(keep, FilterError, (sharpener.grid, sharpener.layout, sharpener.cfa), lambda: filter_error(*source))
    light = restorer.scene_light(mosaic, exposure_s, panel_picture)
    solved = sharpener.solved(light.signal_e, light.variance_e2, light.clipped)
    missed = _missed_by_preview(restorer, light.signal_e, exposure_s, panel_picture)
    white_e = 1 / display_exposure(solved.picture)
    return _at_places(sharpener, solved, error, light.variance_e2, missed[sharpener.layout.inner], white_e)


def _missed_by_preview(
    restorer: Restorer,
    signal: Float32[np.ndarray, "rows columns"],
    exposure_s: float,
    panel_picture: UInt8[np.ndarray, "panel_rows panel_columns 3"] | None,
) -> Float32[np.ndarray, "rows columns 3"]:
    """Return the panel's light in e- that stays when its picture is taken for an even one."""
    if restorer.mask is None or restorer.panel is None or panel_picture is None:
        return np.zeros((*signal.shape, 3), dtype=np.float32)
    rate = restorer.panel.rate(panel_picture)
    levels = restorer.mask.levels(signal + np.float32(exposure_s) * rate, exposure_s, restorer.noise)
    return demosaic(np.float32(exposure_s) * (rate - restorer.mask.rate(levels)), restorer.rig.camera.cfa)


def _at_places(
    sharpener: Sharpener,
    solved: Solved,
    error: FilterError,
    variance_e2: Float32[np.ndarray, "strip_rows columns"],
    missed: Float32[np.ndarray, "rows columns 3"],
    white_e: float,
) -> ExpectedError:
    tile = _nearest_tile(sharpener)
    some = np.s_[::_SPARSE, ::_SPARSE]
    size = (_LOCAL_PX, _LOCAL_PX)
    light = np.maximum(solved.picture, np.float32(0))
    brightness = _relative(cv2.blur(variance_e2, size)[sharpener.layout.inner][some][..., None], tile)
    contrast = _relative(cv2.blur(light, size)[some] ** 2, tile)
    unit = (solved.noise_e / np.float32(white_e)) ** 2
    strength = np.searchsorted(STRENGTHS, solved.strengths)
    each = np.arange(len(strength))
    return ExpectedError(
        light=light[some] / np.float32(white_e),
        noise=(error.noise[each, strength] * unit)[tile] * brightness,
        lost=(error.lost[each, strength] * unit)[tile] * contrast,
        blur=(error.blur * solved.strengths[:, None] * unit)[tile] * contrast,
        panel=missed[some] / np.float32(white_e),
    )


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
