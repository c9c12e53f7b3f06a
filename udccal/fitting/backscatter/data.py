"""Data of the backscatter fit: the panel's light as rates in bins, colour by colour, and the pictures shown."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import final

import jax
import numpy as np
from jaxtyping import Bool, Float, Int, Shaped, UInt8
from scipy.spatial.transform import Rotation

from udccal.bins import Bins
from udccal.fitting.backscatter.checks import check_data, check_shapes
from udccal.fitting.backscatter.model import Moves, PanelCrop, PerBin, PerShot, Pictures, Rays, Usable, corners_of
from udccal.fitting.backscatter.parameters import BackscatterRules, linear_of, prior_of
from udccal.fitting.nominal import nominal_backscatter
from udccal.fitting.wire.data import ideal_points
from udccal.models.geometry import Geometry
from udccal.models.noise import Noise, linear_signal, variance_e
from udccal.rig import RigDescription
from udccal.sessions.schema import DarkSubject, PanelSubject
from udccal.sessions.store import Average, Session

# One compilation instead of one per operation.
_variance_e = jax.jit(variance_e)


@final
@dataclass(frozen=True)
class Binned:
    """Shots on the term's grid, or at some of its bins, by camera colour: white first and dark last.

    Attributes:
        rate: e-/s above the black level, the dark signal included.
        shot: variance per rate, (e-/s)^2 per e-/s: the rate of one electron in a bin.
        rest: variance at a rate of 0, (e-/s)^2: read and row noise, quantisation, dark current.
        clipped: True for bins with a clipped sample.
        exposure_s: of each shot.
        scatter: variance between the frames of a shot over the noise model's; NaN where not known.

    Raises:
        FitError: when an array is not of its kind, or not of the shape of the rates.
    """

    rate: Float[np.ndarray, "shots 3 *grid"]
    shot: Float[np.ndarray, "shots 3 *grid"]
    rest: Float[np.ndarray, "shots 3 *grid"]
    clipped: Bool[np.ndarray, "shots 3 *grid"]
    exposure_s: Float[np.ndarray, " shots"]
    scatter: Float[np.ndarray, " shots"]

    def __post_init__(self) -> None:
        check_shapes(self)

    @classmethod
    def joined(cls, parts: Sequence[Binned]) -> Binned:
        """Join shots in their order."""
        return cls(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(cls)))

    def part(self, which: slice | Shaped[np.ndarray, " n"]) -> Binned:
        """Return some of the shots."""
        return Binned(*(getattr(self, f.name)[which] for f in fields(self)))

    def at(self, flat: Int[np.ndarray, " n"]) -> Binned:
        """Return all shots at some bins, by their flat indices."""
        rate, shot, rest, clipped = (
            part.reshape(*part.shape[:2], -1)[:, :, flat] for part in (self.rate, self.shot, self.rest, self.clipped)
        )
        return Binned(rate, shot, rest, clipped, self.exposure_s, self.scatter)

    @property
    def usable(self) -> Bool[np.ndarray, "shots 3 *grid"]:
        """False for bins with clipped samples; the dark frame's are all True."""
        usable = ~self.clipped
        usable[-1] = True
        return usable

    @property
    def excess(self) -> Float[np.ndarray, "shots 3 *grid"]:
        """Measured light less that of the dark frame, in e-/s."""
        return self.rate - np.multiply.outer(self.exposure_s[-1] / self.exposure_s, self.rate[-1])

    def variance(self, rate: Float[np.ndarray, "shots 3 *grid"]) -> Float[np.ndarray, "shots 3 *grid"]:
        """Return every bin's variance by noise, in (e-/s)^2, at this light."""
        # A black picture in a camera without read noise still has rounding's variance.
        return np.maximum(self.shot * np.maximum(rate, 0.0) + self.rest, self.shot**2 / 12)

    def weights(self, rate: PerShot, mask: PerBin, model_error: float, usable: Usable) -> PerShot:
        """Return 1 / sigma of every bin, 0 where not usable, at this light and mask."""
        variance = self.variance(rate)
        # White is the mask by definition, and dark has no light: neither has a model error.
        variance[1:-1] += (model_error * mask) ** 2
        return np.where(usable, 1 / np.sqrt(variance), 0.0)

    def first_weights(self, usable: Usable, model_error: float = 0.0) -> PerShot:
        """Return weights at the measured light, plus one electron for safety, and with the measured mask."""
        light = np.maximum(self.excess, 0.0)
        rate = light + self.shot
        rate[-1] = 0.0
        return self.weights(rate, light[0], model_error, usable)


