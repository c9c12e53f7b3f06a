"""Prediction for backscatter: the fit's likelihood at its own positions, for pictures as the procedure shows them.

Some pictures are drawn as the procedure draws them; others, which it does not show, are to be predicted.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final, final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt8

from udccal.arrangements import Dark, PanelPicture
from udccal.calibration import FitEffort
from udccal.displays.pictures import face_picture
from udccal.fitting.backscatter.bins import Bins
from udccal.fitting.backscatter.data import (
    grid_step,
    sampled_rays,
    visible_crop,
)
from udccal.fitting.backscatter.solve import SLACK_PX, corners_of, window_for
from udccal.fitting.backscatter.vector import Prior, prior_of, values_of, with_vector
from udccal.fitting.nominal import nominal_backscatter
from udccal.models.backscatter import Backscatter, emitter_shares, mixed_colours, panel_light
from udccal.numerics import in_float64
from udccal.planning.forecast import Floor
from udccal.planning.panel_bins import BinNoise, Ratios, light_sigma, told_by
from udccal.planning.state import WHITE, EvenField, RigState, sample_variance_e
from udccal.planning.steps import PlannedStep, planned_steps
from udccal.rig import Captures

# So many pictures of the procedure stand for all, since drawing them takes long: more are more of the same kind.
_DRAWN = 6
# Of pictures that no calibration shows, whose light is to be predicted.
_NEW_SEEDS = (9001, 9002, 9003)
_NEW = len(_NEW_SEEDS)
# Frames are counted with pictures of no size.
_COUNTING_PX = 8
_FEWEST_PICTURES = 6
_WHITE_VALUE: Final = 255
_LEAST: Final = 1e-6
_NEXT_TO_NOTHING: Final = 1e-15
_MANY: Final = 1_000_000


@final
class BackscatterPredictor:
    """Predicts the sigma of a new picture's light in per cent of the light's peak."""

    @in_float64
    def __init__(self, state: RigState) -> None:
        self._state = state
        rig = state.rig
        self._step_px = grid_step(rig)
        rays, flat = sampled_rays(state.geometry, rig, self._step_px, FitEffort().backscatter_positions)
        prior = prior_of(rig)
        self._precision = np.diag(prior.sigma**-2.0)
        x = prior.mean if state.backscatter is None else _vector(state.backscatter, prior)
        template = nominal_backscatter(state.geometry, rig, np.zeros((3, 2, 2)), self._step_px, window=1)
        template = replace(template, window=window_for(template, x, rays, SLACK_PX))
        self._ratios = _ratios(state, template, x, rays)
        # Where in the field the light falls: what leaves the panel evenly is shaded like everything else.
        across = rig.camera.columns // self._step_px
        rows, columns = np.divmod(flat, across)
        self._bins = across * (rig.camera.rows // self._step_px)
        pixels = self._step_px * (np.stack([columns, rows], axis=1) + 0.5) - 0.5
        self._shading = EvenField(state).at(pixels)
        self._white = _white_light(state, flat, self._shading)
        # What a sample's variance, and that of a row's offset, come to in a bin's average.
        bins, one = Bins(rig.camera.cfa, self._step_px), np.ones((rig.camera.rows, rig.camera.columns))
        self._by_sample = bins.variance(one).reshape(3, -1)[:, flat]
        self._by_row = bins.row_variance(one).reshape(3, -1)[:, flat]

    def sigma(self, captures: Captures) -> float:
        """Root mean square over sensor, colours and pictures, of these' peaks; see ``prediction.Predictor``."""
        noise, count = self._of_captures(captures)
        return float("inf") if noise is None else self._light_sigma(noise, count)

    def used(self, captures: Captures) -> float:
        """Of all bins, a part tells the kernel; see ``prediction.Predictor``."""
        noise, count = self._of_captures(captures)
        if noise is None:
            return 1.0
        return (
            self._light_sigma(noise, count, self._bins / self._white.shape[1]) / self._light_sigma(noise, count)
        ) ** 2

    def _of_captures(self, captures: Captures) -> tuple[BinNoise | None, int]:
        """Noise, and pictures beside white; None where there are too few."""
        steps = list(_planned(self._state.with_captures(captures)))
        pictures = [step for step in steps if isinstance(step.arrangement, PanelPicture)]
        darks = [step for step in steps if isinstance(step.arrangement, Dark)]
        if len(pictures) - 1 < _FEWEST_PICTURES or not darks:
            return None, 0
        return self._noise(pictures[0], darks[0]), len(pictures) - 1

    def floor(self) -> Floor:
        """What a profile's fit found its model to leave out, of a new picture's peak; nothing where there is none."""
        explained = self._state.unexplained.backscatter == 0
        return Floor(
            0.0 if explained else self._light_sigma(self._noiseless(), _MANY),
            "That much of the light the fit of the present profile could not describe; no further picture changes it.",
        )

    def _light_sigma(self, noise: BinNoise, count: int, each: float = 1.0) -> float:
        """Bins that the fit looks at stand for ``each`` of them."""
        told = told_by(self._ratios.part(slice(-_NEW)), noise, count)
        told = replace(told, kernel=each * told.kernel)
        new, inflation = self._ratios.part(slice(-_NEW, None)), self._state.unexplained.inflation
        return 100.0 * light_sigma(new, noise, told, self._precision, inflation)

    def _noise(self, white: PlannedStep, dark: PlannedStep) -> BinNoise:
        """In units in which white, shaded, is 1 where it is brightest."""
        shot, rest = self._of_step(white)
        return replace(self._noiseless(), shot=shot, rest=rest, dark=self._of_step(dark)[1])

    def _of_step(self, step: PlannedStep) -> tuple[Float[np.ndarray, "3 n"], Float[np.ndarray, "3 n"]]:
        """Variance of a bin per unit of its light, and in the dark."""
        state = self._state
        full = (step.level or 0.0) * state.full_well_e * np.ones((3, 1)) * self._shading
        row = float(np.asarray(state.noise.sigma_row_DN / state.noise.K_DN_per_e)) ** 2
        dark = float(sample_variance_e(state, np.zeros(1), step.exposures_s[0])[0])
        rest = max(dark - row, 0.0) * self._by_sample + row * self._by_row
        frames = len(step.exposures_s)
        return self._by_sample / (full * frames), rest / (full**2 * frames)

    def _noiseless(self) -> BinNoise:
        nothing = np.full(self._white.shape, _NEXT_TO_NOTHING)
        return BinNoise(self._white, nothing, nothing, nothing, self._state.unexplained.backscatter)


