"""Data of the backscatter fit: the panel's light as rates in bins, colour by colour, and the pictures shown."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import final

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped, UInt8

from udccal.arguments import Numbers, check_array, found_instead
from udccal.errors import FitError
from udccal.fitting.backscatter.model import Moves, PanelCrop, PerBin, PerShot, Pictures, Usable


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
        shape: tuple[int, ...] = getattr(self.rate, "shape", ())
        if not isinstance(self.rate, np.ndarray) or len(shape) < 3 or shape[1] != 3:
            expected = f"Expected rates as an array, shots x 3 colours x bins, found {found_instead(self.rate)}."
            raise FitError(f"{expected} Bin the shots' averages.")
        for field in fields(self):
            numbers: Numbers = "truth values" if field.name == "clipped" else "real numbers"
            axes = shape[:1] if field.name in ("exposure_s", "scatter") else shape
            check_array(getattr(self, field.name), field.name, numbers, axes, "Give each shot its own.", FitError)

    @classmethod
    def joined(cls, parts: Sequence[Binned]) -> Binned:
        """Join shots in their order."""
        return cls(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(cls)))

    def part(self, which: slice | Shaped[np.ndarray, " n"]) -> Binned:
        """Return some of the shots."""
        return Binned(*(getattr(self, f.name)[which] for f in fields(self)))

    def with_white(self, brightness: float) -> Binned:
        """Return the shots with white's light over this number, and its noise."""
        rate, shot, rest, light = self.rate.copy(), self.shot.copy(), self.rest.copy(), self.excess[0]
        rate[0] += light / brightness - light
        shot[0], rest[0] = shot[0] / brightness, rest[0] / brightness**2
        return replace(self, rate=rate, shot=shot, rest=rest)

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
        shots, crop = self.shots, self.crop
        if shots.rate.ndim != 4:
            found = found_instead(shots.rate)
            raise FitError(
                f"Expected rates of shots x 3 x rows x columns, found {found}. Keep the grid's two dimensions."
            )
        pictures = max(len(shots.rate) - 2, 0)
        if len(shots.rate) == 1 or len(self.names) != pictures:
            expected = f"Expected a name for each shot between white and dark, {pictures}, found {len(self.names)}."
            raise FitError(f"{expected} Give white first, dark last, and the names of the others.")
        shape = pictures, crop.rows, crop.columns, 3
        check_array(self.shown, "the pictures shown", "8-bit values", shape, "Give each shot its own.", FitError)
        if not (np.isfinite(shots.exposure_s) & (shots.exposure_s > 0)).all():
            found = shots.exposure_s[:8].tolist()
            raise FitError(f"Expected positive exposures, found {found}. Give the exposure of each shot in seconds.")
        possible = np.isfinite(shots.rate + shots.shot + shots.rest) & (shots.shot > 0) & (shots.rest >= 0)
        if not possible.all():
            shot, colour, row, column = np.argwhere(~possible)[0].tolist()
            first = f"{('white', *self.names, 'dark')[shot]}, {'RGB'[colour]}, bin ({column}, {row})"
            raise FitError(
                "Expected a rate, a variance per rate above 0 and a variance in the dark of 0 or more in every bin, "
                f"found {np.sum(~possible)} others, the first in {first}. Check the noise term, and the map that "
                "divides the rates."
            )

    @functools.cached_property
    def pictures(self) -> Pictures:
        """The panel's picture during every shot."""
        return Pictures.of(self.shown, self.crop)

    def only(self, keep: Bool[np.ndarray, " pictures"]) -> BackscatterData:
        """Return white, dark, and some of the pictures."""
        names = tuple(name for name, kept in zip(self.names, keep, strict=True) if kept)
        shots = self.shots.part(np.concatenate([[True], keep, [True]]))
        return BackscatterData(shots, self.shown[keep], self.crop, names)
