"""What does not belong in a backscatter fit, what the model leaves undescribed, whether the rest has a pattern."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import ndtri

from udccal.fitting.backscatter.evidence import LEAST_VARIANCE, Evidence
from udccal.fitting.backscatter.likelihood import Fitted
from udccal.fitting.engine.tails import chi2_tail
from udccal.result import Outliers

# Samples further off than this many robust sigma of all samples are left out.
_SAMPLE_SIGMA = 6.0
# A bin of which this share of shots is left out goes altogether: dust, or a hot sample.
_BIN_SHARE = 0.5
# A picture is left out when its brightness is off by this many robust sigma of all pictures' brightness, ...
_BRIGHTNESS_SIGMA = 6.0
# ... or when it is described this much worse than the others.
_SHAPE_TIMES = 4.0
_MAD = 1.4826
# Half of a normal's draws lie within this many sigma.
_PROBABLE = 1 / _MAD
# Significance from which chi2 above its degrees of freedom, or a pattern, counts as the model's error.
SIGNIFICANT = 1e-3
_CELLS = 3


def odd_pictures(fitted: Fitted) -> Bool[np.ndarray, " shots"]:
    """Shots that dropped, flickered or were of another picture: by brightness and by how badly they are described."""
    z = np.abs(fitted.z)
    used = fitted.weight > 0
    typical = np.array([np.median(z[i][used[i]]) if used[i].any() else 0.0 for i in range(len(z))])
    bad = typical > _SHAPE_TIMES * max(float(np.median(typical)), ndtri(0.75))
    off, sigma = _brightness(fitted)
    centre = np.median(off)
    robust = np.maximum(_MAD * np.median(np.abs(off - centre)), sigma)
    return bad | (np.abs(off - centre) > _BRIGHTNESS_SIGMA * robust)


def _brightness(fitted: Fitted) -> tuple[Float[np.ndarray, " shots"], Float[np.ndarray, " shots"]]:
    """By how much every shot is brighter than modelled, a share of its light, and the noise of that."""
    model = fitted.mask * fitted.ratio * fitted.weight
    information = np.maximum((model**2).sum(axis=(1, 2)), 1e-12)
    return (fitted.z * model).sum(axis=(1, 2)) / information, 1 / np.sqrt(information)


def odd_samples(fitted: Fitted) -> Bool[np.ndarray, "shots 3 n"]:
    """Samples far from all others. Of each bin only the worst is named: it may have pulled the others off."""
    z, used = np.abs(fitted.z), fitted.weight > 0
    if not used.any():
        return np.zeros_like(used)
    limit = _SAMPLE_SIGMA * max(_MAD * float(np.median(z[used])), 1.0)
    return (z > limit) & (z == z.max(axis=0))


def lost_bins(usable: Bool[np.ndarray, "shots 3 n"], before: Bool[np.ndarray, "shots 3 n"]) -> Bool[np.ndarray, "3 n"]:
    """Bins of which so many samples were left out that the others are not trusted either."""
    had = np.maximum(before.sum(axis=0), 1)
    return (before & ~usable).sum(axis=0) > _BIN_SHARE * had


def undescribed_share(fitted: Fitted, seen: Evidence, freedom: float) -> float:
    """Error of the modelled ratios, as one sigma, that brings chi2 to its degrees of freedom; 0 where it is there.

    Only what is significant counts: noise alone leaves this 0 in all but one of a thousand fits.
    """
    used = fitted.weight > 0
    noise = noise_variance(fitted, seen)[used]
    square = (fitted.errors**2)[used]
    unit = np.broadcast_to(fitted.mask**2, used.shape).copy()
    unit[0] = 0.0
    unit = unit[used]
    # White and dark have no part in the model's error.
    dark = float((fitted.dark_errors**2 / seen.dark_variance).sum())
    if not unit.any() or chi2_tail((square / noise).sum() + dark, freedom) > SIGNIFICANT:
        return 0.0
    low, high = 0.0, float(np.sqrt(square.max() / unit[unit > 0].min()))
    for _ in range(60):
        middle = 0.5 * (low + high)
        above = float((square / (noise + middle**2 * unit)).sum()) + dark > freedom
        low, high = (middle, high) if above else (low, middle)
    return float(0.5 * (low + high))


def typical_share(fitted: Fitted, seen: Evidence) -> float:
    """Error of the modelled ratios, as one sigma, that makes half of all errors smaller than their probable error.

    Odd pictures have no say in it, nor has the size of their errors.
    """
    used = fitted.weight[1:] > 0
    noise = noise_variance(fitted, seen)[1:][used]
    square = (fitted.errors[1:] ** 2)[used]
    unit = np.broadcast_to(fitted.mask**2, used.shape)[used]
    if not unit.any():
        return 0.0
    low, high = 0.0, float(np.sqrt(square.max() / unit[unit > 0].min()))
    for _ in range(40):
        middle = 0.5 * (low + high)
        above = float(np.median(square / (noise + middle**2 * unit))) > _PROBABLE**2
        low, high = (middle, high) if above else (low, middle)
    return high


def noise_variance(fitted: Fitted, seen: Evidence) -> Float[np.ndarray, "shots 3 n"]:
    """Of every sample at its modelled rate, without the model's own error."""
    light = np.maximum(fitted.mask * fitted.ratio, 0.0)
    return np.maximum(seen.shot * light + seen.rest, LEAST_VARIANCE * seen.shot**2)


