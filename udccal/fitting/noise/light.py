"""All that flats tell beside the photon transfer curve: saturation and PRNU."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from udccal.fitting.noise import nonuniformity, photon_transfer
from udccal.fitting.noise.curve import Curve
from udccal.fitting.noise.dark import DarkTerms
from udccal.fitting.noise.data import NoiseData
from udccal.fitting.noise.photon_transfer import TransferFit
from udccal.fitting.noise.prnu import prnu
from udccal.fitting.noise.saturation import Plateau, Saturation, find_saturation


@dataclass(frozen=True)
class LightTerms:
    """What flats tell.

    Attributes:
        curve: photon transfer and response.
        full_DN: saturation above black.
        saturation: where the signal stops.
        prnu: variance of the relative response of pixels.
        copies: the frames of the pairs do not differ.
        stack_clipped: the flat stack reaches saturation.
    """

    curve: Curve
    full_DN: float
    saturation: Saturation
    prnu: nonuniformity.Unevenness
    copies: bool
    stack_clipped: bool

    @property
    def transfer(self) -> TransferFit:
        """Gain, read noise, curvature, response."""
        return self.curve.fit

    @property
    def nonlinearity(self) -> float:
        """Share of the signal that is missing at full scale."""
        return float(self.transfer.values[2]) * self.full_DN

    @property
    def bent_too_far(self) -> bool:
        """The curvature ran into its bound."""
        return abs(self.nonlinearity) >= 0.999 * photon_transfer.MOST_BENT


def fit_light_terms(data: NoiseData, dark: DarkTerms, curve: Curve) -> LightTerms:
    """All that is bright, given the curve."""
    after = max(float(curve.fit.values[1]), 0.0) + data.q_DN**2 / 12.0
    plateau = Plateau(after, dark.dsnu_DN2.value, dark.row_DN2.value, data.q_DN)
    variances = np.stack([flat.variance_DN2 for flat in data.flats])
    above = np.stack([flat.mean_DN for flat in data.flats]) - dark.black_DN
    lit = (above < 0.9 * (curve.ceiling_DN - dark.black_DN)) & (above > 0)
    quiet = dark.read_DN2.value + data.q_DN**2 / 12.0
    return LightTerms(
        curve=curve,
        full_DN=max(curve.ceiling_DN - dark.black_DN, 1.0),
        saturation=find_saturation(data.flats, curve.full, plateau, data.top_DN),
        prnu=_prnu(data, dark, curve.fit),
        copies=bool(lit.any()) and float(np.median(variances[lit])) < 0.3 * quiet,
        stack_clipped=_stack_clipped(data, dark, curve.fit, curve.ceiling_DN),
    )


def _prnu(data: NoiseData, dark: DarkTerms, fit: TransferFit) -> nonuniformity.Unevenness:
    """From the stacks; the temporal variance that averaging left comes from the photon transfer curve."""
    K, V0, c = (float(v) for v in fit.values[:3])
    bright, stack = data.flat_stack, data.dark_stack
    quiet = max(V0, 0.0) + data.q_DN**2 / 12.0
    rate = dark.dark_DN_per_s.value
    at_no_light = (quiet + K * rate * bright.exposure_s) / bright.frames
    if dark.white:
        signal = bright.mean_DN.astype(np.float32) - stack.mean_DN.astype(np.float32)
        at_no_light += (quiet + K * rate * stack.exposure_s) / stack.frames
    else:
        # Dark codes that are cut off or coarse do not show the offsets: their variance is taken off instead.
        signal = bright.mean_DN.astype(np.float32) - np.float32(dark.black_DN + rate * bright.exposure_s)
        at_no_light += dark.dsnu_DN2.value
    level = max(nonuniformity.rough_median(signal), 1e-6)
    z = float(photon_transfer.linear_signal(np.array(level), c, K))
    steep = 1 - 2 * c * z
    found = prnu(signal, at_no_light, K * z * steep**2 / level / bright.frames, data.period)
    # Where the response bends, a relative change of light is a smaller relative change of signal.
    scale = (level / (z * steep)) ** 2
    offsets = 0.0 if dark.white else float(np.sqrt(dark.dsnu_DN2.variance)) / level**2
    sigma = float(np.hypot(found.sigma, offsets)) * scale
    return replace(found, variance=found.variance * scale, sigma=sigma)


def _stack_clipped(data: NoiseData, dark: DarkTerms, fit: TransferFit, ceiling: float) -> bool:
    level = nonuniformity.rough_median(data.flat_stack.mean_DN)
    return level > ceiling - 4 * float(np.sqrt(max(fit.values[0], 0.0) * max(ceiling - dark.black_DN, 1.0)))
