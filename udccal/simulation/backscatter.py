"""Backscatter: the panel's own light in the lens, directly from its emitters and by reflection in its glass.

Three planes send light to the pupil, each out of focus. The first is that of the emitters, which leak backwards. The
second is their mirror image in the outer face of the front glass (glass to air: Fresnel). The third is a fainter image
after a second round trip, by way of the opaque rows. A face at depth t in glass of index n puts the image at 2 t / n.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8
from scipy import sparse
from scipy.interpolate import RectBivariateSpline

from udccal.cfa import cfa_named
from udccal.errors import UdccalError
from udccal.simulation.emission import emitter_shares
from udccal.simulation.truth import RigTruth, pixels_to_directions

_SAMPLES_PER_PERIOD = 10
_MARGIN_CELLS = 2
_ROW_REFLECTANCE = 0.6


@dataclass(frozen=True)
class Backscatterer:
    """The rig's response to panel light, computed once on a coarse grid of sensor positions (``x``, ``y`` in px)."""

    truth: RigTruth
    x: Float[np.ndarray, "grid_columns"]
    y: Float[np.ndarray, "grid_rows"]
    shares: tuple[sparse.csr_array, ...]

    def rate(self, picture: UInt8[np.ndarray, "panel_rows panel_columns 3"]) -> Float[np.ndarray, "rows columns"]:
        """Return the mosaic of backscatter in e-/s, before the wire, while the panel shows ``picture``.

        Raises:
            UdccalError: when the picture is not of the panel's size.
        """
        panel = self.truth.description.panel
        if picture.shape[:2] != (panel.rows, panel.columns):
            raise UdccalError(
                f"Expected a picture of the panel's {panel.columns} x {panel.rows} pixels, found "
                f"{picture.shape[1]} x {picture.shape[0]}. Resize it to the panel."
            )
        light = panel_light(self.truth, picture)
        primaries = [share @ light[:, i] for i, share in enumerate(self.shares)]
        mixed = self.truth.panel.primaries @ np.stack(primaries)
        return self._mosaic(mixed.reshape(3, len(self.y), len(self.x)))

    def _mosaic(self, coarse: Float[np.ndarray, "3 grid_rows grid_columns"]) -> Float[np.ndarray, "rows columns"]:
        camera = self.truth.description.camera
        mosaic = np.empty((camera.rows, camera.columns))
        splines = [RectBivariateSpline(self.y, self.x, channel, kx=3, ky=3) for channel in coarse]
        rows, columns = np.arange(float(camera.rows)), np.arange(float(camera.columns))
        for site in cfa_named(camera.cfa).sites:
            down, across = site.samples
            mosaic[site.samples] = splines[site.channel](rows[down], columns[across])
        return np.maximum(mosaic, 0.0)


def backscatterer(truth: RigTruth) -> Backscatterer:
    """Compute a rig's response to panel light."""
    x, y = coarse_grid(truth)
    pixels = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    directions = pixels_to_directions(truth.optics, pixels)
    shares = tuple(_shares_of_primary(truth, directions, primary) for primary in range(3))
    return Backscatterer(truth, x, y, shares)


def backscatter_rate(
    truth: RigTruth, picture: UInt8[np.ndarray, "panel_rows panel_columns 3"]
) -> Float[np.ndarray, "rows columns"]:
    """Return the mosaic of backscatter in e-/s before the wire; for several pictures keep one ``backscatterer``."""
    return backscatterer(truth).rate(picture)


def panel_light(
    truth: RigTruth, picture: UInt8[np.ndarray, "panel_rows panel_columns 3"]
) -> Float[np.ndarray, "pixels 3"]:
    """Return the linear light of each primary, 0 to 1: the panel's transfer curve is a pure power."""
    curve = ((np.arange(256) / 255.0) ** truth.panel.gamma).astype(np.float32)
    return curve[picture.reshape(-1, 3)]


def coarse_grid(truth: RigTruth) -> tuple[Float[np.ndarray, "grid_columns"], Float[np.ndarray, "grid_rows"]]:
    """Return sensor positions dense enough for the rows' ripple in the backscatter, and a little past the edge."""
    camera, optics = truth.description.camera, truth.optics
    period = truth.panel.pitch_mm / abs(float(optics.pupil_mm[2])) * optics.fx_px
    step = max(1, int(period / _SAMPLES_PER_PERIOD))

    def positions(samples: int) -> Float[np.ndarray, "grid"]:
        return np.arange(-_MARGIN_CELLS * step, samples + _MARGIN_CELLS * step, step, dtype=float)

    return positions(camera.columns), positions(camera.rows)


def fresnel_reflectance(index: float, cosine: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """Return the reflectance of a glass face for unpolarised light, by the cosine of its angle in air (Fresnel)."""
    inside = np.sqrt(1 - (1 - cosine**2) / index**2)
    across = (cosine - index * inside) / (cosine + index * inside)
    parallel = (index * cosine - inside) / (index * cosine + inside)
    return (across**2 + parallel**2) / 2


def _shares_of_primary(truth: RigTruth, directions: Float[np.ndarray, "n 3"], primary: int) -> sparse.csr_array:
    panel = truth.panel
    cosine = directions[:, 2]
    reflectance = fresnel_reflectance(panel.glass_index, cosine)
    once = panel.reflection_e_per_s * reflectance / fresnel_reflectance(panel.glass_index, np.ones(1))
    round_trip_mm = 2 * panel.glass_thickness_mm / panel.glass_index
    paths = (
        (0.0, panel.leak_e_per_s * cosine),
        (round_trip_mm, once),
        (2 * round_trip_mm, once * reflectance * _ROW_REFLECTANCE),
    )
    parts = [emitter_shares(truth, directions, depth, weight, primary) for depth, weight in paths]
    return sparse.csr_array(parts[0] + parts[1] + parts[2])
