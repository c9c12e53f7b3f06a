"""Light of pictures over that of white at sensor positions, and its derivatives by the parameters.

This is ``udccal.models.backscatter`` in numpy: a fit needs it at few positions and for many parameters, for which
compiling takes longer than computing. White is the first shot, the dark frame the last.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple, final

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy import sparse
from scipy.spatial.transform import Rotation
from scipy.special import erf

from udccal.fitting.backscatter.parameters import (
    DEPTH,
    DISTANCE,
    EMITTERS,
    MIX,
    OFF_DIAGONAL,
    OFFSET,
    PUPIL,
    REFLECTION,
    SOFTNESS,
    Vector,
    emitters_of,
)
from udccal.models.backscatter import Backscatter

# Axes: shot, colour, position; bin: colour, position; Moves add the parameter. Rays are in panel coordinates.
PerShot = Float[np.ndarray, "shots 3 n"]
PerBin = Float[np.ndarray, "3 n"]
Usable = Bool[np.ndarray, "shots 3 n"]
Rays = Float[np.ndarray, "n 3"]
Moves = Float[np.ndarray, "k shots 3 n"]
_LEAST_WHITE = 1e-9
# The soft edge differs from 0 or 1 by 1e-12 at this many of its sigmas.
_EDGE_SIGMAS = 7.0


class _Footprints(NamedTuple):
    """Ellipses in panel px: slopes of rays, centres on the emitters' and the reflection's plane, shapes of the disc."""

    slope: Float[np.ndarray, "n 2"]
    centre: Float[np.ndarray, "n 2 2"]
    shape: Float[np.ndarray, "n 2 2"]


def _footprints(template: Backscatter, theta: Vector, rays: Rays) -> _Footprints:
    """Return ``models.backscatter.footprints`` of both planes."""
    geometry, pitch = template.geometry, float(np.asarray(template.pitch_mm))
    slope = rays[:, :2] / rays[:, 2:]
    across = Rotation.from_rotvec(np.asarray(geometry.rotation_rad)).as_matrix()[:, :2] * np.exp(theta[PUPIL]) / 2
    planes = np.exp(theta[DISTANCE]) + np.array([0.0, np.exp(theta[DEPTH])])
    centre = np.asarray(geometry.pupil_mm)[:2] + planes[:, None] * slope[:, None]
    return _Footprints(slope / pitch, centre / pitch, (across[:2] - slope[:, :, None] * across[2]) / pitch)


def window_for(template: Backscatter, theta: Vector, rays: Rays, slack: float) -> int:
    """Return the odd number of panel pixels across a window that holds both footprints at every position.

    Args:
        template: gives the geometry.
        theta: of ``parameters.linear_of``.
        rays: in panel coordinates.
        slack: distance between footprints and the window's edge in panel px.
    """
    return _window(_footprints(template, theta, rays), theta, 4 * float(np.exp(theta[SOFTNESS])) + slack)


def _window(at: _Footprints, theta: Vector, edge_px: Float[np.ndarray, "*n"] | float) -> int:
    reach_px = np.linalg.norm(at.shape, axis=2).max(axis=1) + np.abs(at.centre[:, 1] - at.centre[:, 0]).max(axis=1) / 2
    spread = np.abs(emitters_of(theta) - emitters_of(theta).mean(axis=0)).max()
    return 2 * int(np.ceil((reach_px + edge_px).max() + spread)) + 1


def corners_of(template: Backscatter, theta: Vector, rays: Rays) -> Int[np.ndarray, "n 2"]:
    """Return (column, row) of the first panel pixel of the window around each position's footprints."""
    middle = _footprints(template, theta, rays).centre.mean(axis=1) - emitters_of(theta).mean(axis=0)
    return np.round(middle - (template.window - 1) / 2).astype(np.int64)


