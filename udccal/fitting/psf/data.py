"""What the psf fit works on: its rules, crops of merged LED pictures, and the variance of their samples.

What a model leaves out matters the more, relatively, the fainter a sample is: its standard deviation is taken as the
model error times light^(3/4) peak^(1/4), e.g. at 10^-4 of the peak ten times the model error. The model error is that
of greatest likelihood of the residuals, and none where that is no better by BIC.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Final, final

import numpy as np
import scipy.optimize
from jaxtyping import Bool, Float, Int

from udccal.fitting.engine.orders import bic
from udccal.fitting.engine.robust import Huber

HUBER: Final = Huber()
Crops = Float[np.ndarray, "shots rows columns"]


@final
@dataclass(frozen=True)
class PsfRules:
    """What the fit may spend, and its constants. More positions, shifts and samples are slower and more accurate.

    Attributes:
        positions, shifts: the most field positions, and pictures of each, in the fit of diffraction.
        least_positions: the fewest field positions that are fitted.
        half_px: largest window (rows, columns) to either side of the LED; the captured regions may bound it further.
        close_px: the same for the fit of diffraction, whose time grows with it.
        peak_half_px: all samples this close (rows, columns) to the LED go into the fit of diffraction.
        far_fraction: of the samples farther away, this fraction does.
        iterations: at most, of the fit of diffraction.
        first_model_error: of diffraction, before residuals give it; it also keeps a fit that is still far off from
            trusting the brightest samples alone.
        spectrum_bend, spectrum_sigma: prior standard deviations of the logarithm of a spectrum: of its bend from node
            to node, and about its start.
        blur_px, blur_log_sigma: prior of the blur beside pixel and disc: its value, and the sigma of its logarithm.
        wire_tolerance: part of the rig's tolerances that is left after the wire's fit.
        pitch_tolerance: part of the pitch's tolerance that the fit may use; see ``start_prior``.
        pitch_well_known: a pitch of larger relative tolerance takes more wavelengths to make up for it than daylight
            has.
        pitch_least_known: with a larger tolerance nothing is known of the pitch, and no fit is tried.
        footprint_periods: prior sigma of the footprint's place on the rows, after the wire's fit.
        picture_times: pictures whose mean squared residual is this many times the median picture's are outliers.
        residual_sizes: prior sizes of a residual beside diffraction, as fractions of the kernel nearby.
        highest_degree: of the residual's polynomials.
        reaches: parts of the window that may be enough for a residual, the narrowest first.
        worth: a higher order must lower the held-out loss of a sample by this (what is left of the samples then
            narrows by an eighth) to be worth its ten thousand coefficients: every restoration pays for them. Pictures
            held out have errors in common with the others: on a full-size rig of wave optics a residual gained 0.17,
            and made the kernel at new places a fifth worse.
        worth_of_room: the same for a wider residual, which costs less: no component more, only a larger one.
        doubtful: beyond this relative L2 error of diffraction alone, an image without diffraction is tried too.
        free_model_error: of such an image, before positions held out give it.
        own_sigma: prior standard deviations of a shot's place, in px, and relative light, beside such an image:
            centroids and sums of a crop's light are this good.
        error_knee, error_power: priors of the kernel error's knee and power; the knee's sigma is of its logarithm.
        poor: beyond this relative L2 error at positions held out the fit is poor.
    """

    positions: int = 10
    shifts: int = 3
    least_positions: int = 3
    half_px: tuple[int, int] = (48, 16)
    close_px: tuple[int, int] = (40, 14)
    peak_half_px: tuple[int, int] = (12, 6)
    far_fraction: float = 1 / 6
    iterations: int = 30
    first_model_error: float = 0.015
    spectrum_bend: float = 1.0
    spectrum_sigma: float = 5.0
    blur_px: float = 0.1
    blur_log_sigma: float = 1.0
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
    error_knee: tuple[float, float] = (0.3, 1.0)
    error_power: tuple[float, float] = (0.75, 0.15)
    poor: float = 0.2

    def close(self, half: tuple[int, int]) -> tuple[int, int]:
        """(rows, columns) to either side of the LED that diffraction is fitted to, of windows of this size."""
        return min(half[0], self.close_px[0]), min(half[1], self.close_px[1])


@final
@dataclass(frozen=True)
class Shots:
    """Crops of one size, one per picture of the LED, on Bayer sites, with their uncertainty.

    Attributes:
        centre_px: (x, y) on the sensor of the LED's image, as known so far.
        origin_px: (x, y) on the sensor of the crop's middle sample.
        position: index of the field position that the shot belongs to.
        disc_px: diameter of the LED's image.
        rate: e-/s; weight: 1 / sigma^2 in (e-/s)^-2, 0 where nothing is known; channel: 0, 1, 2 for R, G, B.
        noise_per_rate: how fast sigma^2 grows with the rate, in e-/s: the sigma of a sample that noise has made
            darker is too small, and a fit that went by it would come out too dark.
    """

    centre_px: Float[np.ndarray, "shots 2"]
    origin_px: Int[np.ndarray, "shots 2"]
    position: Int[np.ndarray, " shots"]
    disc_px: Float[np.ndarray, " shots"]
    rate: Crops
    weight: Crops
    channel: Int[np.ndarray, "shots rows columns"]
    noise_per_rate: Crops

    @property
    def count(self) -> int:
        """Number of pictures."""
        return self.rate.shape[0]

    @property
    def positions(self) -> int:
        """Number of field positions."""
        return int(self.position.max()) + 1

    @property
    def half(self) -> tuple[int, int]:
        """(rows, columns) to either side of the LED."""
        return self.rate.shape[1] // 2, self.rate.shape[2] // 2

    @property
    def colour(self) -> Float[np.ndarray, "shots rows columns 3"]:
        """Which of three colours a sample has (one-hot)."""
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
    """Crops of one size together, grouped into field positions by where they were aimed."""
    together = Shots(*(np.concatenate([getattr(crop, field.name) for crop in crops]) for field in fields(Shots)))
    return replace(together, position=group(aims_px))


def group(aims_px: Float[np.ndarray, "shots 2"]) -> Int[np.ndarray, " shots"]:
    """Index of the field position of each shot: aims within 4 px of a position's first are shifts of it."""
    firsts: list[Float[np.ndarray, "2"]] = []
    index = np.zeros(len(aims_px), dtype=np.int64)
    for i, aim in enumerate(aims_px):
        near = [g for g, first in enumerate(firsts) if np.abs(aim - first).max() <= 4.0]
        index[i] = near[0] if near else len(firsts)
        if not near:
            firsts.append(aim)
    return index


