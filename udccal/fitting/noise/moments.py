"""What frames are reduced to: means and temporal variances per bin (CFA site x tile), row noise apart."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32


@dataclass(frozen=True)
class RowMoments:
    """Row noise of frames alike: sigma_row^2 (may be negative by chance), sampling variance included, and its rank."""

    variance_DN2: float
    sampling_DN2: float
    dof: float

    @property
    def sigma_DN2(self) -> float:
        """Standard deviation of ``variance_DN2``."""
        return (max(self.variance_DN2, 0.0) + self.sampling_DN2) * float(np.sqrt(2.0 / max(self.dof, 1.0)))


@dataclass(frozen=True)
class PairMoments:
    """Two frames of the same scene (or a stack of more).

    Attributes:
        exposure_s: of both frames.
        light: relative exposure to light, in any unit common to all levels (photons per pixel, or seconds).
        mean_DN: mean code per bin.
        variance_DN2: temporal variance of one frame per bin, row noise and common changes of brightness removed.
        dof: degrees of freedom of ``variance_DN2``.
        samples: frames times pixels of each bin.
        spread_DN: standard deviation over the samples of the bin, spatial and temporal.
        rows: row noise.
        shift_DN: mean of the first frame minus that of the second, per bin.
        frames: how many (2 for a pair).
        height: their rows.
        peak_DN: the largest code.
        at_peak: share of the samples with that code.
        outliers: samples whose two codes differ too much to be noise; left out.
    """

    exposure_s: float
    light: float
    mean_DN: Float[np.ndarray, " bins"]
    variance_DN2: Float[np.ndarray, " bins"]
    dof: Float[np.ndarray, " bins"]
    samples: Float[np.ndarray, " bins"]
    spread_DN: Float[np.ndarray, " bins"]
    rows: RowMoments
    shift_DN: Float[np.ndarray, " bins"]
    frames: int
    height: int
    peak_DN: int
    at_peak: float
    outliers: int


@dataclass(frozen=True)
class StackMoments:
    """Many frames of the same scene: their mean, and where the frames themselves were seen, temporal moments.

    ``temporal`` is None for an average that was made elsewhere: its variance would hold the lamp's flicker.
    """

    exposure_s: float
    mean_DN: Float32[np.ndarray, "rows columns"]
    frames: int
    temporal: PairMoments | None = None