@final
@dataclass(frozen=True)
class Profile:
    """The most probable mask and dark signal for given ratios, bin by bin.

    Light of shot i at a position and colour is  y_i = m r_i + u_i d + noise. r_i is the picture's light over that of
    white (1 for white itself, 0 for the dark frame), m the mask and d the dark signal there, u_i the dark frame's
    exposure over the shot's. m and d have no prior and enter linearly: they are eliminated exactly, bin by bin, so that
    the noise of white and dark, which is common to all pictures of a bin, has its right weight.

    Attributes:
        mask, dark: e-/s.
        errors: measured less modelled rates; ``weight`` is 1 / sigma of each.
        information: on the mask, with the dark signal eliminated.
        by_mask, by_dark: orthonormal directions of the whitened errors that mask and dark remove.
    """

    mask: PerBin
    dark: PerBin
    errors: PerShot
    weight: PerShot
    information: PerBin
    by_mask: PerShot
    by_dark: PerShot

    @property
    def z(self) -> PerShot:
        """Errors in units of their sigma, 0 for samples without weight."""
        return self.errors * self.weight

    @property
    def chi2(self) -> float:
        """Chi-squared without the prior."""
        return float((self.z**2).sum())

    @classmethod
    def of(cls, seen: Binned, ratio: PerShot, weight: PerShot) -> Profile:
        """Solve for mask and dark signal from the ratios of all shots."""
        light, exposure = seen.rate, (seen.exposure_s[-1] / seen.exposure_s)[:, None, None]
        apart = exposure * weight
        length = np.sqrt((apart**2).sum(axis=0))
        by_dark = apart / length
        across = ratio * weight - by_dark * (by_dark * ratio * weight).sum(axis=0)
        information = (across**2).sum(axis=0)
        root = np.sqrt(np.where(information > 0, information, 1.0))
        by_mask = across / root
        mask = (by_mask * light * weight).sum(axis=0) / root
        dark = (by_dark * (light - mask * ratio) * weight).sum(axis=0) / length
        return cls(mask, dark, light - mask * ratio - exposure * dark, weight, information, by_mask, by_dark)

    def jacobian(self, of_ratio: Moves) -> Moves:
        """Return the whitened errors' Jacobian without the parts that mask and dark remove (Kaufman, BIT 15, 1975)."""
        jacobian = -(self.mask * self.weight) * of_ratio
        for way in (self.by_dark, self.by_mask):
            jacobian -= way * np.einsum("scn,kscn->kcn", way, jacobian)[:, None]
        return jacobian

    def mask_jacobian(self, of_ratio: Moves) -> Float[np.ndarray, "k 3 n"]:
        """Return the mask's derivatives for the expected light; the contribution of noise is of second order."""
        along = np.einsum("scn,kscn->kcn", self.by_mask * self.weight, of_ratio)
        return -self.mask * along / np.sqrt(np.where(self.information > 0, self.information, 1.0))

    def light_variance(self, ratio: PerShot, of_ratio: Moves, cov: Float[np.ndarray, "k k"]) -> PerShot:
        """Return predicted light's variance: from the parameters and their effect on the mask, and from its noise."""
        moves = self.mask * of_ratio + ratio * self.mask_jacobian(of_ratio)[:, None]
        by_parameters = np.einsum("kicn,kl,licn->icn", moves, cov, moves, optimize=True)
        return np.asarray(by_parameters + ratio**2 / np.maximum(self.information, 1e-30))


