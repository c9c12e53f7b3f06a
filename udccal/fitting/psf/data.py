"""The psf fit's rules and data: crops of merged LED pictures, and the variance of their samples.

The model's deviation from the truth is relatively larger in fainter samples. Its standard deviation is taken as the
model error times light^(3/4) peak^(1/4): at 10^-4 of the peak it is ten times the model error, relative to the light.
The model error is the one of greatest likelihood for the residuals, or 0 where BIC does not prefer it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Final, final

import numpy as np
import scipy.optimize
from jaxtyping import Bool, Float, Int

from udccal.arguments import Numbers, check_array, check_count, check_optional, found_instead
from udccal.errors import FitError
from udccal.fitting.engine.orders import bic
from udccal.fitting.engine.robust import Huber
from udccal.result import FitStatus

HUBER: Final = Huber()
Crops = Float[np.ndarray, "shots rows columns"]
Some = Float[np.ndarray, "*n"]
Each = Float[np.ndarray, " samples"]
# Numbers, and the shape for each shot; None is that of the rates.
_ARRAYS: Final[dict[str, tuple[Numbers, tuple[int, ...] | None]]] = {
    "centre_px": ("real numbers", (2,)),
    "origin_px": ("whole numbers", (2,)),
    "position": ("whole numbers", ()),
    "disc_px": ("real numbers", ()),
    "rate": ("real numbers", None),
    "weight": ("real numbers", None),
    "channel": ("whole numbers", None),
    "noise_per_rate": ("real numbers", None),
}


@final
@dataclass(frozen=True)
class PsfRules:
    """Effort and constants of the psf fit. More positions, shifts and samples make it slower and more accurate.

    Attributes:
        positions, shifts: the most field positions, and pictures of each, in the fit of diffraction.
        least_positions: the fewest field positions that are fitted.
        half_px: largest window (rows, columns) to either side of the LED; the captured regions may bound it further.
        close_px: the same for the fit of diffraction, which takes longer in a larger window.
        peak_half_px, far_fraction: all samples this close (rows, columns) to the LED go into it, and this part of more.
        iterations: the most, in the fit of diffraction; far more than data take.
        first_model_error: of diffraction, before residuals give it; it also keeps a fit that is still far off from
            trusting the brightest samples alone.
        spectrum_bend, spectrum_sigma: prior sigmas of a log spectrum: of second differences, and about its start.
        blur_px, blur_log_sigma: prior of the blur in addition to pixel and disc: value, and sigma of its logarithm.
        blur_growth, blur_colour: prior sigmas of that logarithm's growth over a focal length, and between colours.
        depth_ratio: prior sigma of the logarithm of the rows' depth over the columns'.
        shaped_from: squared residuals by ``first_model_error`` from which other shapes of openings are looked for.
        corner, slant, shape_log_sigma: priors of the openings' round corners and slants in periods: medians, and the
            sigma of their logarithms.
        bar_width, bar_sigma: of an opaque bar through the openings: its width at first, and prior sigmas of width and
            place, in periods.
        least_bar: width in periods below which there is no bar.
        bar_places: distances of the bar's middle from the opening's that are tried first, as parts of the opening.
        bar_positions, bar_steps, bar_ends: field positions of these first tries, their steps, and how many of them go
            on to their ends.
        wire_tolerance: part of the rig's tolerances that is left after the wire's fit.
        pitch_tolerance: part of the pitch's tolerance that the fit may use; see ``start_prior``.
        pitch_well_known: where the pitch's relative tolerance is larger, the nodes cover more wavelengths than
            daylight has, to compensate for an error of the pitch.
        pitch_least_known: relative tolerance above which the pitch counts as unknown, and no fit is tried.
        footprint_periods: prior sigma of the footprint's place on the rows, after the wire's fit.
        picture_times: pictures whose mean squared residual is this many times the median picture's are outliers.
        residual_sizes: prior sizes of a residual added to diffraction, as fractions of the kernel nearby.
        highest_degree: of the residual's polynomials.
        reaches: parts of the window that may be enough for a residual, the narrowest first.
        worth: decrease of the held-out loss per sample that a higher order must reach (residuals then narrow by an
            eighth): every restoration computes its ten thousand coefficients. Pictures held out share errors with the
            others: on a full-size rig of wave optics a residual gained 0.17, but was a fifth worse elsewhere.
        worth_of_room: the same for a wider residual, which adds no component, but enlarges one.
        doubtful: relative L2 error of diffraction alone from which an image without diffraction is tried too.
        free_model_error: of such an image, before positions held out give it.
        own_sigma: prior sigmas of a shot's place, in px, and relative light, along with such an image: centroids and
            sums of a crop's light have this accuracy.
        error_samples: the most samples within a factor of three in brightness that the kernel error is taken from.
        error_knee, error_power: priors of the kernel error's knee and power; the knee's sigma is of its logarithm.
        poor: relative L2 error at positions held out from which the fit is poor.
    """

    positions: int = 10
    shifts: int = 3
    least_positions: int = 3
    half_px: tuple[int, int] = (48, 16)
    close_px: tuple[int, int] = (40, 14)
    peak_half_px: tuple[int, int] = (12, 6)
    far_fraction: float = 1 / 6
    iterations: int = 100
    first_model_error: float = 0.015
    spectrum_bend: float = 1.0
    spectrum_sigma: float = 5.0
    blur_px: float = 0.1
    blur_log_sigma: float = 1.0
    blur_growth: float = 1.0
    blur_colour: float = 0.2
    depth_ratio: float = 0.2
    shaped_from: float = 1.5
    corner: float = 0.1
    slant: float = 0.02
    shape_log_sigma: float = 1.0
    bar_width: float = 0.02
    bar_sigma: tuple[float, float] = (0.03, 0.1)
    least_bar: float = 0.003
    bar_places: tuple[float, ...] = (0.05, 0.15, 0.3, 0.42)
    bar_positions: int = 3
    bar_steps: int = 4
    bar_ends: int = 3
    wire_tolerance: float = 0.3
    pitch_tolerance: float = 0.05
    pitch_well_known: float = 0.02
    pitch_least_known: float = 0.5
    footprint_periods: float = 0.05
    picture_times: float = 2.5
    residual_sizes: tuple[float, ...] = (0.1, 0.03, 0.01)
    highest_degree: int = 3
    reaches: tuple[float, ...] = (0.25, 0.5)
    worth: float = 0.25
    worth_of_room: float = 0.05
    doubtful: float = 0.05
    free_model_error: float = 0.01
    own_sigma: tuple[float, float] = (0.05, 0.03)
    error_samples: float = 100.0
    error_knee: tuple[float, float] = (0.3, 1.0)
    error_power: tuple[float, float] = (0.75, 0.15)
    poor: float = 0.2

    def close(self, half: tuple[int, int]) -> tuple[int, int]:
        """Return (rows, columns) to either side of the LED that diffraction is fitted to, for windows of this size."""
        return min(half[0], self.close_px[0]), min(half[1], self.close_px[1])


@final
@dataclass(frozen=True)
class Shots:
    """Crops of one size, one per picture of the LED, on Bayer sites, with their uncertainty.

    Attributes:
        centre_px: (x, y) on the sensor of the LED's image, by the current estimate.
        origin_px: (x, y) on the sensor of the crop's middle sample.
        position: index of the field position that the shot belongs to.
        disc_px: diameter of the LED's image.
        rate: e-/s; weight: 1 / sigma^2 in (e-/s)^-2, 0 where nothing is known; channel: 0, 1, 2 for R, G, B.
        noise_per_rate: derivative of sigma^2 by the rate, in e-/s. A sample that noise has made darker has too small
            a measured sigma, and a fit with that sigma would be too dark.

    Raises:
        FitError: when arrays do not go together, or a number cannot be. Where nothing is known, rates may be anything.
    """

    centre_px: Float[np.ndarray, "shots 2"]
    origin_px: Int[np.ndarray, "shots 2"]
    position: Int[np.ndarray, " shots"]
    disc_px: Float[np.ndarray, " shots"]
    rate: Crops
    weight: Crops
    channel: Int[np.ndarray, "shots rows columns"]
    noise_per_rate: Crops

    def __post_init__(self) -> None:
        crops: tuple[int, ...] = getattr(self.rate, "shape", ())
        if len(crops) != 3 or not crops[1] % 2 or not crops[2] % 2:
            rates = f"Expected rates of shots x odd rows x odd columns, found {found_instead(self.rate)}"
            raise FitError(f"{rates}. Crop about a middle sample.")
        for name, (kinds, shape) in _ARRAYS.items():
            array, expected = getattr(self, name), crops if shape is None else (crops[0], *shape)
            check_array(array, name, kinds, expected, "Give each shot its own.", FitError)
        positions = np.unique(self.position)
        if not np.array_equal(positions, np.arange(len(positions))):
            raise FitError(f"Expected positions without gaps, found {positions[:8].tolist()}. Number them from 0.")
        known = self.weight > 0
        possible = np.isfinite(self.weight) & (self.weight >= 0) & (self.channel >= 0) & (self.channel <= 2)
        possible &= ~known | (np.isfinite(self.rate) & np.isfinite(self.noise_per_rate) & (self.noise_per_rate >= 0))
        places = np.isfinite(self.centre_px).all(axis=1) & np.isfinite(self.disc_px) & (self.disc_px >= 0)
        possible &= places[:, None, None]
        if not possible.all():
            shot, row, column = np.argwhere(~possible)[0].tolist()
            wanted = "Expected finite places, rates and noise, weights of 0 or more, and channels 0, 1 and 2"
            found = f"{np.sum(~possible)} samples without, the first in shot {shot}, row {row}, column {column}"
            raise FitError(f"{wanted}, found {found}. Give weight 0 to samples of which nothing is known.")
        for name in ("rate", "noise_per_rate"):
            # Zero times NaN would be NaN in every sum.
            if not np.isfinite(values := getattr(self, name)).all():
                object.__setattr__(self, name, np.where(known, values, 0.0))

    @property
    def count(self) -> int:
        """Number of pictures."""
        return self.rate.shape[0]

    @property
    def positions(self) -> int:
        """Number of field positions."""
        return len(np.unique(self.position))

    @property
    def half(self) -> tuple[int, int]:
        """(rows, columns) to either side of the LED."""
        return self.rate.shape[1] // 2, self.rate.shape[2] // 2

    @property
    def colour(self) -> Float[np.ndarray, "shots rows columns 3"]:
        """The colour of each sample (one-hot)."""
        return np.eye(3)[self.channel]

    def offsets(self) -> Int[np.ndarray, "rows columns 2"]:
        """(x, y) of every sample from the crop's middle sample."""
        y, x = np.mgrid[: self.rate.shape[1], : self.rate.shape[2]]
        return np.stack([x - self.half[1], y - self.half[0]], axis=-1)

    def pick(self, keep: np.ndarray) -> Shots:
        """The shots selected by an index or mask, their positions numbered without gaps."""
        picked = {field.name: getattr(self, field.name)[keep] for field in fields(self)}
        return Shots(**picked | {"position": np.unique(self.position[keep], return_inverse=True)[1].reshape(-1)})

    def within(self, largest: tuple[int, int]) -> Shots:
        """The middle of the crops, at most ``largest`` (rows, columns) to either side."""
        names = ("rate", "weight", "channel", "noise_per_rate")
        return replace(self, **{name: about_middle(getattr(self, name), largest) for name in names})

    def positions_px(self) -> Float[np.ndarray, "positions 2"]:
        """Mean place of the shots of every field position."""
        return np.stack([self.centre_px[self.position == g].mean(axis=0) for g in range(self.positions)])


