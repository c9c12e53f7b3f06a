"""A response that bends: the light of a sample that is missing, in proportion to its square, in bright stars and faint.

The fitted psf takes up what stars of the mean brightness lack: it is another psf. Brighter stars lack more than that,
fainter ones less. With brightness from half to one and a half of the mean, 20 stars tell a peak that lacks 8 % to a
quarter of that, and 40 stars to an eighth; the kernels are then 2 to 3 % wrong.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float

from udccal.fitting.engine.misfit import SIGNIFICANT, chi2_tail
from udccal.fitting.psf_stamps.data import Stamps
from udccal.fitting.psf_stamps.model_error import by_star
from udccal.fitting.psf_stamps.probability import State, expectation


@final
@dataclass(frozen=True)
class Bend:
    """A bend of the response.

    Attributes:
        missing: part of its light that the brightest sample lacks; negative where it has more.
        size: by how much it changes kernels, relative L2, root mean square over stars.
    """

    missing: float
    size: float


def bend_of(stamps: Stamps, state: State) -> Bend | None:
    """Return the bend that residuals show, or None where chance explains it."""
    seen = expectation(stamps, state)
    background, of_star = (np.take_along_axis(e, stamps.plane, axis=1) for e in (state.background_e, state.light_e))
    light = seen.mean_e - background
    root = np.sqrt(np.where(stamps.clipped, 0.0, seen.weight))
    taken = np.linalg.qr(root[..., None] * by_star(stamps, state, seen))[0]

    def beside(change_e: Float[np.ndarray, "stars samples"]) -> Float[np.ndarray, "stars samples"]:
        """What a star's own place, light and background leave of a change, in sigma."""
        change = (root * change_e)[..., None]
        return np.asarray((change - taken @ (taken.transpose(0, 2, 1) @ change))[..., 0])

    lacking, common = beside(light**2), beside(light**2 / of_star)
    contrast = lacking - common * float((lacking * common).sum() / max((common**2).sum(), 1e-300))
    information = float((contrast**2).sum())
    missing_per_e = -float((contrast * root * seen.residual).sum()) / max(information, 1e-300)
    if chi2_tail(missing_per_e**2 * information, 1.0) > SIGNIFICANT:
        return None
    norm = ((root * light) ** 2).sum(axis=1)
    size = float(np.sqrt(np.mean((lacking**2).sum(axis=1)[norm > 0] / norm[norm > 0])))
    return Bend(missing_per_e * float(light[root > 0].max()), abs(missing_per_e) * size)
