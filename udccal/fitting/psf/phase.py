"""Do the data ask for the wire's phase in the kernel? The strength of what the phase changes, estimated beside all
other parameters: 1 where the footprint lies where the wire has it, 0 where the kernel knows nothing of it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from udccal.fitting.psf.blocks import FOOTPRINT, Block
from udccal.fitting.psf.descent import reduced
from udccal.fitting.psf.diffraction import DiffractionFit, expected_light
from udccal.fitting.psf.normal import normal_equations
from udccal.result import Candidate

# Residuals are moved by this share of the phase's light: too little to change which of them are outliers.
_TRIED = 1e-3


@dataclass(frozen=True)
class PhaseEvidence:
    """Estimated strength of the interference between orders, with its sigma, and both candidates by BIC."""

    strength: float
    sigma: float
    candidates: tuple[Candidate, Candidate]

    @property
    def wanted(self) -> bool:
        """Whether the kernel with the wire's phase is the better one."""
        return self.candidates[0].chosen


def phase_evidence(fit: DiffractionFit) -> PhaseEvidence:
    """Compare a fit with interference to the same without, to second order about the fit."""
    problem, point = fit.problem, fit.point
    bare = replace(
        problem,
        overlaps=tuple(np.zeros_like(overlaps) for overlaps in problem.overlaps),
        blocks=tuple(_without_interference(block) for block in problem.blocks),
    )
    matrix, _, inverses = reduced(problem, point)
    score, own, cross = 0.0, 0.0, np.zeros(fit.theta.size)
    parts = (problem.blocks, problem.overlaps, point.local, point.normals, inverses)
    lights, plain = expected_light(problem, point), expected_light(bare, point)
    for (block, overlaps, local, normal, inverse), light, without in zip(
        zip(*parts, strict=True), lights, plain, strict=True
    ):
        by_phase, weight = light - without, np.asarray(block.weight)
        residual = np.asarray(block.rate) - light - np.asarray(local.background)[:, None]
        moved = replace(block, rate=np.asarray(block.rate) + _TRIED * by_phase)
        there = normal_equations(problem.evaluator, point.theta, moved, local, overlaps)
        with_global = (np.asarray(there.g) - np.asarray(normal.g)) / _TRIED
        with_local = (np.asarray(there.l) - np.asarray(normal.l)) / _TRIED
        score += float(np.sum(weight * by_phase * residual))
        own += float(np.sum(weight * by_phase**2) - np.einsum("sl,slm,sm->", with_local, inverse, with_local))
        cross += with_global - np.einsum("spl,slm,sm->p", np.asarray(normal.gl), inverse, with_local)
    information = max(own - float(cross @ np.linalg.solve(matrix, cross)), 1e-12)
    strength = 1.0 + score / information
    worse = information * (2.0 * strength - 1.0)
    footprint = FOOTPRINT.stop - FOOTPRINT.start
    unknowns, each = problem.unknowns, float(np.log(problem.samples))
    with_it, without_it = point.cost + unknowns * each, point.cost + worse + (unknowns - footprint) * each
    wanted = with_it < without_it
    return PhaseEvidence(
        strength=strength,
        sigma=information**-0.5,
        candidates=(
            Candidate("diffraction with the wire's phase (BIC)", unknowns, with_it, wanted),
            Candidate("diffraction averaged over the phase (BIC)", unknowns - footprint, without_it, not wanted),
        ),
    )


def _without_interference(block: Block) -> Block:
    nothing = np.zeros_like(block.correction)
    return replace(block, correction=nothing, overlap_slope=nothing, pitch_slope=nothing)