def about_middle(images: np.ndarray, largest: tuple[int, int]) -> np.ndarray:
    """The middle of images of odd size, at most ``largest`` (rows, columns) to either side."""
    halves = zip(images.shape[-2:], largest, strict=True)
    rows, columns = (slice(max(n // 2 - most, 0), n // 2 + most + 1) for n, most in halves)
    return images[..., rows, columns]


def joined(crops: Sequence[Shots], aims_px: Float[np.ndarray, "shots 2"]) -> Shots:
    """Join crops of one size, and group them into field positions by their aims."""
    together = Shots(*(np.concatenate([getattr(crop, field.name) for crop in crops]) for field in fields(Shots)))
    return replace(together, position=group(aims_px))


def group(aims_px: Float[np.ndarray, "shots 2"]) -> Int[np.ndarray, " shots"]:
    """Return the index of each shot's field position: aims within 4 px of a position's first belong to it."""
    firsts: list[Float[np.ndarray, "2"]] = []
    index: list[int] = []
    for aim in aims_px:
        near = (g for g, first in enumerate(firsts) if np.abs(aim - first).max() <= 4.0)
        index.append(next(near, len(firsts)))
        if index[-1] == len(firsts):
            firsts.append(aim)
    return np.array(index, dtype=np.int64)


def held_out_positions(count: int) -> Bool[np.ndarray, " positions"]:
    """Return which of ``count`` positions are held out while orders are compared: every fourth from the second on."""
    return np.arange(count) % 4 == 1


@final
@dataclass(frozen=True)
class PsfData:
    """The data of a psf fit: crops, and numbers of pictures captured, without an LED, clipped, and of unknown samples.

    Crops may be wider than the fit's windows: the kernel's support needs all of them. There are none where no picture
    can be used. ``doubted`` has a sentence for each picture whose bracket contradicts the noise model.
    """

    shots: Shots | None
    taken: int = 0
    dark: int = 0
    clipped: int = 0
    doubted: tuple[str, ...] = ()
    unknown: int = 0

    def __post_init__(self) -> None:
        check_optional(self.shots, Shots, FitError)
        for name in ("taken", "dark", "clipped", "unknown"):
            check_count(getattr(self, name), f"pictures {name}", 0, 2**31, FitError)

    def unfit(self, rules: PsfRules) -> tuple[FitStatus, str] | None:
        """Return why these data cannot be fitted, or None."""
        most, shots = 0.5 * max(self.taken, 1), self.shots
        if self.clipped > most:
            return FitStatus.SATURATED, f"{self.clipped} of {self.taken} pictures are clipped."
        if self.dark > most:
            return FitStatus.TOO_DARK, f"{self.dark} of {self.taken} pictures show no LED."
        if shots is not None and shots.positions < rules.least_positions:
            seen = "have a sample of which something is known" if self.unknown else "were captured"
            needed = f"{rules.least_positions} are needed at least."
            return FitStatus.TOO_FEW_DATA, f"{shots.positions} field positions {seen}; {needed}"
        return None

    def known(self, rules: PsfRules) -> PsfData:
        """These data without pictures of which nothing is known in the fit's windows."""
        if self.shots is None:
            return self
        known = np.flatnonzero(self.shots.within(rules.half_px).weight.any(axis=(1, 2)))
        unknown = self.shots.count - len(known)
        return replace(self, shots=self.shots.pick(known), unknown=unknown) if unknown else self


def left_out(light: Float[np.ndarray, "*shots n"], model_error: float) -> Float[np.ndarray, "*shots n"]:
    """Return the standard deviation of the model's deviation in samples of this expected ``light``."""
    size = np.maximum(light, 0.0)
    return model_error * size**0.75 * size.max(axis=-1, keepdims=True) ** 0.25


def noise_at(level: Some, rate: Some, measured: Some, noise_per_rate: Some) -> Some:
    """Return the variance of samples of true rate ``level``; it was ``measured`` at the observed ``rate``."""
    change = noise_per_rate * (np.maximum(level, 0.0) - np.maximum(rate, 0.0))
    # A sensor without read noise has no variance at all where no light is expected.
    return np.maximum(measured + change, 1e-2 * measured)


def estimate_model_error(residual: Each, variance: Each, unit: Each, parameters: int) -> float:
    """Return the model error of greatest likelihood, or 0 where BIC prefers noise alone (``variance``).

    ``unit`` is the standard deviation that a model error of 1 adds to a sample. Residuals are smaller than errors by
    the number of fitted ``parameters``, which is corrected for.
    """
    raised = residual**2 * (residual.size / max(residual.size - parameters, 1))

    def loss(model_error: float) -> float:
        total = variance + (model_error * unit) ** 2
        return float(np.sum(np.log(total) + HUBER.loss(np.sqrt(raised / total))))

    bounds = (np.log(1e-4), np.log(0.5))
    found = scipy.optimize.minimize_scalar(lambda log: loss(float(np.exp(log))), bounds=bounds, method="bounded")
    return float(np.exp(found.x)) if bic(float(found.fun), 1.0, residual.size) < loss(0.0) else 0.0
