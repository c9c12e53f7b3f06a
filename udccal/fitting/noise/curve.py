"""The photon transfer curve of a set of flats: which range it describes, its order, and what lies off it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from udccal.fitting.noise.dark import DarkTerms
from udccal.fitting.noise.data import NoiseData
from udccal.fitting.noise.levels import OUTLIER_SIGMA, bright_levels, dark_variance, flickering_pairs
from udccal.fitting.noise.order import choose_transfer, without_outliers
from udccal.fitting.noise.photon_transfer import Levels, Order, TransferFit
from udccal.fitting.noise.read_noise import start_values
from udccal.fitting.noise.saturation import clipped, rough_level

# Share of saturation that the fit reaches; EMVA 1288's 70 % where the wider range is not described.
_FIT_UP_TO, _NARROW = 0.9, 0.7
_SUSPECT_CHI2 = 2.0
# Bins that a rough gain may rest on: of the brightest flat, and of what their ratio usually is.
_ROUGH_LEAST, _ROUGH_MOST, _ROUGH_RATIO = 0.05, 0.8, 0.8


@dataclass(frozen=True)
class Curve:
    """The fit and what it rests on.

    Attributes:
        fit: gain, read noise, curvature, response.
        order: which of them the data ask for.
        tried: BIC of every order.
        full: bins at saturation, and its rough level ``ceiling_DN``.
        usable_levels: exposures inside the range of the fit, the stack not counted; and ``bins`` of them.
        bins_left_out: bins off the curve.
        levels_left_out: flats off the response (by index), beyond those whose frames differ.
        flickering: flats whose two frames differ in brightness (by index).
        fit_up_to: share of saturation that the fit reaches.
        shot_significance: shot noise of the light in all bins together, in sigma of their variances.
    """

    fit: TransferFit
    order: Order
    tried: tuple[tuple[Order, float], ...]
    full: Bool[np.ndarray, "flats bins"]
    ceiling_DN: float
    usable_levels: int
    bins: int
    bins_left_out: int
    levels_left_out: tuple[int, ...]
    flickering: tuple[int, ...]
    fit_up_to: float
    shot_significance: float

    @property
    def K_DN_per_e(self) -> float:
        """Conversion gain at small signals."""
        return float(self.fit.values[0])


def fit_curve(data: NoiseData, dark: DarkTerms) -> Curve:
    """The curve up to 90 % of saturation, or up to 70 % where that is described far better."""
    floor = dark.read_DN2.value + data.q_DN**2 / 12.0
    full = clipped(data.flats, dark.black_DN, floor + dark.row_DN2.value, data.top_DN)
    empty = Curve(
        fit=_NOTHING,
        order=Order(),
        tried=(),
        full=full,
        ceiling_DN=rough_level(data.flats, full, data.top_DN),
        usable_levels=0,
        bins=0,
        bins_left_out=0,
        levels_left_out=(),
        flickering=flickering_pairs(data.flats, dark),
        fit_up_to=_FIT_UP_TO,
        shot_significance=0.0,
    )
    found = _fitted(data, dark, empty)
    if found.fit.chi2_dof > _SUSPECT_CHI2 or found.usable_levels == 0:
        narrow = _fitted(data, dark, replace(empty, fit_up_to=_NARROW))
        if narrow.usable_levels >= 3 and narrow.fit.chi2_dof < 0.5 * found.fit.chi2_dof:
            found = narrow
    return found


_NOTHING = TransferFit(np.zeros(5), np.zeros((5, 5)), 0.0, 0.0, 0.0, False, np.zeros((0, 0)), np.zeros(0))


def _fitted(data: NoiseData, dark: DarkTerms, curve: Curve) -> Curve:
    """The fit to the range that ``curve`` names, outliers left out."""
    flats = data.flats if data.flat_stack.temporal is None else (*data.flats, data.flat_stack.temporal)
    levels = bright_levels(flats, dark, curve.ceiling_DN, curve.fit_up_to, data.q_DN, curve.flickering)
    usable = int(levels.usable[: len(data.flats)].any(axis=1).sum())
    if usable < 1:
        return curve
    point = dark_variance(data, dark)
    full_DN = max(curve.ceiling_DN - dark.black_DN, 1.0)
    fit, order, tried = choose_transfer(levels, point, full_DN)
    left = 0
    off: tuple[int, ...] = ()
    for _ in range(3):
        cleaned, bins, now_off = without_outliers(levels, fit, OUTLIER_SIGMA)
        if not (bins or now_off) or not cleaned.usable[: len(data.flats)].any():
            break
        levels, left, off = cleaned, left + bins, (*off, *now_off)
        fit, order, tried = choose_transfer(levels, point, full_DN)
    return replace(
        curve,
        fit=fit,
        order=order,
        tried=tried,
        usable_levels=usable,
        bins=int(levels.usable.sum()),
        bins_left_out=left,
        levels_left_out=off,
        shot_significance=_shot_significance(levels, fit),
    )


def _shot_significance(levels: Levels, fit: TransferFit) -> float:
    use = levels.usable
    shot = float(fit.values[0]) * (levels.mean_DN - levels.dark_DN[:, None])[use]
    return float(np.sqrt(np.sum(levels.dof[use] / 2 * (shot / np.maximum(levels.variance_DN2[use], 1e-9)) ** 2)))


def rough_gain(data: NoiseData) -> float:
    """Conversion gain from moments alone, as good as a straight line is: what the dark frames' fit starts from."""
    black, _, dark_DN2 = (float(v) for v in start_values(data.darks)[:3])
    mean = np.stack([flat.mean_DN for flat in data.flats]) - black
    variance = np.stack([flat.variance_DN2 for flat in data.flats]) - data.q_DN**2 / 12.0
    lit = (mean > _ROUGH_LEAST * mean.max()) & (mean > 0)
    if not lit.any():
        return 1.0
    ratio = (variance - dark_DN2) / np.where(lit, mean, 1.0)
    # Clipping lowers the ratio and nothing raises it.
    usual = max(float(np.quantile(ratio[lit], 0.75)), 1e-6)
    clear = lit & (mean < _ROUGH_MOST * mean.max()) & (ratio > _ROUGH_RATIO * usual)
    return _slope(mean[clear], variance[clear], usual)


def _slope(mean: Float[np.ndarray, " bins"], variance: Float[np.ndarray, " bins"], otherwise: float) -> float:
    """Of a straight line, points weighted by their own chi-squared errors; ``otherwise`` where they tell none."""
    if mean.size < 2 or float(np.ptp(mean)) < 0.1 * float(mean.max()):
        return otherwise
    weight = 1 / np.maximum(variance, 1e-9) ** 2
    centred = mean - float(np.average(mean, weights=weight))
    slope = float(np.sum(weight * centred * variance) / np.sum(weight * centred**2))
    return slope if abs(slope / otherwise - 1) < 0.5 else otherwise
