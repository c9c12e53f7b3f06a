"""What the noise fit starts from: frames already reduced, one by one, to moments and histograms."""

from __future__ import annotations

from dataclasses import dataclass

from udccal.fitting.noise.codes import DarkPair
from udccal.fitting.noise.moments import PairMoments, RowMoments, StackMoments


@dataclass(frozen=True)
class NoiseData:
    """All that the fit needs.

    Attributes:
        darks: joint histograms of dark pairs.
        dark_rows: row noise of the same pairs.
        flats: moments of bright pairs.
        flat_stack: averaged flats.
        dark_stack: averaged darks of about the same exposure.
        q_DN: the converter's step.
        top_DN: its largest code.
        period: colour sites repeat after so many samples (1: monochrome).
        notes: what the reduction has to say.
    """

    darks: tuple[DarkPair, ...]
    dark_rows: tuple[RowMoments, ...]
    flats: tuple[PairMoments, ...]
    flat_stack: StackMoments
    dark_stack: StackMoments
    q_DN: int
    top_DN: float
    period: int = 2
    dark_outliers: int = 0
    notes: tuple[str, ...] = ()