@final
@dataclass(frozen=True)
class PanelCrop:
    """The part of the panel that the camera can see: its first pixel and its size."""

    column: int
    row: int
    columns: int
    rows: int

    def of(self, picture: UInt8[np.ndarray, "panel_rows panel_columns 3"]) -> UInt8[np.ndarray, "rows columns 3"]:
        """Return that part of a picture."""
        return picture[self.row : self.row + self.rows, self.column : self.column + self.columns].copy()


@final
@dataclass(frozen=True)
class Pictures:
    """The pictures in the part of the panel that the camera sees: white first, and black last.

    Values are 0 to 255 by primary. Pixels of the crop are row by row; a black one follows for all beyond the crop.
    """

    values: UInt8[np.ndarray, "3 pixels shots"]
    crop: PanelCrop

    @classmethod
    def of(cls, shown: UInt8[np.ndarray, "pictures crop_rows crop_columns 3"], crop: PanelCrop) -> Pictures:
        """Add white and black to pictures in the crop with values 0 to 255."""
        values = shown.reshape(len(shown), crop.rows * crop.columns, 3).transpose(2, 1, 0)
        white = np.full((3, values.shape[1], 1), 255, np.uint8)
        return cls(np.pad(np.concatenate([white, values], axis=2), ((0, 0), (0, 1), (0, 1))), crop)

    def light(self, gamma: float) -> Float[np.ndarray, "2 3 pixels shots"]:
        """Return the light of the panel's primaries, 1 at most, and its derivative by gamma."""
        log = np.log(np.maximum(np.arange(256), 1) / 255)
        light = np.where(np.arange(256) > 0, np.exp(gamma * log), 0.0)
        return np.stack([light, light * log])[:, self.values]

    def index(self, panel_px: Int[np.ndarray, "k 2"]) -> Int[np.ndarray, " k"]:
        """Return the indices of panel pixels (column, row) among those of ``light``."""
        crop = self.crop
        column, row = panel_px[:, 0] - crop.column, panel_px[:, 1] - crop.row
        inside = (column >= 0) & (column < crop.columns) & (row >= 0) & (row < crop.rows)
        return np.where(inside, row * crop.columns + column, crop.rows * crop.columns)