def _white_light(
    state: RigState, flat: Int[np.ndarray, " n"], shading: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "3 n"]:
    """Light of white at grid positions: even, or as a profile's mask has it."""
    light = (np.array(WHITE) / max(WHITE))[:, None] * np.ones(len(flat))
    if state.backscatter is not None and np.max(state.backscatter.mask) > 0:
        mask = np.asarray(state.backscatter.mask, dtype=np.float64).reshape(3, -1)
        light = np.maximum(mask[:, flat], 1e-3 * mask.max())
    return np.asarray(light / (light * shading).max())


def _planned(state: RigState) -> list[PlannedStep]:
    """The steps with pictures of no size: only exposures and frames matter."""
    return list(planned_steps("backscatter", _smaller(state)))


def _smaller(state: RigState) -> RigState:
    cut = state.rig.panel.model_copy(update={"columns": _COUNTING_PX, "rows": _COUNTING_PX})
    return state.of(state.rig.model_copy(update={"panel": cut}))


def _vector(term: Backscatter, prior: Prior) -> Float[np.ndarray, "18"]:
    """A fitted term in the solver's coordinates, some of which are logarithms."""
    emitters, mix = np.asarray(term.emitters_px), np.asarray(term.mix)
    lengths = (term.distance_mm, term.pupil_mm, term.softness_px, term.reflection, term.reflection_mm)
    crosstalk = (mix / np.diag(mix)[:, None])[~np.eye(3, dtype=bool)]
    places = (emitters[1], emitters[0] - emitters[1], emitters[2] - emitters[1])
    values = np.concatenate([[float(np.asarray(one)) for one in (term.gamma, *lengths)], *places, crosstalk])
    logarithmic = np.isclose(values_of(prior.mean), np.exp(prior.mean))
    return np.where(logarithmic, np.log(np.maximum(values, _LEAST)), values)


def _ratios(
    state: RigState, template: Backscatter, x: Float[np.ndarray, "18"], rays: Float[np.ndarray, "n 3"]
) -> Ratios:
    """Of pictures as the procedure shows them, and last of those for the prediction."""
    panel, crop = state.rig.panel, visible_crop(state.geometry, state.rig)
    few = state.with_captures(state.rig.captures.model_copy(update={"backscatter_pictures": _DRAWN}))
    shown = [
        crop.of(step.arrangement.picture)
        for step in planned_steps("backscatter", few)
        if isinstance(step.arrangement, PanelPicture) and step.arrangement.picture.min() < _WHITE_VALUE
    ]
    shown += [crop.of(face_picture(seed, panel.columns, panel.rows)) for seed in _NEW_SEEDS]
    corner = corners_of(template, x, rays)
    seen = _in_windows(np.stack(shown), corner - np.array([crop.column, crop.row]), template.window)
    value, slope = _with_slopes(x, template, rays, corner, seen)
    return Ratios(np.asarray(value), np.asarray(slope))


def _in_windows(
    shown: UInt8[np.ndarray, "pictures rows columns 3"], first: Int[np.ndarray, "n 2"], window: int
) -> Float[np.ndarray, "pictures n window2 3"]:
    """Picture values, 0 to 255, in a window of panel pixels per position; dark beyond the part that is seen."""
    padded = np.pad(shown, [(0, 0), (window, window), (window, window), (0, 0)])
    span = np.arange(window)
    # (x, y) of the windows' first pixels, held inside the padding.
    start = np.clip(first + window, 0, np.array(padded.shape[2:0:-1]) - window)
    rows, columns = start[:, 1, None, None] + span[:, None], start[:, 0, None, None] + span[None, :]
    return padded[:, rows, columns].reshape(len(shown), len(first), -1, 3).astype(np.float64)


@jax.jit
def _with_slopes(
    x: Float[Array, "18"], template: Backscatter, rays: Array, corner: Array, seen: Array
) -> tuple[Float[Array, "pictures 3 n"], Float[Array, "pictures 3 n 18"]]:
    """Light of pictures over that of white, and its slopes by the parameters."""

    def ratios(values: Float[Array, "18"]) -> Float[Array, "pictures 3 n"]:
        term = with_vector(template, values)
        shares = emitter_shares(term, rays, corner)
        light = mixed_colours(term, jnp.einsum("nwp,inwp->inp", shares, panel_light(term, seen)))
        return jnp.moveaxis(light / mixed_colours(term, shares.sum(axis=1)), 1, 2)

    return ratios(x), jax.jacfwd(ratios)(x)
