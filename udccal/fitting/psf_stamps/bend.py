"""A response that bends: the light of a sample that is missing, in proportion to its square, in bright stars and faint.

Stars of one brightness hide it: their psf is another one. Where brightness differs, peaks of bright stars are lower,
or higher, than those of faint ones, beside what a star's own place, light and background take up.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np

from udccal.fitting.psf_stamps.data import Stamps
from udccal.fitting.psf_stamps.model_error import by_star
from udccal.fitting.psf_stamps.probability import State, expectation

# Sigmas from which a bend is no chance.
_SURE = 5.0


@final
@dataclass(frozen=True)
class Bend:
    """A bend of the response.

    Attributes:
        missing: part of the light that the brightest sample lacks beside the faint ones; negative where it has more.
        size: by how much it changes kernels, relative L2, root mean square over stars.
    """

    missing: float
    size: float


def bend_of(stamps: Stamps, state: State) -> Bend | None:
    """Return the bend that residuals show, or None where chance explains it.

    The field follows a part of it, so that both numbers are lower bounds, and so is its significance.
    """
    seen = expectation(stamps, state)
    light = seen.mean_e - np.take_along_axis(state.background_e, stamps.plane, axis=1)
    root = np.sqrt(np.where(stamps.clipped, 0.0, seen.weight))[..., None]
    taken = np.linalg.qr(root * by_star(stamps, state, seen))[0]
    square = root * (light**2)[..., None]
    square -= taken @ (taken.transpose(0, 2, 1) @ square)
    information = float((square**2).sum())
    if information == 0.0:
        return None
    missing_per_e = -float((square * root * seen.residual[..., None]).sum()) / information
    if abs(missing_per_e) * information**0.5 < _SURE:
        return None
    norm = ((root[..., 0] * light) ** 2).sum(axis=1)
    size = np.sqrt(np.mean((square**2).sum(axis=(1, 2))[norm > 0] / norm[norm > 0]))
    return Bend(missing_per_e * float(light[root[..., 0] > 0].max()), abs(missing_per_e) * float(size))
