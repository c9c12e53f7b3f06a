"""The fit of the diffraction field as a whole: near the minimum, to it at the places found there, with or without the
wire's phase.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from udccal.fitting.psf.blocks import Block, Local, at_places, blocks, fit_lattice
from udccal.fitting.psf.descent import Point, Prior, pose
from udccal.fitting.psf.diffraction import DiffractionFit, approach, refine
from udccal.fitting.psf.normal import Evaluator
from udccal.fitting.psf.phase import PhaseEvidence, phase_evidence
from udccal.fitting.psf.samples import choose_samples
from udccal.fitting.psf.shots import Shots
from udccal.models.geometry import Geometry


@dataclass(frozen=True)
class FieldFit:
    """The chosen fit, and what it stands on.

    Attributes:
        diffraction: the fit.
        shots: at the places that its blocks are about.
        phase: evidence for the wire's phase; None where the wire was not seen.
    """

    diffraction: DiffractionFit
    shots: Shots
    phase: PhaseEvidence | None


def fit_field(
    shots: Shots,
    geometry: Geometry,
    prior: Prior,
    close: tuple[int, int],
    far_share: float,
    iterations: int,
    wire_shows: bool,
) -> FieldFit:
    """Fit the numbers of diffraction.

    Args:
        shots: what to fit, positions numbered without gaps.
        geometry: where pixels look.
        prior: of the global parameters; its mean is the start.
        close: largest window (rows, columns) to either side.
        far_share: of the samples away from the peak, so many are used.
        iterations: at most.
        wire_shows: whether the footprint's place on the rows is known.
    """
    chosen = choose_samples(shots, close, far_share)
    evaluator = Evaluator(prior.wavelengths_nm, fit_lattice(close), wire_shows)
    problem = pose(blocks(shots, geometry, chosen), evaluator, prior, prior.mean)
    near = approach(problem, iterations)
    shots = at_places(shots, _found(problem.blocks, near.local, shots.count))
    problem = pose(blocks(shots, geometry, chosen), evaluator, prior, near.theta)
    fit = refine(problem, _here(near), iterations)
    if not wire_shows:
        return FieldFit(fit, shots, None)
    evidence = phase_evidence(fit)
    if not evidence.wanted:
        averaged = replace(evaluator, interference=False)
        fit = refine(pose(problem.blocks, averaged, prior, fit.theta), _restarted(fit.point), iterations)
    return FieldFit(fit, shots, evidence)


def _found(parts: tuple[Block, ...], local: tuple[Local, ...], count: int) -> Float[np.ndarray, "shots 2"]:
    """By how much each shot's LED is elsewhere than first assumed."""
    offsets = np.zeros((count, 2))
    for block, own in zip(parts, local, strict=True):
        index = np.asarray(block.index)
        offsets[index[index >= 0]] = np.asarray(own.offset_px)[index >= 0]
    return offsets


def _here(point: Point) -> Point:
    """The same in blocks about the places found."""
    return replace(point, local=tuple(replace(own, offset_px=np.zeros_like(own.offset_px)) for own in point.local))


def _restarted(point: Point) -> Point:
    return replace(point, iterations=0)