@final
@dataclass(frozen=True)
class BackscatterData:
    """The camera's shots of the panel, and the pictures that the panel showed.

    Attributes:
        shots: white, then the pictures, and the dark frame last; none at all where white or dark are missing.
        shown: the pictures, values 0 to 255, in the crop.
        crop: the part of the panel that the camera can see (``visible_crop``).
        names: names of the pictures.

    Raises:
        FitError: when there is not one picture and name for each shot, or a number cannot be.
    """

    shots: Binned
    shown: UInt8[np.ndarray, "pictures crop_rows crop_columns 3"]
    crop: PanelCrop
    names: tuple[str, ...]

    def __post_init__(self) -> None:
        check_data(self)

    @functools.cached_property
    def pictures(self) -> Pictures:
        """The panel's picture during every shot."""
        return Pictures.of(self.shown, self.crop)

    def only(self, keep: Bool[np.ndarray, " pictures"]) -> BackscatterData:
        """Return white, dark, and some of the pictures."""
        names = tuple(name for name, kept in zip(self.names, keep, strict=True) if kept)
        shots = self.shots.part(np.concatenate([[True], keep, [True]]))
        return BackscatterData(shots, self.shown[keep], self.crop, names)


def read_backscatter(
    session: Session, noise: Noise, geometry: Geometry, shading: Float[np.ndarray, "rows columns"]
) -> BackscatterData:
    """Bin the averages of the steps ``backscatter/*`` of a session, one at a time.

    Args:
        session: holds ``backscatter/white``, ``backscatter/dark`` and other pictures, as averages.
        noise: gives K, black level and saturation, and the variance of samples.
        geometry: the rays of pixels.
        shading: the wire's map of the sensor (``fitting.wire.sensor_map``), which divides the rates.

    Returns:
        rates in e-/s by bin and colour; without shots where white or dark were not captured.

    Raises:
        SessionError: when a file is missing or damaged.
    """
    crop, bins = visible_crop(geometry, session.rig), Bins(session.rig.camera.cfa, grid_step(session.rig))
    binning, steps = Binning(noise, shading, bins), session.steps("backscatter")
    panels = [(step, step.subject) for step in steps if isinstance(step.subject, PanelSubject)]
    white = [step for step, subject in panels if subject.role == "white"]
    dark = [step for step in steps if isinstance(step.subject, DarkSubject)]
    others = [(step, subject) for step, subject in panels if subject.role != "white"]
    shown = np.zeros((0, crop.rows, crop.columns, 3), np.uint8)
    if not white or not dark:
        nothing, none = np.zeros((0, 3, 1, 1)), np.zeros(0)
        return BackscatterData(Binned(nothing, nothing, nothing, nothing > 0, none, none), shown, crop, ())
    captures = [step.captures[0] for step in (white[0], *(step for step, _ in others), dark[0])]
    shots = Binned.joined([binning.of(session.average(one), one.exposure_s) for one in captures])
    shown = np.concatenate([shown, *(crop.of(session.picture(subject))[None] for _, subject in others)])
    return BackscatterData(shots, shown, crop, tuple(step.id for step, _ in others))


