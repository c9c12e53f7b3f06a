"""Positions on the sensor; the light of pictures over that of white there, and its derivatives by the parameters.

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
from udccal.fitting.wire.data import ideal_points
from udccal.models.backscatter import Backscatter
from udccal.models.geometry import Geometry
from udccal.rig import RigDescription

# Axes: shot, colour, position; bin: colour, position; Moves add the parameter. Rays are in panel coordinates.
PerShot = Float[np.ndarray, "shots 3 n"]
PerBin = Float[np.ndarray, "3 n"]
Usable = Bool[np.ndarray, "shots 3 n"]
Rays = Float[np.ndarray, "n 3"]
Moves = Float[np.ndarray, "k shots 3 n"]
_LEAST_WHITE = 1e-9
# A window holds the soft edge up to this many of its sigmas; at so many it differs from 0 or 1 by 1e-12.
_WINDOW_SIGMAS, _EDGE_SIGMAS = 4.0, 7.0


def grid_step(rig: RigDescription) -> int:
    """Return the grid's spacing in sensor px: even, about an eighth of the rows' period, with a small remainder."""
    camera = rig.camera
    period = rig.panel.pitch_mm.value / rig.mounting.standoff_mm.value * rig.focal_px
    largest = max(4, int(period / 8))
    choices = range(2 * (largest // 2), max(2, int(0.6 * largest)), -2)
    return min(choices, key=lambda step: camera.columns % step + camera.rows % step)


def sampled_rays(geometry: Geometry, rig: RigDescription, step: int, count: int) -> tuple[Rays, Int[np.ndarray, " n"]]:
    """Spread about ``count`` positions evenly over the grid (Roberts's R2 sequence, of the plastic number).

    Args:
        geometry, rig: give the rays of pixels and the sensor's size.
        step: spacing of the grid in sensor px.
        count: number of positions wanted; those that coincide are merged.

    Returns:
        rays in panel coordinates, and flat grid indices in rising order.
    """
    shape = rig.camera.rows // step, rig.camera.columns // step
    plastic = 1.32471795724474602596
    sequence = (0.5 + np.arange(count)[:, None] / np.array([plastic, plastic**2])) % 1.0
    columns, rows = (sequence * shape[::-1]).astype(int).T
    flat = np.unique(rows * shape[1] + columns)
    return grid_rays(geometry, shape, step, flat), flat


def grid_rays(geometry: Geometry, shape: tuple[int, int], step: int, flat: Int[np.ndarray, " n"]) -> Rays:
    """Return the rays, in panel coordinates, of positions of a grid of ``shape`` (rows, columns), by flat index."""
    rows, columns = np.divmod(flat, shape[1])
    return directions(geometry, step * (np.stack([columns, rows], axis=1) + 0.5) - 0.5)


def directions(geometry: Geometry, pixels: Float[np.ndarray, "n 2"]) -> Rays:
    """Return the rays of sensor pixels in panel coordinates, as ``models.geometry.panel_directions`` does."""
    ideal = ideal_points(geometry, pixels)
    rays = np.insert(ideal, 2, 1.0, axis=1) @ Rotation.from_rotvec(np.asarray(geometry.rotation_rad)).as_matrix().T
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


class _Footprints(NamedTuple):
    """Ellipses in panel px: slopes of rays, centres on the emitters' and the reflection's plane, shapes of the disc."""

    slope: Float[np.ndarray, "n 2"]
    centre: Float[np.ndarray, "n 2 2"]
    shape: Float[np.ndarray, "n 2 2"]


def _footprints(template: Backscatter, theta: Vector, rays: Rays) -> _Footprints:
    """``models.backscatter.footprints`` of both planes."""
    geometry, pitch = template.geometry, float(np.asarray(template.pitch_mm))
    slope = rays[:, :2] / rays[:, 2:]
    across = Rotation.from_rotvec(np.asarray(geometry.rotation_rad)).as_matrix()[:, :2] * np.exp(theta[PUPIL]) / 2
    planes = np.exp(theta[DISTANCE]) + np.array([0.0, np.exp(theta[DEPTH])])
    centre = np.asarray(geometry.pupil_mm)[:2] + planes[:, None] * slope[:, None]
    return _Footprints(slope / pitch, centre / pitch, (across[:2] - slope[:, :, None] * across[2]) / pitch)


def window_for(template: Backscatter, theta: Vector, rays: Rays, slack: float) -> int:
    """Return the odd number of panel pixels across a window that holds both footprints at every position.

    Between footprints and the window's edge are ``slack`` panel px; ``theta`` is of ``parameters.linear_of``.
    """
    at, emitters = _footprints(template, theta, rays), emitters_of(theta)
    reach_px = np.linalg.norm(at.shape, axis=2).max(axis=1) + np.abs(at.centre[:, 1] - at.centre[:, 0]).max(axis=1) / 2
    edge_px = _WINDOW_SIGMAS * float(np.exp(theta[SOFTNESS])) + slack
    return 2 * int(np.ceil(reach_px.max() + edge_px + np.abs(emitters - emitters.mean(axis=0)).max())) + 1


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

    Values are 0 to 255 by primary, pixels row by row. A black border of one pixel stands for all beyond the crop.
    """

    values: UInt8[np.ndarray, "3 pixels shots"]
    crop: PanelCrop

    @classmethod
    def of(cls, shown: UInt8[np.ndarray, "pictures crop_rows crop_columns 3"], crop: PanelCrop) -> Pictures:
        """Add white and black to pictures in the crop with values 0 to 255."""
        white, black = (np.full((1, *shown.shape[1:]), value, np.uint8) for value in (255, 0))
        every = np.pad(np.concatenate([white, shown, black]), ((0, 0), (1, 1), (1, 1), (0, 0)))
        return cls(every.reshape(len(every), -1, 3).T.copy(), crop)

    def light(self, gamma: float) -> Float[np.ndarray, "2 3 pixels shots"]:
        """Return the light of the panel's primaries, 1 at most, and its derivative by gamma."""
        log = np.log(np.maximum(np.arange(256), 1) / 255)
        light = np.where(np.arange(256) > 0, np.exp(gamma * log), 0.0)
        return np.stack([light, light * log])[:, self.values]

    def index(self, panel_px: Int[np.ndarray, "k 2"]) -> Int[np.ndarray, " k"]:
        """Return the indices of panel pixels (column, row) among those of ``light``."""
        inner = np.array([self.crop.columns, self.crop.rows])
        column, row = np.clip(panel_px - [self.crop.column, self.crop.row] + 1, 0, inner + 1).T
        return row * (self.crop.columns + 2) + column


@final
@dataclass(frozen=True)
class Shares:
    """Shares of emitters that are not 0, in rows of one position, plane (direct, reflected) and primary.

    Attributes:
        positions: number of positions.
        row, panel_px: of each share; (column, row) of its panel pixel.
        values: the shares; then, on request, their derivatives by the emitter's place (x, y), and by the logarithms of
            softness and of the pupil, whose area is constant here.
    """

    positions: int
    row: Int[np.ndarray, " k"]
    panel_px: Int[np.ndarray, "k 2"]
    values: Float[np.ndarray, "d k"]

    @classmethod
    def of(cls, template: Backscatter, theta: Vector, rays: Rays, derivatives: bool = False) -> Shares:
        """Return ``models.backscatter.emitter_shares`` of each plane.

        A window wider than the template's, as only a fit that goes astray needs it, is cut to that.
        """
        feet, softness = _footprints(template, theta, rays), float(np.exp(theta[SOFTNESS]))
        inverse, area = np.linalg.inv(feet.shape), np.pi * np.abs(np.linalg.det(feet.shape))
        needed = window_for(template, theta, rays, (_EDGE_SIGMAS - _WINDOW_SIGMAS) * softness + 0.5)
        window = min(needed, template.window)
        corner = corners_of(replace(template, window=window), theta, rays)
        # Emitters seen from the footprints' centres, in units of the ellipse: that of the window's corner, then all.
        first = corner[:, None, None] + emitters_of(theta) - feet.centre[:, :, None]
        inner = np.stack(np.divmod(np.arange(window**2), window)[::-1])
        across = np.moveaxis(inverse @ inner, 1, 0)[:, :, None, None]
        x, y = np.einsum("nij,npcj->inpc", inverse, first)[..., None] + across
        # The edge is widest in these units where the ellipse is narrowest.
        reach = 1 + _EDGE_SIGMAS * softness / np.linalg.svd(feet.shape, compute_uv=False)[:, 1]
        inside = np.flatnonzero(x * x + y * y < (reach**2)[:, None, None, None])
        row, pixel = np.divmod(inside, window**2)
        n = row // 6
        values = _soft_edge(x.ravel()[inside], y.ravel()[inside], inverse[n], softness, derivatives)
        return cls(len(area), row, corner[n] + inner.T[pixel], np.stack(values) / area[n])

    def light(
        self, shown: Pictures, panel: Float[np.ndarray, "3 pixels shots"]
    ) -> Float[np.ndarray, "d positions 2 3 shots"]:
        """Sum the light ``panel`` of each primary over the footprints, for each of ``values``."""
        rows, (_, pixels, shots) = 6 * self.positions, panel.shape
        columns, ends = self.row % 3 * pixels + shown.index(self.panel_px), self.row.searchsorted(np.arange(rows + 1))
        matrices = (sparse.csr_array((one, columns, ends), shape=(rows, 3 * pixels)) for one in self.values)
        sums = np.stack([one @ panel.reshape(-1, shots) for one in matrices])
        return sums.reshape(-1, self.positions, 2, 3, shots)


def _soft_edge(
    x: Float[np.ndarray, " k"],
    y: Float[np.ndarray, " k"],
    inverse: Float[np.ndarray, "k 2 2"],
    softness: float,
    derivatives: bool,
) -> tuple[Float[np.ndarray, " k"], ...]:
    """Return the part of emitters inside, and on request its derivatives; see ``Shares.values``.

    At u = inverse @ place, r^2 = |u|^2 + 1e-6 and h = inverse^T u, the distance from the edge is d = (1 - r) r / |h|.
    """
    (a, b), (c, d) = inverse.transpose(1, 2, 0)
    square, h_x, h_y = x * x + y * y + 1e-6, a * x + c * y, b * x + d * y
    radius, steep = np.sqrt(square), h_x * h_x + h_y * h_y + 1e-12 * square
    distance = (1 - radius) * radius / np.sqrt(steep)
    share = 0.5 + 0.5 * erf(distance / (np.sqrt(2.0) * softness))
    if not derivatives:
        return (share,)
    density = np.exp(-0.5 * (distance / softness) ** 2) / (np.sqrt(2 * np.pi) * softness)
    # By r, whose derivative by the place is h / r, and by |h|, whose derivative is inverse^T inverse h / |h|.
    along, bent = (1 - 2 * radius) / (radius * np.sqrt(steep)), distance / steep
    g_x, g_y = a * h_x + b * h_y, c * h_x + d * h_y
    by_x = density * (along * h_x - bent * (a * g_x + c * g_y))
    by_y = density * (along * h_y - bent * (b * g_x + d * g_y))
    # A larger pupil makes u shorter, and h by twice as much.
    return share, by_x, by_y, -distance * density, density * (2 * distance - along * (square - 1e-6))


def ratios(template: Backscatter, theta: Vector, rays: Rays, shown: Pictures) -> PerShot:
    """Return the light of pictures over that of white, by shot, colour and position.

    ``template`` gives geometry and window, ``theta`` is of ``parameters.linear_of``, rays are in panel coordinates.
    """
    return ratios_of(theta, Shares.of(template, theta, rays), shown, shown.light(float(theta[0]))[0])


def ratios_of(theta: Vector, shares: Shares, shown: Pictures, panel: Float[np.ndarray, "3 pixels shots"]) -> PerShot:
    """Return the same from the shares of emitters and the light ``panel`` of the primaries."""
    mixed = _mixed(theta, _joined(theta, shares.light(shown, panel)[:1]))[0]
    return mixed / np.maximum(mixed[0], _LEAST_WHITE)


def ratios_and_jacobian(template: Backscatter, theta: Vector, rays: Rays, shown: Pictures) -> tuple[PerShot, Moves]:
    """Return ``ratios``, by shot, colour and position, and their derivatives by each of ``theta``."""
    shares, (panel, by_gamma) = Shares.of(template, theta, rays, derivatives=True), shown.light(float(theta[0]))
    light, slope = shares.light(shown, panel), _footprints(template, theta, rays).slope.T[:, :, None, None]
    whole, by_x, by_y, by_softness, by_pupil = _joined(theta, light)
    moves = np.zeros((len(theta), *whole.shape))
    moves[0] = _joined(theta, replace(shares, values=shares.values[:1]).light(shown, by_gamma)[0])
    moves[DISTANCE] = -np.exp(theta[DISTANCE]) * (slope[0] * by_x + slope[1] * by_y)
    moves[PUPIL] = by_pupil - 2 * whole
    moves[SOFTNESS] = by_softness
    moves[REFLECTION] = light[0, :, 1] - light[0, :, 0]
    deeper = slope[0] * light[1, :, 1] + slope[1] * light[2, :, 1]
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
    """The light of both planes together."""
    return (1 - theta[REFLECTION]) * light[..., 0, :, :] + theta[REFLECTION] * light[..., 1, :, :]


def _mixed(theta: Vector, primaries: Float[np.ndarray, "k n 3 shots"]) -> Moves:
    """Mix primaries into camera colours, except for a factor per colour, which cancels in ratios."""
    mix = np.eye(3)
    mix[OFF_DIAGONAL] = theta[MIX]
    return np.einsum("cp,knps->kscn", mix, primaries)
