"""What was measured: a run is one case at one tier."""

from __future__ import annotations

import csv
from collections.abc import Iterable
from dataclasses import astuple, dataclass, fields
from pathlib import Path
from typing import Final

import flip_evaluator
import numpy as np
from jaxtyping import Float32

from tests.benchmarks.pareto.groups import COMPARED, Case, Group
from tests.benchmarks.pareto.restoring import Cost, Taken
from tests.benchmarks.pictures import PictureBench, Rgb, displayed
from udccal.restoration.metrics import encode_srgb, psnr, ssim
from udccal.tiers import Tier

# Of the panel's weakest transfer, in cycles/px down the columns.
_BAND: Final = (0.18, 0.30)


@dataclass(frozen=True)
class Run:
    """One line of ``pareto.csv``.

    Attributes:
        group, tier, scene, condition: what was restored, and how.
        before_dB, after_dB: PSNR of the display-encoded picture.
        band_percent: error in the band that the panel swallows (``band_percent``), 0 at best.
        ssim: structural similarity, 1 at best. flip: mean FLIP error, 0 at best.
        ms, cpu_ms: time from a raw frame to a picture of 8 bits.
        peak_MiB: peak resident memory of the process during the run.
    """

    group: Group
    tier: Tier
    scene: str
    condition: str
    before_dB: float
    after_dB: float
    band_percent: float
    ssim: float
    flip: float
    ms: float
    cpu_ms: float
    peak_MiB: float


@dataclass(frozen=True)
class Clear:
    """The PSNR of a camera without a panel on one scene."""

    group: Group
    scene: str
    dB: float


@dataclass(frozen=True)
class Sight:
    """A case with the frame that the camera took of it."""

    case: Case
    room_light: float
    taken: Taken
    before_dB: float

    @property
    def truth(self) -> Rgb:
        """The display-encoded picture of a perfect camera."""
        return encode_srgb(self.case.shot.ideal)

    def after(self, linear: Float32[np.ndarray, "rows columns 3"]) -> Rgb:
        """The display-encoded picture of restored light."""
        return displayed(linear, self.case.shot, self.room_light)

    def run(self, tier: Tier, picture: Rgb, cost: Cost) -> Run:
        """Judge a picture that a tier made."""
        case, truth = self.case, self.truth
        return Run(
            group=case.group,
            tier=tier,
            scene=case.shot.name,
            condition=case.conditions.name,
            before_dB=self.before_dB,
            after_dB=psnr(picture, truth),
            band_percent=band_percent(picture, truth),
            ssim=ssim(picture, truth),
            flip=flip(picture, truth),
            ms=cost.ms,
            cpu_ms=cost.cpu_ms,
            peak_MiB=cost.peak_MiB,
        )


def sight_of(bench: PictureBench, case: Case, matched_light: float) -> Sight:
    """Take the frame of a case."""
    shot, grey, light = case.shot, case.conditions.grey, matched_light * case.conditions.light
    shown = bench.shown(shot, grey) if case.conditions.known else None
    taken = Taken(bench.frame(shot, light, grey), bench.exposure_s(shot, light, grey), shown)
    return Sight(case, light, taken, psnr(bench.before(shot, light, grey), encode_srgb(shot.ideal)))


def flip(picture: Rgb, truth: Rgb) -> float:
    """Mean FLIP error of a display-encoded picture at 67 pixels per degree.

    Source: Andersson et al., "FLIP: a difference evaluator for alternating images", 2020.
    """
    return float(flip_evaluator.evaluate(truth, np.ascontiguousarray(picture), "LDR", applyMagma=False)[1])


def band_percent(picture: Rgb, truth: Rgb) -> float:
    """RMS of the error between 0.18 and 0.30 cycles/px down the columns, in percent of the RMS of the true picture.

    The panel swallows this band. Too weak a prior draws fine horizontal lines there, which cost few dB.

    Args:
        picture: display-encoded, as for PSNR. truth: what it should be.
    """
    rows = len(truth)
    window = np.hanning(rows + 2)[1:-1, None, None]
    spectrum = np.fft.rfft((picture.astype(np.float64) - truth) * window, axis=0)
    frequency = np.fft.rfftfreq(rows)
    band = (frequency >= _BAND[0]) & (frequency <= _BAND[1])
    # Parseval: the other half of the spectrum has as much.
    energy = 2 * float(np.mean(np.sum(np.abs(spectrum[band]) ** 2, axis=0))) / (rows * float(np.sum(window**2)))
    return 100 * float(np.sqrt(energy / np.mean(truth.astype(np.float64) ** 2)))


def of_group(runs: Iterable[Run], group: Group, tier: Tier) -> list[Run]:
    """The runs of one group at one tier, in their order."""
    return [run for run in runs if run.group is group and run.tier is tier]


def mean_dB(runs: Iterable[Run]) -> float:
    """Mean PSNR of runs; not a number where there are none."""
    values = [run.after_dB for run in runs]
    return float(np.mean(values)) if values else float("nan")


def median_ms(runs: Iterable[Run], tier: Tier) -> float:
    """Median time of a tier over the groups whose light is the usual one: dark frames have more to mend."""
    values = [run.ms for run in runs if run.tier is tier and run.group in COMPARED]
    return float(np.median(values)) if values else float("nan")


def write_csv(runs: Iterable[Run], path: Path) -> None:
    """A line per run."""
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow([field.name for field in fields(Run)])
        for run in runs:
            writer.writerow([f"{value:.5g}" if isinstance(value, float) else value for value in astuple(run)])
