"""What the backscatter fit looks at: binned rates of the panel's light, colour by colour, and what the panel showed."""

from __future__ import annotations

from dataclasses import dataclass

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt8

from udccal.cfa import cell_channels
from udccal.models.arrays import Arrayish
from udccal.models.backscatter import Backscatter, footprints, grid_positions
from udccal.models.geometry import Geometry, panel_directions
from udccal.models.noise import Noise, variance_e
from udccal.numerics import in_float64
from udccal.rig import RigDescription
from udccal.sessions.schema import DarkSubject, PanelSubject, StoredStep
from udccal.sessions.store import Average, Session

# Panel pixels around the nominally visible part that are kept: the footprint's own size and the nominal's tolerances.
_MARGIN_PX = 12
# Part of saturation from which a mean counts as clipped.
_CLIPPED = 0.98


@dataclass(frozen=True)
class Binned:
    """One shot on the term's grid by camera colour.

    Attributes:
        rate: e-/s above the black level, the dark signal included.
        shot: slope of the rate's variance by the rate, e-/s: what one electron in a bin amounts to.
        rest: variance that a rate of 0 has, (e-/s)^2: read and row noise, quantisation, dark current.
        clipped: bins in which a sample is clipped.
        exposure_s: of the shot.
        scatter: variance between the frames of the shot over what the noise model says; NaN where not known.
    """

    rate: Float[np.ndarray, "3 grid_rows grid_columns"]
    shot: Float[np.ndarray, "3 grid_rows grid_columns"]
    rest: Float[np.ndarray, "3 grid_rows grid_columns"]
    clipped: Bool[np.ndarray, "3 grid_rows grid_columns"]
    exposure_s: float
    scatter: float = float("nan")

    @property
    def variance(self) -> Float[np.ndarray, "3 grid_rows grid_columns"]:
        """Of the rate, taken at the rate that was measured."""
        return self.shot * np.maximum(self.rate, 0.0) + self.rest


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


@dataclass(frozen=True)
class Binning:
    """How averages become rates in bins: the noise of single samples, and the wire's map, which is divided out."""

    noise: Noise
    shading: Float[np.ndarray, "rows columns"]
    cfa: str
    step: int

    def of(self, average: Average, exposure_s: float) -> Binned:
        """An average in bins."""
        noise = self.noise
        gain = float(np.asarray(noise.K_DN_per_e))
        to_rate = 1.0 / (exposure_s * self.shading)
        signal_e = (average.mean - float(np.asarray(noise.black_DN))) / gain
        clipped = average.mean >= _CLIPPED * float(np.asarray(noise.saturation_DN))

        bins = Bins(self.cfa, self.step)
        expected = np.maximum(signal_e, 0.0) + self._rest_e2(exposure_s)
        per_frame = to_rate**2 / average.frames
        rest = bins.variance(per_frame * self._rest_e2(exposure_s)) + bins.row_variance(per_frame * self._row_e2())
        return Binned(
            rate=bins.mean(signal_e * to_rate),
            shot=bins.variance(to_rate / average.frames),
            rest=rest,
            clipped=bins.mean(clipped.astype(np.float64)) > 0,
            exposure_s=exposure_s,
            scatter=float(average.variance.mean(dtype=np.float64) / gain**2 / expected.mean()),
        )

    def _rest_e2(self, exposure_s: float) -> float:
        """Variance of a sample in the dark that it shares with no other, e-^2."""
        dark = float(np.asarray(variance_e(self.noise, np.zeros(()), np.float64(exposure_s))))
        return max(dark - self._row_e2(), 0.0)

    def _row_e2(self) -> float:
        """Variance that the samples of a row share, e-^2."""
        return float(np.asarray(self.noise.sigma_row_DN / self.noise.K_DN_per_e)) ** 2