def held_out_positions(count: int) -> Bool[np.ndarray, " positions"]:
    """Every fourth position, the second first, is left out while orders are compared; with three, one of them."""
    return np.arange(count) % 4 == 1


@final
@dataclass(frozen=True)
class PsfData:
    """What there is to fit.

    Attributes:
        shots: crops, which may be wider than the fit's windows: how far light reaches is seen in the whole of them.
            None where no picture can be used.
        taken, dark, clipped: pictures captured, and of these such without an LED, and such that are clipped.
    """

    shots: Shots | None
    taken: int = 0
    dark: int = 0
    clipped: int = 0


def left_out(light: Float[np.ndarray, "*shots n"], model_error: float) -> Float[np.ndarray, "*shots n"]:
    """Standard deviation of what the model leaves out of samples that it expects to be this bright."""
    size = np.maximum(light, 0.0)
    return model_error * size**0.75 * size.max(axis=-1, keepdims=True) ** 0.25


def noise_at(
    level: Float[np.ndarray, "*n"],
    rate: Float[np.ndarray, "*n"],
    measured: Float[np.ndarray, "*n"],
    noise_per_rate: Float[np.ndarray, "*n"],
) -> Float[np.ndarray, "*n"]:
    """Variance of samples whose true rate is ``level``, if it was ``measured`` to be that of the ``rate`` found."""
    change = noise_per_rate * (np.maximum(level, 0.0) - np.maximum(rate, 0.0))
    # A sensor without read noise has no variance at all where no light is expected.
    return np.maximum(measured + change, 1e-2 * measured)


def estimate_model_error(
    residual: Float[np.ndarray, " samples"],
    variance: Float[np.ndarray, " samples"],
    unit: Float[np.ndarray, " samples"],
    parameters: int,
) -> float:
    """Model error of greatest likelihood; 0 where the noise alone explains the residuals as well, by BIC.

    ``unit`` is the standard deviation that a model error of 1 adds to a sample. The residuals of a fit of so many
    ``parameters`` are smaller than the errors; that is made up for. ``variance`` is of the sensor's noise.
    """
    raised = residual**2 * (residual.size / max(residual.size - parameters, 1))

    def loss(model_error: float) -> float:
        total = variance + (model_error * unit) ** 2
        return float(np.sum(np.log(total) + HUBER.loss(np.sqrt(raised / total))))

    bounds = (np.log(1e-4), np.log(0.5))
    found = scipy.optimize.minimize_scalar(lambda log: loss(float(np.exp(log))), bounds=bounds, method="bounded")
    return float(np.exp(found.x)) if bic(float(found.fun), 1.0, residual.size) < loss(0.0) else 0.0
