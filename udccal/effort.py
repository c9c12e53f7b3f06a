"""How much time a calibration's fits may take."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from udccal.fitting.psf.data import PsfRules
from udccal.fitting.wire.parameters import WireRules
from udccal.result import Effort


@dataclass(frozen=True)
class FitEffort:
    """Effort of the fits; less effort is quicker and less accurate.

    Attributes:
        wire_samples: number of pixels that the wire's fields are fitted to.
        psf: see ``udccal.fitting.psf.data.PsfRules``.
        backscatter_positions: number of sensor positions that the footprint is fitted at.
        workers: 2 fits psf and backscatter, which are independent, at the same time; 1 needs less memory.
    """

    wire_samples: int = WireRules().samples
    psf: PsfRules = field(default_factory=PsfRules)
    backscatter_positions: int = 96
    workers: int = 2

    @property
    def label(self) -> Effort:
        """Name of the effort in a profile: full, quick (a demonstration's), or one of your own."""
        alike = replace(self, workers=FitEffort.workers)
        return "full" if alike == FitEffort() else "quick" if alike == QUICK else "own"


# For a demonstration.
QUICK = FitEffort(
    wire_samples=60_000,
    psf=PsfRules(positions=5, shifts=2, half_px=(36, 12), close_px=(32, 12)),
    backscatter_positions=32,
)