def grid_step(rig: RigDescription) -> int:
    """Spacing of the grid in sensor px: even, near an eighth of the panel rows' period, and leaving little over."""
    camera = rig.camera
    period = rig.panel.pitch_mm.value / rig.mounting.standoff_mm.value * rig.focal_px
    largest = max(4, int(period / 8))
    choices = range(2 * (largest // 2), max(2, int(0.6 * largest)), -2)
    return min(choices, key=lambda step: camera.columns % step + camera.rows % step)


@dataclass(frozen=True)
class Bins:
    """Averages of a mosaic over blocks of ``step`` x ``step`` (even) pixels, colour by colour.

    A sample of a colour stands for the 2 x 2 pixels around it and counts by the part of them inside the block: then
    every colour's average is of the block's centre, though its samples are not.
    """

    cfa: str
    step: int

    def mean(self, mosaic: Float[np.ndarray, "rows columns"]) -> Float[np.ndarray, "3 grid_rows grid_columns"]:
        """Averages of the samples."""
        return self._sum(mosaic, 1, 1)

    def variance(self, mosaic: Float[np.ndarray, "rows columns"]) -> Float[np.ndarray, "3 grid_rows grid_columns"]:
        """Variances of the averages from those of the samples, each by itself."""
        return self._sum(mosaic, 2, 2)

    def row_variance(self, mosaic: Float[np.ndarray, "rows columns"]) -> Float[np.ndarray, "3 grid_rows grid_columns"]:
        """The same where the samples of a row go up and down together."""
        return self._sum(mosaic, 2, 1)

    def _sum(self, mosaic: np.ndarray, row_power: int, column_power: int) -> Float[np.ndarray, "3 a b"]:
        sums = np.zeros((3, *(size // self.step for size in mosaic.shape)))
        cells = np.asarray(cell_channels(self.cfa))
        # A colour with two samples in a cell averages them.
        share = 1.0 / np.bincount(cells.ravel(), minlength=3) ** max(row_power, column_power)
        for (j, i), channel in np.ndenumerate(cells):
            part = mosaic[j::2, i::2].astype(np.float64)
            by_row = block_weights(part.shape[0], mosaic.shape[0] // self.step, self.step, j) ** row_power
            by_column = block_weights(part.shape[1], mosaic.shape[1] // self.step, self.step, i) ** column_power
            sums[channel] += share[channel] * (by_row @ part @ by_column.T)
        return sums


def block_weights(samples: int, blocks: int, step: int, first: int) -> Float[np.ndarray, "blocks samples"]:
    """Weights of the samples at ``first``, ``first`` + 2, ... px in the averages over blocks of ``step`` px.

    A sample covers one pixel to either side of it; what the sensor's edge cuts off, the others of the block take over.
    """
    centre = first + 2.0 * np.arange(samples)
    edge = step * np.arange(blocks)[:, None] - 0.5
    overlap = np.minimum(centre + 1, edge + step) - np.maximum(centre - 1, edge)
    weights = np.maximum(overlap, 0.0)
    return np.asarray(weights / weights.sum(axis=1, keepdims=True))


@in_float64
def visible_crop(geometry: Geometry, rig: RigDescription) -> PanelCrop:
    """The part of the panel that any sensor pixel may see, with room for the tolerances of the mounting."""
    camera, panel = rig.camera, rig.panel
    edge_x, edge_y = np.linspace(0, camera.columns - 1, 9), np.linspace(0, camera.rows - 1, 9)
    pixels = np.stack(np.meshgrid(edge_x, edge_y), axis=-1).reshape(-1, 2)
    template = nominal_term(geometry, rig, np.zeros((3, 2, 2)), grid_step(rig), window=1)
    centre = np.asarray(_centres(template, pixels, rig.mounting.standoff_mm.value))
    first = np.floor(centre.min(axis=0)).astype(int) - _MARGIN_PX
    last = np.ceil(centre.max(axis=0)).astype(int) + _MARGIN_PX
    first = np.clip(first, 0, [panel.columns - 8, panel.rows - 8])
    last = np.clip(last, first + 8, [panel.columns, panel.rows])
    return PanelCrop(int(first[0]), int(first[1]), int(last[0] - first[0]), int(last[1] - first[1]))


@eqx.filter_jit
def _centres(
    term: Backscatter, pixels: Float[Arrayish, "n 2"], distance_mm: Float[Arrayish, ""]
) -> Float[Array, "n 2"]:
    return footprints(term, panel_directions(term.geometry, pixels), distance_mm)[0]


def nominal_term(
    geometry: Geometry, rig: RigDescription, mask: Float[np.ndarray, "3 a b"], step: int, window: int
) -> Backscatter:
    """A term with the rig's nominal measures and the mask given: where the fit starts."""
    panel = rig.panel
    return Backscatter(
        geometry=geometry,
        mask=mask,
        mix=np.eye(3),
        gamma=np.float64(panel.gamma.value),
        pitch_mm=np.float64(panel.pitch_mm.value),
        pupil_mm=np.float64(rig.pupil_mm),
        distance_mm=np.float64(rig.mounting.standoff_mm.value),
        emitters_px=np.zeros((3, 2)),
        softness_px=np.float64(0.15),
        reflection=np.float64(0.5),
        reflection_mm=np.float64(2 * panel.glass_thickness_mm / panel.glass_index),
        columns=rig.camera.columns,
        rows=rig.camera.rows,
        cfa=rig.camera.cfa,
        step=step,
        window=window,
    )


directions = jax.jit(panel_directions)


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
    rays = directions(geometry, np.stack([x[columns], y[rows]], axis=1))
    return np.asarray(rays, dtype=np.float64), flat