@final
@dataclass(frozen=True)
class Shares:
    """Shares of emitters that are not 0, in rows of one position, plane (direct, reflected) and primary.

    Attributes:
        positions: number of positions.
        row, panel_px: of each share; (column, row) of its panel pixel.
        value: the share.
        edge: which of them are at their footprint's edge.
        slopes: derivatives of these by the emitter's place (x, y), and by the logarithms of softness and of the pupil,
            whose area is constant here.
    """

    positions: int
    row: Int[np.ndarray, " k"]
    panel_px: Int[np.ndarray, "k 2"]
    value: Float[np.ndarray, " k"]
    edge: Bool[np.ndarray, " k"]
    slopes: Float[np.ndarray, "d e"]

    @classmethod
    def of(cls, template: Backscatter, theta: Vector, rays: Rays, derivatives: bool = False) -> Shares:
        """Return ``models.backscatter.emitter_shares`` of each plane; without derivatives ``slopes`` has no rows.

        A window wider than the template's, as only a fit that goes astray needs it, is cut to that.
        """
        feet, softness = _footprints(template, theta, rays), float(np.exp(theta[SOFTNESS]))
        inverse, area = np.linalg.inv(feet.shape), np.pi * np.abs(np.linalg.det(feet.shape))
        # Half width of the soft edge where the ellipse is narrowest, in units of the ellipse.
        reach = _EDGE_SIGMAS * softness / np.linalg.svd(feet.shape, compute_uv=False)[:, 1]
        needed = _window(feet, theta, reach * np.linalg.norm(feet.shape, axis=2).max(axis=1) + 0.5)
        window = min(needed, template.window)
        corner = corners_of(replace(template, window=window), theta, rays)
        # The emitter of each window's first pixel, seen from the footprint's centre, in units of the ellipse.
        first = corner[:, None, None] + emitters_of(theta) - feet.centre[:, :, None]
        first, step = np.einsum("nij,npcj->inpc", inverse, first)[..., None, None], np.arange(window)
        x, y = (
            (first[i] + (inverse[:, i, 1, None] * step)[:, None, None, :, None])
            + (inverse[:, i, 0, None] * step)[:, None, None, None, :]
            for i in (0, 1)
        )
        square = x * x + y * y + 1e-6
        inside = np.flatnonzero(square < ((1 + reach) ** 2)[:, None, None, None, None])
        row, pixel = np.divmod(inside, window**2)
        panel_px = corner[row // 6] + np.stack([pixel % window, pixel // window], axis=1)
        value, square = (1 / area)[row // 6], square.ravel()[inside]
        edge = square > (np.maximum(1 - reach, 0.0) ** 2)[row // 6]
        n, inside, square = row[edge] // 6, inside[edge], square[edge]
        share, *slopes = _soft_edge(x.ravel()[inside], y.ravel()[inside], square, inverse[n], softness, derivatives)
        value[edge] *= share
        return cls(len(area), row, panel_px, value, edge, np.reshape(slopes, (len(slopes), len(n))) / area[n])

    def light(
        self, shown: Pictures, panel: Float[np.ndarray, "3 pixels shots"]
    ) -> Float[np.ndarray, "positions 2 3 shots"]:
        """Sum the light ``panel`` of each primary over the footprints."""
        return self._sums(np.ones_like(self.edge), self.value[None], shown, panel)[0]

    def light_slopes(
        self, shown: Pictures, panel: Float[np.ndarray, "3 pixels shots"]
    ) -> Float[np.ndarray, "d positions 2 3 shots"]:
        """Return the derivatives of ``light`` in the order of ``slopes``."""
        return self._sums(self.edge, self.slopes, shown, panel)

    def _sums(
        self, which: np.ndarray, values: np.ndarray, shown: Pictures, panel: np.ndarray
    ) -> Float[np.ndarray, "d positions 2 3 shots"]:
        row, rows, (_, pixels, shots) = self.row[which], 6 * self.positions, panel.shape
        columns, ends = row % 3 * pixels + shown.index(self.panel_px[which]), np.searchsorted(row, np.arange(rows + 1))
        matrices = [sparse.csr_array((one, columns, ends), shape=(rows, 3 * pixels)) for one in values]
        return np.stack([one @ panel.reshape(-1, shots) for one in matrices]).reshape(-1, self.positions, 2, 3, shots)


def _soft_edge(
    x: Float[np.ndarray, " e"],
    y: Float[np.ndarray, " e"],
    square: Float[np.ndarray, " e"],
    inverse: Float[np.ndarray, "e 2 2"],
    softness: float,
    derivatives: bool,
) -> tuple[Float[np.ndarray, " e"], ...]:
    """Return the part of emitters inside, and on request the derivatives of ``Shares.slopes``.

    At u = inverse @ place, r^2 = |u|^2 + 1e-6, the distance from the edge is d = (1 - r) / |g|, g = inverse^T u / r.
    """
    (a, b), (c, d) = inverse.transpose(1, 2, 0)
    radius = np.sqrt(square)
    g_x, g_y = (a * x + c * y) / radius, (b * x + d * y) / radius
    steep = g_x * g_x + g_y * g_y
    length = np.sqrt(steep + 1e-12)
    distance = (1 - radius) / length
    share = 0.5 + 0.5 * erf(distance / (np.sqrt(2.0) * softness))
    if not derivatives:
        return (share,)
    density = np.exp(-0.5 * (distance / softness) ** 2) / (np.sqrt(2 * np.pi) * softness)
    # The change of |g| with the place, times r: (inverse^T inverse - |g|^2) g.
    along = a * g_x + b * g_y, c * g_x + d * g_y
    bent = distance / (radius * length)
    by_x = -density / length * (g_x + bent * (a * along[0] + c * along[1] - steep * g_x))
    by_y = -density / length * (g_y + bent * (b * along[0] + d * along[1] - steep * g_y))
    # A larger pupil makes u shorter.
    shorter = 1 - 1e-6 / square
    by_pupil = density * (radius * shorter / length + distance * steep / length**2 * (2 - shorter))
    return share, by_x, by_y, -distance * density, by_pupil


def ratios(template: Backscatter, theta: Vector, rays: Rays, shown: Pictures) -> PerShot:
    """Return the light of pictures over that of white, by shot, colour and position."""
    return ratios_of(theta, Shares.of(template, theta, rays).light(shown, shown.light(float(theta[0]))[0]))


def ratios_of(theta: Vector, light: Float[np.ndarray, "n 2 3 shots"]) -> PerShot:
    """Return ratios from the light of both planes."""
    mixed = _mixed(theta, _joined(theta, light)[None])[0]
    return mixed / np.maximum(mixed[0], _LEAST_WHITE)


def ratios_and_jacobian(template: Backscatter, theta: Vector, rays: Rays, shown: Pictures) -> tuple[PerShot, Moves]:
    """Return ``ratios``, by shot, colour and position, and their derivatives by each of ``theta``.

    Args:
        template, theta: geometry and window; parameters of ``parameters.linear_of``.
        rays, shown: in panel coordinates; what the panel showed.
    """
    shares, (panel, by_gamma) = Shares.of(template, theta, rays, derivatives=True), shown.light(float(theta[0]))
    light, slopes = shares.light(shown, panel), shares.light_slopes(shown, panel)
    slope, whole = _footprints(template, theta, rays).slope.T[:, :, None, None], _joined(theta, light)
    by_x, by_y, by_softness, by_pupil = _joined(theta, slopes)
    moves = np.zeros((len(theta), *whole.shape))
    moves[0] = _joined(theta, shares.light(shown, by_gamma))
    moves[DISTANCE] = -np.exp(theta[DISTANCE]) * (slope[0] * by_x + slope[1] * by_y)
    moves[PUPIL] = by_pupil - 2 * whole
    moves[SOFTNESS] = by_softness
    moves[REFLECTION] = light[:, 1] - light[:, 0]
    deeper = slope[0] * slopes[0, :, 1] + slope[1] * slopes[1, :, 1]
    moves[DEPTH] = -np.exp(theta[DEPTH]) * theta[REFLECTION] * deeper
    moves[OFFSET] = by_x, by_y
    # The emitters of red, and of blue.
    moves[EMITTERS][:2, :, 0] = by_x[:, 0], by_y[:, 0]
    moves[EMITTERS][2:, :, 2] = by_x[:, 2], by_y[:, 2]
    mixed = _mixed(theta, np.concatenate([whole[None], moves]))
    for k, (colour, primary) in enumerate(zip(*OFF_DIAGONAL, strict=True), MIX.start + 1):
        mixed[k, :, colour] = whole[:, primary].T
    white = np.maximum(mixed[0, 0], _LEAST_WHITE)
    ratio = mixed[0] / white
    return ratio, (mixed[1:] - ratio * mixed[1:, :1]) / white


def _joined(theta: Vector, light: Float[np.ndarray, "*k n 2 3 shots"]) -> Float[np.ndarray, "*k n 3 shots"]:
    """Return the light of both planes together."""
    return (1 - theta[REFLECTION]) * light[..., 0, :, :] + theta[REFLECTION] * light[..., 1, :, :]


def _mixed(theta: Vector, primaries: Float[np.ndarray, "k n 3 shots"]) -> Moves:
    """Mix primaries into camera colours, except for a factor per colour, which cancels in ratios."""
    mix = np.eye(3)
    mix[OFF_DIAGONAL] = theta[MIX]
    return np.einsum("cp,knps->kscn", mix, primaries)
