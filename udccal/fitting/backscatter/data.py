"""What the backscatter fit looks at: binned rates of the panel's light, colour by colour, and what the panel showed."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Array, Float, Int, UInt8

from udccal.fitting.backscatter.bins import Binned, Binning
from udccal.fitting.backscatter.blocks import in_blocks
from udccal.fitting.nominal import nominal_backscatter
from udccal.models.arrays import Arrayish
from udccal.models.backscatter import Backscatter, footprints, grid_positions
from udccal.models.geometry import Geometry, panel_directions
from udccal.models.noise import Noise
from udccal.numerics import in_float64
from udccal.rig import RigDescription
from udccal.sessions.schema import DarkSubject, PanelSubject, StoredStep
from udccal.sessions.store import Session

# Panel pixels around the nominally visible part that are kept: the footprint's own size and the nominal's tolerances.
_MARGIN_PX = 12


@dataclass(frozen=True)
class PanelCrop:
    """The part of the panel that the camera can see: its first pixel and its size."""

    column: int
    row: int
    columns: int
    rows: int

    def of(self, picture: UInt8[np.ndarray, "panel_rows panel_columns 3"]) -> UInt8[np.ndarray, "rows columns 3"]:
        """That part of a picture."""
        return picture[self.row : self.row + self.rows, self.column : self.column + self.columns].copy()


@dataclass(frozen=True)
class PanelShots:
    """White, dark, and the pictures with what the camera saw of them; ``names`` are of the pictures."""

    white: Binned
    dark: Binned
    seen: tuple[Binned, ...]
    shown: UInt8[np.ndarray, "pictures crop_rows crop_columns 3"]
    crop: PanelCrop
    names: tuple[str, ...]


def read_shots(
    session: Session, noise: Noise, crop: PanelCrop, shading: Float[np.ndarray, "rows columns"]
) -> PanelShots | None:
    """Bin every picture of a session, one at a time; None when white or dark was not captured.

    Args:
        shading: the wire's map of the sensor, divided out.

    Raises:
        SessionError: when a file is missing or damaged.
    """
    panels = [(step, step.subject) for step in session.steps("backscatter") if isinstance(step.subject, PanelSubject)]
    white = [step for step, subject in panels if subject.role == "white"]
    dark = [step for step in session.steps("backscatter") if isinstance(step.subject, DarkSubject)]
    if not white or not dark:
        return None
    binning = Binning(noise, shading, session.rig.camera.cfa, grid_step(session.rig))

    def binned(step: StoredStep) -> Binned:
        capture = step.captures[0]
        return binning.of(session.average(capture), capture.exposure_s)

    others = [(step, subject) for step, subject in panels if subject.role != "white"]
    shown = [crop.of(session.picture(subject)) for _, subject in others]
    empty = np.zeros((0, crop.rows, crop.columns, 3), np.uint8)
    return PanelShots(
        white=binned(white[0]),
        dark=binned(dark[0]),
        seen=tuple(binned(step) for step, _ in others),
        shown=np.stack(shown) if shown else empty,
        crop=crop,
        names=tuple(step.id for step, _ in others),
    )


def grid_step(rig: RigDescription) -> int:
    """Spacing of the grid in sensor px: even, near an eighth of the panel rows' period, and leaving little over."""
    camera = rig.camera
    period = rig.panel.pitch_mm.value / rig.mounting.standoff_mm.value * rig.focal_px
    largest = max(4, int(period / 8))
    choices = range(2 * (largest // 2), max(2, int(0.6 * largest)), -2)
    return min(choices, key=lambda step: camera.columns % step + camera.rows % step)


@in_float64
def visible_crop(geometry: Geometry, rig: RigDescription) -> PanelCrop:
    """The part of the panel that any sensor pixel may see, with room for the tolerances of the mounting."""
    camera, panel = rig.camera, rig.panel
    edge_x, edge_y = np.linspace(0, camera.columns - 1, 9), np.linspace(0, camera.rows - 1, 9)
    pixels = np.stack(np.meshgrid(edge_x, edge_y), axis=-1).reshape(-1, 2)
    template = nominal_backscatter(geometry, rig, np.zeros((3, 2, 2)), grid_step(rig), window=1)
    rays = directions(geometry, pixels)
    (centre,) = in_blocks(lambda part: (_centres(template, part),), rays)
    first = np.floor(centre.min(axis=0)).astype(int) - _MARGIN_PX
    last = np.ceil(centre.max(axis=0)).astype(int) + _MARGIN_PX
    first = np.clip(first, 0, [panel.columns - 8, panel.rows - 8])
    last = np.clip(last, first + 8, [panel.columns, panel.rows])
    return PanelCrop(int(first[0]), int(first[1]), int(last[0] - first[0]), int(last[1] - first[1]))


@jax.jit
def _centres(term: Backscatter, rays: Float[Arrayish, "b 3"]) -> Float[Array, "b 2"]:
    return footprints(term, rays, term.distance_mm)[0]


@in_float64
def directions(geometry: Geometry, pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
    """Rays of sensor pixels in panel coordinates."""
    (rays,) = in_blocks(lambda part: (_directions(geometry, part),), np.asarray(pixels, dtype=np.float64))
    return np.asarray(rays)


_directions = jax.jit(panel_directions)


@in_float64
def sampled_rays(
    geometry: Geometry, rig: RigDescription, step: int, count: int
) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, " n"]]:
    """About ``count`` grid positions spread evenly (the R2 sequence): their rays and flat grid indices."""
    x, y = (np.asarray(axis) for axis in grid_positions(rig.camera.columns, rig.camera.rows, step))
    plastic = 1.32471795724474602596
    sequence = (0.5 + np.arange(count)[:, None] / np.array([plastic, plastic**2])) % 1.0
    columns, rows = (sequence * [len(x), len(y)]).astype(int).T
    flat = np.unique(rows * len(x) + columns)
    rows, columns = np.divmod(flat, len(x))
    return directions(geometry, np.stack([x[columns], y[rows]], axis=1)), flat
