"""What the harmonics that a fit leaves out add to the map: known beforehand if they are there, and part of its sigma.

Hundreds of them are each too weak to be fitted. A panel has them all, as its open fractions and a round pupil have it;
a map that was made without has none. The residuals tell which: as a whole they are one template, and how much of it is
in the residuals is one number with an error.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, final

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from udccal.fitting.wire.basis import Pixels
from udccal.fitting.wire.harmonics import WireStart, omitted_harmonics
from udccal.fitting.wire.misfit import Misfit
from udccal.fitting.wire.noise import Judged
from udccal.fitting.wire.phase import LEAST_GAIN
from udccal.fitting.wire.scan import modulation_at, with_harmonics
from udccal.models.wire import Wire

# Their strongest, with so much of their power, are looked for, what the others would tell not being worth the seconds;
# at so many pixels at most, and so many at a time for the memory's sake.
_LOOKED_FOR: Final = 0.9
_PIXELS: Final = 300_000
_CHUNK: Final = 2**13
# For their RMS, all of them at so many pixels.
_RMS_PIXELS: Final = 2**10
# A real pupil's share of a round one's template is one within this.
_REAL_PUPILS: Final = 0.3
# Rows of half the amplitude that is expected would still have been noticed.
_SURELY_SEEN: Final = 4.0


@final
@dataclass(frozen=True)
class Omitted:
    """The harmonics left out.

    Attributes:
        rms: relative, over the sensor, if they are there.
        share, share_sigma: of them, how much the residuals have, and its error.
    """

    rms: float
    share: float
    share_sigma: float

    @property
    def probability(self) -> float:
        """That they are there, which beforehand is as likely as not.

        By the likelihoods of the share found: 0 with its error, or 1 with that and what real pupils differ by.
        """
        wide = np.hypot(self.share_sigma, _REAL_PUPILS)
        present = -0.5 * ((self.share - 1) / wide) ** 2 - np.log(wide)
        absent = -0.5 * (self.share / self.share_sigma) ** 2 - np.log(self.share_sigma)
        return float(1.0 / (1.0 + np.exp(np.clip(absent - present, -700.0, 700.0))))

    @property
    def sigma(self) -> float:
        """What they are expected to add to the map's error, relative, RMS over the sensor."""
        return self.rms * float(np.sqrt(self.probability))


def omitted(start: WireStart, wire: Wire, judged: Judged) -> Omitted | None:
    """Look for them, at the fitted shape and with a round pupil; None where there are none to leave out.

    Args:
        start: says which harmonics a fit has.
        wire: as fitted.
        judged: pixels whose residuals are looked at, spread over the sensor; those that were fitted do, as a fit takes
            up little of so many harmonics.
    """
    fitted = judged.pixels
    harmonics, bounds = omitted_harmonics(start)
    if not len(harmonics):
        return None
    plain = eqx.tree_at(lambda w: w.amplitudes, wire, np.zeros((0, 2, 1, 1)))
    few = slice(None, None, -(-len(fitted.ideal) // _RMS_PIXELS))
    whole = modulation_at(with_harmonics(plain, harmonics, fitted), fitted.ideal[few], fitted.scaled[few])
    strongest = harmonics[: int(np.searchsorted(np.cumsum(bounds**2), _LOOKED_FOR * np.sum(bounds**2))) + 1]
    some = slice(None, None, -(-len(judged.expected) // _PIXELS))
    pixels, expected = jax.tree.map(lambda values: values[some], judged.pixels), judged.expected[some]
    template = _modulation(with_harmonics(plain, strongest, fitted), pixels)
    used = (pixels.weight > 0) & (expected > 0)
    relative = np.where(used, pixels.value / np.where(used, expected, 1.0) - 1, 0.0)
    weight = np.where(used, pixels.weight * expected**2, 0.0)
    information = max(float(np.sum(weight * template**2)), 1e-300)
    share = float(np.sum(weight * relative * template)) / information
    return Omitted(float(np.std(np.asarray(whole))), share, information**-0.5)


def unseen(bounds: Float[np.ndarray, " harmonics"], searched: Pixels) -> float:
    """What the rig's rows may modulate by, relative RMS, though none were seen; 0 where they would have been.

    Args:
        bounds: of the relative amplitudes of the harmonics that a fit has.
        searched: the pixels that rows were looked for in.
    """
    power = float(np.sum(bounds**2)) / 2
    # Values are 1 but for shading, and a few that are far off must not count as light.
    expected_gain = power * float(np.sum(searched.weight))
    if expected_gain > _SURELY_SEEN * LEAST_GAIN:
        return 0.0
    return float(np.sqrt(power * min(1.0, LEAST_GAIN / max(expected_gain, 1e-300))))


def with_omitted(found: Misfit, sigma: float) -> Misfit:
    """The misfit and what is likely left out, relative, RMS over the sensor, together."""
    by_tile = np.hypot(found.by_tile, sigma)
    return replace(found, sigma=float(np.hypot(found.sigma, sigma)), by_tile=by_tile, omitted=sigma)


def _modulation(wire: Wire, pixels: Pixels) -> Float[np.ndarray, " n"]:
    count = len(pixels.ideal)
    parts = -(-count // _CHUNK)
    # All chunks of one size: one compilation.
    rows = np.minimum(np.arange(parts * _CHUNK), count - 1).reshape(parts, _CHUNK)
    made = [np.asarray(modulation_at(wire, pixels.ideal[row], pixels.scaled[row])) for row in rows]
    return np.concatenate(made)[:count]
