"""Fit a psf field to stamps of point sources: orders, places and light found along with it, and true error bars.

The data are arrays: stamps in electrons, each about one source, of a sensor without colours or of a raw mosaic.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from udccal.errors import FitError
from udccal.fitting.psf_stamps.data import Stamps, split
from udccal.fitting.psf_stamps.orders import Orders
from udccal.fitting.psf_stamps.report import Verdict, report
from udccal.fitting.psf_stamps.select import SPACINGS_PX, select
from udccal.fitting.psf_stamps.state import Scene
from udccal.fitting.psf_stamps.term import StampsPsf
from udccal.numerics import in_float64
from udccal.result import FitResult, FitStatus

_FEWEST_STARS = 4
# Stars with an unclipped core, at least so many; light over noise in the median stamp, at least so much.
_FEWEST_UNCLIPPED, _CORE_PX, _LEAST_SNR = 3, 1.5, 10.0


@in_float64
def fit_psf_stamps(stamps: Stamps, orders: Orders | None = None, seed: int = 0) -> FitResult[StampsPsf]:
    """The psf field of stamps.

    Args:
        stamps: of at least four point sources; checked when they were made.
        orders: degrees and spacing of nodes; found by the data when left out.
        seed: of the draws that stand for the posterior.

    Returns:
        A result whose term predicts kernels and their sigma anywhere in the field. Its estimates are the relative L2
        error to be expected at the stamps' positions, and the coefficients of the map.

    Raises:
        FitError: when there are fewer than four stamps.
    """
    if len(stamps.values_e) < _FEWEST_STARS:
        raise FitError(f"Expected at least {_FEWEST_STARS} stamps, found {len(stamps.values_e)}. Cut more of them.")
    scene, box = _scene(stamps)
    bad = _unusable(scene)
    lowest = Orders(0, 0, SPACINGS_PX[0])
    try:
        chosen = select(scene, stamps, orders if bad is None else lowest)
    except np.linalg.LinAlgError:
        bad = Verdict(FitStatus.NOT_CONVERGED, "The equations were singular; what is given is one psf for all places.")
        chosen = select(scene, stamps, lowest)
    return report(scene, stamps, chosen, box, np.random.default_rng(seed), bad)


def _scene(stamps: Stamps) -> tuple[Scene, tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]]:
    """The samples by colour, and middle and half size of the field that the stamps cover."""
    low, high = stamps.position_px.min(axis=0), stamps.position_px.max(axis=0)
    middle, half = (low + high) / 2.0, np.maximum((high - low) / 2.0, 1.0)
    return Scene(split(stamps), (stamps.position_px - middle) / half, stamps.read_e, stamps.clip_e), (middle, half)


def _unusable(scene: Scene) -> Verdict | None:
    """What stands in the way of a fit, if anything."""
    for plane in scene.planes:
        light = (plane.value_e * plane.usable).sum(axis=1)
        noise = np.sqrt(np.maximum(light, 0.0) + plane.usable.sum(axis=1) * scene.read_e**2)
        snr = float(np.median(light / np.maximum(noise, 1e-300)))
        if snr < _LEAST_SNR:
            note = f"Light over noise of a stamp is {snr:.1f} in the median; at least {_LEAST_SNR:.0f} are needed."
            return Verdict(FitStatus.TOO_DARK, note)
        core = np.abs(plane.offset_px).max(axis=2) <= _CORE_PX
        clear = int((~(plane.clipped & core).any(axis=1) & (plane.usable & core).any(axis=1)).sum())
        if clear < _FEWEST_UNCLIPPED:
            note = f"{clear} stamps have a core that is not clipped or missing; {_FEWEST_UNCLIPPED} are needed."
            return Verdict(FitStatus.SATURATED, note)
    return None
