"""LED shots as they are expected to be seen: their light on every sample, and what a bracket tells of it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import final

import numpy as np
from jaxtyping import Float

from udccal.calibration import FitEffort
from udccal.cfa import channel_map
from udccal.fitting.psf.blocks import Block, Local, blocks, fit_lattice
from udccal.fitting.psf.descent import Prior
from udccal.fitting.psf.normal import Evaluator, kernel_coefficients, overlaps_of, unit_light
from udccal.fitting.psf.samples import choose_samples
from udccal.fitting.psf.shots import Shots
from udccal.planning.state import WHITE, RigState, sample_variance_e
from udccal.planning.steps import PlannedStep
from udccal.rig import Captures

# Places in fractions of the sensor, and shifts in px, that stand for all: of the field, and of the procedure's grid,
# which reaches nearly to the border.
_FIELD = ((0.45, 0.55), (0.15, 0.2), (0.85, 0.7))
_CAPTURED = ((0.05, 0.06), (0.5, 0.94), (0.9, 0.5))
_SHIFTS_PX = np.array([[0.4, 1.3], [1.7, 0.2]])


@final
@dataclass(frozen=True)
class ExpectedShots:
    """Blocks of shots with their light (``rate``, 1 for the brightest sample of each), and the model that they are of.

    ``share`` is how many samples of the window each of those chosen stands for; the first ``in_field`` blocks are at
    places of the field, the others where the procedure captures.
    """

    evaluator: Evaluator
    theta: Float[np.ndarray, " p"]
    blocks: tuple[Block, ...]
    locals: tuple[Local, ...]
    overlaps: tuple[np.ndarray, ...]
    share: Float[np.ndarray, "shots n"]
    in_field: int = len(_FIELD)

    def parts(self) -> Iterator[tuple[Block, Local, np.ndarray]]:
        """Place by place."""
        return zip(self.blocks, self.locals, self.overlaps, strict=True)

    def relative_weight(self, block: Block) -> Float[np.ndarray, "shots n"]:
        """Weights at which squared errors of light sum up to the squared relative L2 error, mean over colours."""
        light, colour = np.asarray(block.rate), np.asarray(block.colour)
        size = np.einsum("sn,snc,sn->sc", light**2, colour, self.share)
        return np.asarray(self.share * np.einsum("snc,sc->sn", colour, 1 / size) / 3)


def expected_shots(state: RigState, prior: Prior, interference: bool) -> ExpectedShots:
    """What the diffraction fit at its default effort would be given of each place, light being that of its start."""
    theta = prior.mean
    effort = FitEffort().psf
    half = _half(state.rig.captures, effort.half_px)
    close = (min(half[0], effort.close_px[0]), min(half[1], effort.close_px[1]))
    evaluator = Evaluator(prior.wavelengths_nm, fit_lattice(close), interference)
    shots = _dark_shots(state, half)
    chosen = choose_samples(shots, close, effort.far_share)
    every = choose_samples(shots, close, 1.0)
    near = choose_samples(shots, close, 0.0)
    per_far = (every[0].sum() - near[0].sum()) / max(chosen[0].sum() - near[0].sum(), 1)
    made, own, overlaps = [], [], []
    for block in blocks(shots, state.geometry, chosen):
        overlap = np.asarray(overlaps_of(evaluator, theta, block.frame))
        lit, local = _lit(evaluator, theta, block, overlap)
        made.append(lit)
        own.append(local)
        overlaps.append(overlap)
    share = np.where(near[chosen].reshape(shots.count, -1)[: len(_SHIFTS_PX)], 1.0, per_far)
    return ExpectedShots(evaluator, theta, tuple(made), tuple(own), tuple(overlaps), share)


def sample_information(
    state: RigState, relative: Float[np.ndarray, "shots n"], step: PlannedStep
) -> Float[np.ndarray, "shots n"]:
    """Inverse variance of each sample's light, of which the brightest has 1, after its bracket is merged, with PRNU
    and what a profile's fit has found its model to leave out.

    Exposures that would fill a sample's well tell nothing of it.
    """
    full_e = (step.level or 0.0) * state.full_well_e
    light = np.maximum(relative, 0.0)
    known = np.zeros_like(light)
    for exposure_s in step.exposures_s:
        ratio = exposure_s / step.exposures_s[0]
        signal_e = full_e * ratio * light
        variance = sample_variance_e(state, signal_e, exposure_s)
        known += np.where(signal_e < state.full_well_e, (full_e * ratio) ** 2 / variance, 0.0)
    # What the model leaves out matters the more, relatively, the fainter a sample is: as the fit has it.
    beside = (float(np.asarray(state.noise.PRNU1288)) * light) ** 2 + (state.unexplained.psf * light**0.75) ** 2
    return np.where(known > 0, 1 / (1 / np.maximum(known, 1e-30) + beside), 0.0)


def _half(captures: Captures, largest: tuple[int, int]) -> tuple[int, int]:
    """(rows, columns) to either side of the LED that a region fills, as the fit has it."""
    sides = (captures.psf_region_rows, captures.psf_region_columns)
    rows, columns = (max(4, min(most, side // 2 - 4)) for most, side in zip(largest, sides, strict=True))
    return rows, columns


def _dark_shots(state: RigState, half: tuple[int, int]) -> Shots:
    """Where the shots are and what colour their samples have; their light is yet to come."""
    rig = state.rig
    size = np.array([rig.camera.columns, rig.camera.rows])
    places = np.floor(np.array([*_FIELD, *_CAPTURED]) * size / 2) * 2
    aims = (places[:, None] + _SHIFTS_PX).reshape(-1, 2)
    origins = np.round(aims).astype(np.int64)
    rows, columns = 2 * half[0] + 1, 2 * half[1] + 1
    whole = channel_map(rig.camera.cfa, rows + 1, columns + 1)
    first = (origins - np.array([half[1], half[0]])) % 2
    channel = np.stack([whole[y : y + rows, x : x + columns] for x, y in first])
    nothing = np.zeros((len(aims), rows, columns))
    captures = rig.captures
    disc = captures.psf_led_mm / (captures.psf_distance_mm + rig.mounting.standoff_mm.value) * rig.focal_px
    return Shots(
        centre_px=aims,
        origin_px=origins,
        position=np.repeat(np.arange(len(places)), len(_SHIFTS_PX)),
        disc_px=np.full(len(aims), disc),
        rate=nothing,
        weight=nothing + 1.0,
        channel=channel,
        noise_per_rate=nothing,
    )


def _lit(
    evaluator: Evaluator, theta: Float[np.ndarray, " p"], block: Block, overlaps: np.ndarray
) -> tuple[Block, Local]:
    """The block with its light, the brightest sample of every shot 1."""
    shots = len(np.asarray(block.index))
    coefficients = np.asarray(kernel_coefficients(evaluator, theta, block, overlaps))
    unit = np.asarray(unit_light(evaluator, block, np.zeros((shots, 2)), coefficients))
    light = unit * (np.asarray(block.colour) @ np.array(WHITE))
    peak = light.max(axis=1, keepdims=True)
    local = Local(np.zeros((shots, 2)), np.array(WHITE) / peak, np.zeros(shots))
    return replace(block, rate=light / peak), local