@dataclass(frozen=True)
class Pattern:
    """Whether residuals, averaged over parts of the sensor, are larger than independent ones would be.

    Attributes:
        inflation: variance of such averages over what independent residuals give, where significant, else 1.
        p_value: chance of averages as large as these, if residuals were independent.
    """

    inflation: float
    p_value: float


def pattern(fitted: Fitted, places: Float[np.ndarray, "n 2"], freedom: float) -> Pattern:
    """Residual averages over thirds of the sensor by thirds, and over all of it, shot by shot and colour by colour."""
    z, used = fitted.z, fitted.weight > 0
    per_sample = max(float((z**2).sum()), 1e-12) / max(freedom, 1.0)
    # What profiling takes from every residual's variance comes back here.
    z = z * np.sqrt(max(float(used.sum()), 1.0) / max(freedom, 1.0))
    worst, least = 1.0, 1.0
    for cells in (_cells(places, _CELLS), np.zeros(len(places), dtype=int)):
        square, count = _square_of_means(z, used, cells)
        p_value = chi2_tail(square / max(per_sample, 1.0), count)
        least = min(least, p_value)
        if p_value < SIGNIFICANT:
            worst = max(worst, square / max(per_sample, 1.0) / count)
    return Pattern(worst, min(1.0, 2 * least))


def _cells(places: Float[np.ndarray, "n 2"], across: int) -> Int[np.ndarray, " n"]:
    low, high = places.min(axis=0), places.max(axis=0)
    column, row = np.minimum((places - low) / np.maximum(high - low, 1e-9) * across, across - 1).astype(int).T
    return row * across + column


def _square_of_means(
    z: Float[np.ndarray, "shots 3 n"], used: Bool[np.ndarray, "shots 3 n"], cells: Int[np.ndarray, " n"]
) -> tuple[float, int]:
    """Sum over shots, colours and cells of (sum of residuals)^2 / number, and how many there are."""
    total, count = 0.0, 0
    for cell in np.unique(cells):
        inside = cells == cell
        number = used[..., inside].sum(axis=2)
        sums = z[..., inside].sum(axis=2)
        seen = number > 0
        total += float((sums[seen] ** 2 / number[seen]).sum())
        count += int(seen.sum())
    return total, max(count, 1)


def listed(rule: str, places: list[str]) -> tuple[Outliers, ...]:
    """Outliers of one rule; nothing where there are none."""
    return (Outliers(rule, len(places), tuple(places[:8])),) if places else ()
