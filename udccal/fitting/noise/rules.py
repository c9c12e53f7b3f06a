"""The documented constants of the noise fit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final


@final
@dataclass(frozen=True)
class NoiseRules:
    """What the noise fit takes for enough, for too far, and for the same.

    Attributes:
        tiles, tile_samples: at most so many tiles a side, each of at least so many samples of one colour: they keep
            shading and the slow flicker of a lamp out of the variance.
        hit_sigma, hit_DN: codes of one pixel further apart than both are a hit or a blinking pixel, not noise.
        outlier_sigma: bins and levels so many robust sigma off the curve are left out.
        defect_sigma: pixels so many robust sigma off the rest are defects: of millions, five would take good ones.
        background: share of dark samples from anywhere; keeps one outlier from deciding.
        shape_sigma: of the read noise's shape before the data; decides only where rounding hides the shape.
        white: rounding is white, and nothing cut off, where the mean code follows black to this part.
        smeared: rounding shows no more once its first harmonic is down by this, as a natural logarithm.
        resolved: of a code; below it rounding decides which samples differ, and independent samples are no model.
        row_visible: of row noise that follows black to less than this part nothing can be said.
        fit_up_to, narrow_up_to: share of saturation that the fit reaches; the second (EMVA 1288) where it describes
            the data far better.
        suspect_chi2: reduced chi-squared above which the narrower range is tried.
        margin_sigma, uneven_sigma: so many sigma of its noise, and of its shading, a bin stays inside the range.
        white_spread, white_temporal: in steps and steps^2; samples must spread so far for rounding to be white.
        coarse: in steps^2; beside so much variance the steps of few counts do not matter.
        most_bent: share of the signal missing at full scale above which the quadratic is no description.
        collapsed: a bin is full where its variance is under this part of what the others predict.
        full_sigma: a full bin has no noise but that after the clipping, within so many sigma of its variance.
        strays: share of samples off the level; above it some pixels are not full.
        shading: side of the window that follows shading, in samples of one colour.
        light_sigma: power of a spectrum that is so many sigma above the floor is light.
        light_reach: light is expected up to this many times the frequencies at which it was seen.
        light_least: unless that leaves less than this share of the spectrum.
        levels: fewest exposures of a photon transfer curve.
        gain_sigma: a gain known worse than one part in so many is none: what is divided by it has no symmetric error.
        offsets: so many times the temporal noise, they leave nothing of a cut-off distribution to look at.
        worst_chi2: reduced chi-squared above which the sensor is not what the model says.
    """

    tiles: int = 8
    tile_samples: int = 4096
    hit_sigma: float = 8.0
    hit_DN: float = 10.0
    outlier_sigma: float = 5.0
    defect_sigma: float = 6.0
    background: float = 1e-5
    shape_sigma: float = 0.3
    white: float = 0.005
    smeared: float = 6.0
    resolved: float = 0.15
    row_visible: float = 0.2
    fit_up_to: float = 0.9
    narrow_up_to: float = 0.7
    suspect_chi2: float = 2.0
    margin_sigma: float = 5.0
    uneven_sigma: float = 2.5
    white_spread: float = 0.7
    white_temporal: float = 0.2
    coarse: float = 30.0
    most_bent: float = 0.24
    collapsed: float = 0.3
    full_sigma: float = 3.0
    strays: float = 1e-5
    shading: int = 63
    light_sigma: float = 5.0
    light_reach: float = 2.0
    light_least: float = 0.1
    levels: int = 3
    gain_sigma: float = 10.0
    offsets: float = 30.0
    worst_chi2: float = 6.0
