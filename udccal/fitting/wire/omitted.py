"""What the harmonics that a fit leaves out would add to the map: known beforehand, and part of the map's sigma."""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import numpy as np

from udccal.fitting.wire.basis import Pixels
from udccal.fitting.wire.harmonics import WireStart, omitted_harmonics
from udccal.fitting.wire.misfit import Misfit
from udccal.fitting.wire.scan import modulation_at, with_harmonics
from udccal.models.wire import Wire

_PIXELS = 1024


def omitted_rms(start: WireStart, wire: Wire, pixels: Pixels) -> float:
    """Relative RMS over the sensor, at the fitted shape and with a round pupil.

    Args:
        start: says which harmonics a fit has.
        wire: as fitted.
        pixels: spread over the sensor; about a thousand of them are looked at.
    """
    harmonics = omitted_harmonics(start)
    if not len(harmonics):
        return 0.0
    plain = eqx.tree_at(lambda w: w.amplitudes, wire, np.zeros((0, 2, 1, 1)))
    some = slice(None, None, max(1, len(pixels.ideal) // _PIXELS))
    weak = with_harmonics(plain, harmonics, pixels)
    return float(np.std(np.asarray(modulation_at(weak, pixels.ideal[some][:_PIXELS], pixels.scaled[some][:_PIXELS]))))


def with_omitted(found: Misfit, omitted: float) -> Misfit:
    """The misfit and what is known to be left out, together."""
    return replace(
        found, sigma=float(np.hypot(found.sigma, omitted)), by_tile=np.hypot(found.by_tile, omitted), omitted=omitted
    )