@final
@dataclass(frozen=True)
class Binning:
    """Bins shots from their averages; means above the fraction ``most`` of saturation count as clipped."""

    noise: Noise
    shading: Float[np.ndarray, "rows columns"]
    bins: Bins
    most: float = BackscatterRules.clipped

    @functools.cached_property
    def _variances(self) -> tuple[Float[np.ndarray, "3 a b"], ...]:
        """Variance of bins if that of a sample over its shading is 1 / shading, or 1: by sample, or by row."""
        each = 1 / self.shading
        return self.bins.variance(each), self.bins.variance(each**2), self.bins.row_variance(each**2)

    def of(self, average: Average, exposure_s: float) -> Binned:
        """Bin one shot from its average in DN."""
        gain, black_DN, row_DN, saturation_DN, bend_per_DN = (
            float(np.asarray(getattr(self.noise, name)))
            for name in ("K_DN_per_e", "black_DN", "sigma_row_DN", "saturation_DN", "bend_per_DN")
        )
        signal_e = linear_signal(average.mean - black_DN, bend_per_DN) / gain
        clipped = average.mean >= self.most * saturation_DN
        # Variance in the dark, e-^2: of a row's offset, and of each sample independently.
        row_e2 = (row_DN / gain) ** 2
        rest_e2 = max(float(np.asarray(_variance_e(self.noise, np.zeros(()), np.float64(exposure_s)))) - row_e2, 0.0)
        expected = np.maximum(signal_e, 0.0) + rest_e2
        scatter = average.variance.mean(dtype=np.float64) / gain**2 / expected.mean()
        shot, each, rows = self._variances
        return Binned(
            rate=self.bins.mean(signal_e / self.shading)[None] / exposure_s,
            shot=shot[None] / (exposure_s * average.frames),
            rest=(rest_e2 * each + row_e2 * rows)[None] / (exposure_s**2 * average.frames),
            clipped=(self.bins.mean(clipped.astype(np.float32)) > 0)[None],
            exposure_s=np.array([exposure_s]),
            scatter=np.array([scatter], dtype=np.float64),
        )


def grid_step(rig: RigDescription) -> int:
    """Return the grid's spacing in sensor px: even, near an eighth of the panel rows' period, with a small remainder.

    Args:
        rig: gives pitch and stand-off in mm, the focal length in px, and the sensor's size.
    """
    camera = rig.camera
    period = rig.panel.pitch_mm.value / rig.mounting.standoff_mm.value * rig.focal_px
    largest = max(4, int(period / 8))
    choices = range(2 * (largest // 2), max(2, int(0.6 * largest)), -2)
    return min(choices, key=lambda step: camera.columns % step + camera.rows % step)


def visible_crop(geometry: Geometry, rig: RigDescription) -> PanelCrop:
    """Return the part of the panel that any sensor pixel may see, with room for the tolerances of the mounting.

    Args:
        geometry: gives the rays of pixels.
        rig: gives the panel's size and the nominal footprints.
    """
    camera, panel, room_px = rig.camera, rig.panel, 12
    edge_x, edge_y = np.linspace(0, camera.columns - 1, 9), np.linspace(0, camera.rows - 1, 9)
    pixels = np.stack(np.meshgrid(edge_x, edge_y), axis=-1).reshape(-1, 2)
    template = nominal_backscatter(geometry, rig, np.zeros((3, 1, 1)), grid_step(rig), window=1)
    middle = corners_of(template, linear_of(prior_of(rig).mean), directions(geometry, pixels))
    first = np.clip(middle.min(axis=0) - room_px, 0, [panel.columns - 8, panel.rows - 8])
    last = np.clip(middle.max(axis=0) + room_px + 1, first + 8, [panel.columns, panel.rows])
    return PanelCrop(int(first[0]), int(first[1]), int(last[0] - first[0]), int(last[1] - first[1]))


def sampled_rays(
    geometry: Geometry, rig: RigDescription, step: int, count: int
) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, " n"]]:
    """Spread about ``count`` positions evenly over the grid (Roberts's R2 sequence, of the plastic number).

    Args:
        geometry: gives the rays of pixels.
        rig: gives the sensor's size.
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


def grid_rays(
    geometry: Geometry, shape: tuple[int, int], step: int, flat: Int[np.ndarray, " n"]
) -> Float[np.ndarray, "n 3"]:
    """Return the rays, in panel coordinates, of positions of a grid of ``shape`` (rows, columns), by flat index."""
    rows, columns = np.divmod(flat, shape[1])
    return directions(geometry, step * (np.stack([columns, rows], axis=1) + 0.5) - 0.5)


def directions(geometry: Geometry, pixels: Float[np.ndarray, "n 2"]) -> Rays:
    """Return the rays of sensor pixels in panel coordinates, as ``models.geometry.panel_directions`` does."""
    ideal = ideal_points(geometry, pixels)
    rays = np.insert(ideal, 2, 1.0, axis=1) @ Rotation.from_rotvec(np.asarray(geometry.rotation_rad)).as_matrix().T
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))
