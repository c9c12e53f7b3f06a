"""What cannot be a bracket, and what its samples say against it."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float

from udccal.errors import FitError
from udccal.models.noise import Noise


def checked(frames: object, exposures_s: object) -> Float[np.ndarray, " exposures"]:
    """The exposures, where frames and exposures are what they should be."""
    if not isinstance(frames, np.ndarray) or frames.dtype.kind not in "ui" or frames.ndim < 2:
        found = f"{frames.dtype} of shape {frames.shape}" if isinstance(frames, np.ndarray) else type(frames).__name__
        raise FitError(f"Expected frames as an array of whole codes, frame by frame, found {found}. Pass raw codes.")
    try:
        times = np.asarray(exposures_s, dtype=np.float64)
    except (TypeError, ValueError):
        times = np.zeros(0)
    if times.shape != (len(frames),) or not len(times) or not np.all((times > 0) & np.isfinite(times)):
        expected = f"Expected a positive exposure for each of the {len(frames)} frames of a bracket"
        raise FitError(f"{expected}, found {np.atleast_1d(times)[:8].tolist()}. Give the exposures in seconds.")
    return times


def doubts(scatter: float, black_DN: float, unlike: list[int], off: list[int]) -> list[str]:
    """Sentences for samples that contradict the noise model, or one another."""
    found = []
    if scatter != 1:
        found.append(
            f"Samples scatter about a pixel's light with {scatter:.2f} times the variance of the noise model. Check K, "
            "black level and exposure times; rate and sigma are not to be trusted."
        )
    if black_DN:
        found.append(
            f"Dark samples of all exposures lie {black_DN:+.2g} DN off the black level. Fit the noise with frames "
            "of this gain and temperature; the light of dark pixels is not to be trusted."
        )
    if unlike:
        frames = " and ".join(map(str, unlike))
        found.append(
            f"The light of frames {frames} differs, and no other frame tells which one is right: frame {unlike[0]} is "
            "left out. Check their exposure times, or take exposures that lie closer together."
        )
    found += [
        f"The light of frame {frame} differs from that of the frames beside it, and too few pixels have a third sample "
        "that tells which one is right. Check their exposure times, or take exposures that lie closer together."
        for frame in (off if not found else [])
    ]
    return found


def rounding_e(noise: Noise) -> float:
    """Largest shift of the mean of dark samples by rounding: the first harmonic of what noise does not smear."""
    codes = float(np.asarray(noise.sigma_d_e)) * float(np.asarray(noise.K_DN_per_e)) / float(np.asarray(noise.q_DN))
    step_e = float(np.asarray(noise.q_DN)) / float(np.asarray(noise.K_DN_per_e))
    return step_e / math.pi * math.exp(-2 * (math.pi * codes) ** 2)
