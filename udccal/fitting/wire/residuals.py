"""What residuals show of the map's model error: patterns in the panel's period, lines of the sensor, spots."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float, Int

from udccal.fitting.engine.misfit import NO_TEST, MisfitTest, chi2_test, excess_sigma, largest_test, sharper
from udccal.fitting.wire.data import TILES, Pixels, Weighed, tile_numbers
from udccal.fitting.wire.jacobian import LEAST_VARIANCE, rays_at
from udccal.fitting.wire.parameters import WireRules
from udccal.models.wire import Wire

# Parts of the sensor, down and across, in which spots are looked for; a part of more sigma stands out.
_PARTS, _OUT = ((12, 16), (24, 32), (48, 64)), 4.0
# See ``_relative``.
_Relative = tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"], float]


@final
@dataclass(frozen=True)
class Misfit:
    """Relative model error of the map by patterned residuals, RMS over the sensor; 0 where chance explains them."""

    sigma: float
    test: MisfitTest


@final
@dataclass(frozen=True)
class Spot:
    """A part of the sensor: its middle and size in parts of the sensor, and its mean relative residual."""

    across: float
    down: float
    size: tuple[float, float]
    off: float


@final
@dataclass(frozen=True)
class Misfits:
    """What residuals show of the map's model error: a pattern in the panel's period, lines of the sensor, and spots.

    ``spot`` is the part of the sensor that stands out most, by the error of a spot alone. ``excess`` is the RMS of
    residuals beyond noise where they are so large that the fit is poor, else 0.
    """

    pattern: Misfit
    lines: Misfit
    spots: Misfit
    spot: Spot
    excess: float

    @property
    def found(self) -> bool:
        """Whether chance does not explain the residuals' means."""
        return any(one.test.found for one in (self.pattern, self.lines, self.spots))

    @property
    def sigma(self) -> float:
        """Relative model error of the map."""
        return max(float(np.linalg.norm([self.pattern.sigma, self.lines.sigma, self.spots.sigma])), self.excess)


def misfits(
    tested: Weighed, wire: Wire | None, statistical: float, held_out: bool, variance: float, rules: WireRules
) -> Misfits:
    """All that residuals show; ``variance`` is that of the fit's residuals in units of the noise's."""
    # Columns and rows of the sensor, each by the place of its pixels.
    sides = (np.unique(side, return_inverse=True)[1] for side in tested.pixels.scaled.T)
    relative = values, weight, scale = _relative(tested)
    columns, rows = (_of_means(relative, side, statistical, held_out) for side in sides)
    test = sharper(columns.test, rows.test)
    lines = Misfit(float(np.hypot(columns.sigma, rows.sigma)) if test.found else 0.0, test)
    beyond = float(np.sum(values**2)) / max(int(np.count_nonzero(weight)), 1) * max(1 - 1 / scale, 0.0)
    excess = float(np.sqrt(beyond)) if variance > rules.worst_variance else 0.0
    pattern = misfit(tested, wire, statistical, held_out)
    return Misfits(pattern, lines, *_spots(tested.pixels, relative, statistical, held_out), excess)


def misfit(tested: Weighed, wire: Wire | None, statistical: float, held_out: bool) -> Misfit:
    """Test means over bins of the rows' and the columns' period, tile by tile, against chance.

    Noise has no pattern; a misfit has. ``wire`` gives the phase of each ray in the period; without a panel, bins are
    parts of a tile. ``held_out`` pixels show the fit's ``statistical`` errors as well; these are accounted for.
    """
    # Bins of a period of the rows and of the columns, once finer in the one, once in the other.
    binned = (_bins(tested.pixels, wire, down, across) for down, across in ((12, 3), (3, 12)))
    relative = _relative(tested)
    return _sharpest([_of_means(relative, bins, statistical, held_out) for bins in binned])


def _sharpest(found: list[Misfit]) -> Misfit:
    """The misfit of the sharpest of several tests, with the chance that one of them is as sharp."""
    test = sharper(*(one.test for one in found))
    return Misfit(min(found, key=lambda one: one.test.p_value).sigma if test.found else 0.0, test)


def _bins(pixels: Pixels, wire: Wire | None, down: int, across: int) -> Int[np.ndarray, " n"]:
    """Number of each pixel's bin in its tile: by its ray's phase in rows and columns, or by place without a panel."""
    by_place = 0.5 * (pixels.scaled.T + 1) * np.array([[TILES[1]], [TILES[0]]])
    periods = rays_at(wire, pixels).periods if wire is not None else by_place
    phase = periods - np.floor(periods)
    x, y = (np.minimum((p * n).astype(np.int64), n - 1) for p, n in zip(phase, (across, down), strict=True))
    return np.asarray((tile_numbers(pixels.scaled) * down + y) * across + x)


def _relative(tested: Weighed) -> _Relative:
    """Residuals relative to the expected signal, their weights, and their variance in units of the noise's."""
    pixels, expected = tested.pixels, tested.expected
    used = (pixels.weight > 0) & (expected > 0)
    values = np.where(used, pixels.value / np.where(used, expected, 1.0) - 1, 0.0)
    weight = np.where(used, pixels.weight * expected**2, 0.0)
    scale = float(np.sum(weight * values**2)) / max(int(used.sum()), 1)
    return values, weight, max(scale, LEAST_VARIANCE)


def _of_means(relative: _Relative, group: Int[np.ndarray, " n"], statistical: float, held_out: bool) -> Misfit:
    """Test the means of groups of pixels against chance; see ``misfit``."""
    mean, noise, _ = _means(relative, group, statistical, held_out)
    return _in_sum(mean, noise)


def _in_sum(mean: Float[np.ndarray, " groups"], noise: Float[np.ndarray, " groups"]) -> Misfit:
    """The misfit of all groups' means together."""
    test = chi2_test(float(np.sum(mean**2 / noise)), float(len(mean)))
    return Misfit(excess_sigma(mean**2, noise, np.ones(len(mean)), float(len(mean))), test)


def _means(
    relative: _Relative, group: Int[np.ndarray, " n"], statistical: float, held_out: bool
) -> tuple[Float[np.ndarray, " groups"], Float[np.ndarray, " groups"], Int[np.ndarray, " groups"]]:
    """Of every group of some pixels: the mean, its variance by noise, and the group's number."""
    values, weight, scale = relative
    full = np.bincount(group, weight > 0) >= 4
    total = np.bincount(group, weight)[full]
    noise = scale / total
    noise = noise + statistical**2 if held_out else np.maximum(noise - statistical**2, 0.1 * noise)
    return np.bincount(group, weight * values)[full] / total, noise, np.flatnonzero(full)


def _spots(pixels: Pixels, relative: _Relative, statistical: float, held_out: bool) -> tuple[Misfit, Spot]:
    """Test parts of the sensor one by one: dust, a glare or a shadow's edge is off in few, which no sum over all shows.

    Returns the misfit, whose size is that of the parts which stand out, RMS over the sensor, and the most likely spot.
    """
    found: list[tuple[Misfit, Spot]] = []
    for down, across in _PARTS:
        mean, noise, part = _means(relative, tile_numbers(pixels.scaled, (down, across)), statistical, held_out)
        if not mean.size:
            continue
        z = np.abs(mean) / np.sqrt(noise)
        worst, out = int(np.argmax(z)), z > _OUT
        row, column = divmod(int(part[worst]), across)
        spot = Spot((column + 0.5) / across, (row + 0.5) / down, (1 / across, 1 / down), float(mean[worst]))
        size, together = float(np.sqrt(np.sum(np.maximum(mean**2 - noise, 0.0)[out]) / mean.size)), _in_sum(mean, noise)
        found.append((Misfit(max(size, together.sigma), sharper(largest_test(z), together.test)), spot))
    if not found:
        return Misfit(0.0, NO_TEST), Spot(0.5, 0.5, (1.0, 1.0), 0.0)
    return _sharpest([each for each, _ in found]), min(found, key=lambda one: one[0].test.p_value)[1]
