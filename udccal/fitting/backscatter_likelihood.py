"""Likelihood of the backscatter term: every picture's light in every bin with its own variance.

Light of shot i at a position and colour is  y_i = m r_i + u_i d + noise: r_i is the picture's light over that of white
(1 for white itself), m the mask and d the dark signal there, u_i 1 where shot and dark have one exposure. The dark
frame is one more shot with r = 0. m and d stand in no prior and enter linearly: they are profiled out exactly, bin by
bin, so that the noise of white and dark, which all pictures of a bin share, is weighed as it should be. Variances are
of the model, shot noise and what is left in the dark, plus (share m)^2 for what the model does not describe.
"""

from __future__ import annotations

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from udccal.fitting.backscatter_data import PanelShots
from udccal.fitting.backscatter_newton import most_probable
from udccal.fitting.backscatter_vector import PLACES, Order, Prior, mix_of, with_vector
from udccal.fitting.solvers import Solution
from udccal.models.arrays import Arrayish
from udccal.models.backscatter import Backscatter, emitter_shares
from udccal.numerics import in_float64

# Variance of a bin's count is never below this many e-^2: a black picture in a camera without read noise.
LEAST_VARIANCE = 1 / 12
# exp(gamma times this) is nothing.
_LOG_OF_BLACK = -1e3


class Evidence(eqx.Module):
    """Light at sampled positions; white comes first among the shots.

    Attributes:
        rays: of the positions, in panel coordinates.
        light: rates in e-/s above the black level.
        shot: variance per rate, (e-/s)^2 per e-/s; also the rate of one electron in the bin.
        rest: variance of light in the dark.
        usable: False where samples are clipped or left out.
        dark, dark_variance: the dark frame.
        exposure: that of the dark frame over that of each shot.
        shown: what the panel showed, the pictures only; ``first`` is its first panel (column, row).
    """

    rays: Float[Arrayish, "n 3"]
    light: Float[Arrayish, "shots 3 n"]
    shot: Float[Arrayish, "shots 3 n"]
    rest: Float[Arrayish, "shots 3 n"]
    usable: Bool[Arrayish, "shots 3 n"]
    dark: Float[Arrayish, "3 n"]
    dark_variance: Float[Arrayish, "3 n"]
    exposure: Float[Arrayish, " shots"]
    shown: Float[Arrayish, "pictures crop_rows crop_columns 3"]
    first: Int[Arrayish, "2"]


class Profiled(eqx.Module):
    """Mask and dark signal at their best for given ratios, with the mask's information where the dark is not known."""

    mask: Float[Arrayish, "3 n"]
    dark: Float[Arrayish, "3 n"]
    information: Float[Arrayish, "3 n"]


@dataclass(frozen=True)
class Fitted:
    """Parameters and what follows from them at the sampled positions.

    ``errors`` are measured less modelled rates, ``weight`` 1 / sigma of each (0: not used).
    """

    solution: Solution
    corner: Int[np.ndarray, "n 2"]
    ratio: Float[np.ndarray, "shots 3 n"]
    mask: Float[np.ndarray, "3 n"]
    errors: Float[np.ndarray, "shots 3 n"]
    dark_errors: Float[np.ndarray, "3 n"]
    weight: Float[np.ndarray, "shots 3 n"]

    @property
    def z(self) -> Float[np.ndarray, "shots 3 n"]:
        """Errors in units of their sigma, 0 where not used."""
        return self.errors * self.weight


def evidence(shots: PanelShots, rays: Float[np.ndarray, "n 3"], flat: Int[np.ndarray, " n"]) -> Evidence:
    """What was measured at grid positions with these flat indices."""
    everything = (shots.white, *shots.seen)

    def at(plane: np.ndarray) -> np.ndarray:
        return plane.reshape(3, -1)[:, flat]

    return Evidence(
        rays=rays,
        light=np.stack([at(one.rate) for one in everything]),
        shot=np.stack([at(one.shot) for one in everything]),
        rest=np.stack([at(one.rest) for one in everything]),
        usable=np.stack([~at(one.clipped) for one in everything]),
        dark=at(shots.dark.rate),
        dark_variance=np.maximum(at(shots.dark.rest), LEAST_VARIANCE * at(shots.dark.shot) ** 2),
        exposure=np.array([shots.dark.exposure_s / one.exposure_s for one in everything]),
        shown=shots.shown.astype(np.float64),
        first=np.array([shots.crop.column, shots.crop.row]),
    )


def _window_places(
    term: Backscatter, seen: Evidence, corner: Int[Arrayish, "n 2"]
) -> tuple[Int[Array, "n window2"], Bool[Array, "n window2"]]:
    """Indices of each window's pixels in a row-major crop, and which of them lie inside it."""
    corner, first = jnp.asarray(corner), jnp.asarray(seen.first)
    crop_rows, crop_columns = jnp.shape(seen.shown)[1:3]
    span = jnp.arange(term.window)
    columns = corner[:, 0, None, None] - first[0] + span[None, None, :]
    rows = corner[:, 1, None, None] - first[1] + span[None, :, None]
    inside = (columns >= 0) & (columns < crop_columns) & (rows >= 0) & (rows < crop_rows)
    flat = jnp.clip(rows, 0, crop_rows - 1) * crop_columns + jnp.clip(columns, 0, crop_columns - 1)
    places = flat.reshape(len(flat), -1)
    return places, inside.reshape(places.shape)


def _gathered(
    term: Backscatter, seen: Evidence, corner: Int[Arrayish, "n 2"], shown: Float[Arrayish, "pictures rows columns 3"]
) -> tuple[Float[Array, "pictures n window2 3"], Bool[Array, "n window2"]]:
    """Picture values, 0 to 1, in each position's window, and which places lie inside the crop."""
    places, inside = _window_places(term, seen, corner)
    values = jnp.asarray(shown).reshape(len(shown), -1, 3)[:, places]
    return values / 255.0, inside


def light_ratios(
    term: Backscatter, seen: Evidence, corner: Int[Arrayish, "n 2"], shown: Float[Arrayish, "pictures rows columns 3"]
) -> Float[Array, "pictures 3 n"]:
    """Ratio of each picture's light to white's along the rays of the evidence, for pictures in its crop."""
    values, inside = _gathered(term, seen, corner, shown)
    shares = emitter_shares(term, seen.rays, corner) * inside[..., None]
    light = jnp.einsum("nwp,inwp->inp", shares, values**term.gamma)
    return _mixed_ratio(light, shares.sum(axis=1), jnp.asarray(term.mix))


def _mixed_ratio(
    light: Float[Array, "pictures n 3"], white: Float[Array, "n 3"], mix: Float[Array, "3 3"]
) -> Float[Array, "pictures 3 n"]:
    """Camera colours of primaries over those of white; as sums, see ``models.backscatter.mixed_colours``."""
    mixed = (light[..., None, :] * mix).sum(axis=-1)
    return jnp.moveaxis(mixed / jnp.maximum((white[:, None, :] * mix).sum(axis=-1), 1e-9), 1, 2)


@eqx.filter_jit
def log_values(
    template: Backscatter, seen: Evidence, corner: Int[Arrayish, "n 2"]
) -> Float[Array, "n 3 pictures window2"]:
    """Logarithms of the picture values in each position's window, which no step of a fit changes."""
    values, inside = _gathered(template, seen, corner, seen.shown)
    logs = jnp.where(values > 0, jnp.log(jnp.maximum(values, 1e-9)), _LOG_OF_BLACK)
    return jnp.transpose(jnp.where(inside[..., None], logs, _LOG_OF_BLACK), (1, 3, 0, 2))


def ratios_and_slopes(
    x: Float[Array, "18"],
    template: Backscatter,
    seen: Evidence,
    corner: Int[Arrayish, "n 2"],
    logs: Float[Array, "n 3 pictures window2"],
) -> tuple[Float[Array, "shots 3 n"], Float[Array, "18 shots 3 n"]]:
    """Ratios of all shots, white first, and their slopes by the parameters.

    Only the shares depend on where the footprints lie and only the light on gamma: each is differentiated by itself
    before the two meet in the large sum over panel pixels.
    """
    inside = _window_places(template, seen, corner)[1]

    def shares_of(vector: Array) -> Array:
        return emitter_shares(with_vector(template, vector), seen.rays, corner) * inside[..., None]

    shares, share_slope = shares_of(x), jax.jacfwd(lambda part: shares_of(x.at[PLACES].set(part)))(x[PLACES])
    light = jnp.exp(x[0] * logs)
    both = jnp.einsum("nwpk,npiw->kinp", jnp.concatenate([shares[..., None], share_slope], axis=-1), light)
    by_gamma = jnp.einsum("nwp,npiw->inp", shares, light * logs)
    white, white_slope = shares.sum(axis=1), share_slope.sum(axis=1)
    mix, mix_slope = mix_of(x), jax.jacfwd(mix_of)(x)
    light_way = jnp.zeros((len(x), *by_gamma.shape)).at[0].set(by_gamma).at[PLACES].set(both[1:])
    white_way = jnp.zeros((len(x), *white.shape)).at[PLACES].set(jnp.moveaxis(white_slope, -1, 0))

    def along(light_part: Array, white_part: Array, mix_part: Array) -> tuple[Array, Array]:
        return jax.jvp(_mixed_ratio, (both[0], white, mix), (light_part, white_part, mix_part))

    ratio, slope = jax.vmap(along, out_axes=(None, 0))(light_way, white_way, jnp.moveaxis(mix_slope, -1, 0))
    ones = jnp.ones_like(jnp.asarray(seen.light)[:1])
    return jnp.concatenate([ones, ratio]), jnp.concatenate([jnp.zeros((len(x), *ones.shape)), slope], axis=1)


def shot_ratios(term: Backscatter, seen: Evidence, corner: Int[Arrayish, "n 2"]) -> Float[Array, "shots 3 n"]:
    """Ratios of all shots, white first."""
    pictures = light_ratios(term, seen, corner, seen.shown)
    return jnp.concatenate([jnp.ones_like(jnp.asarray(seen.light)[:1]), pictures])


def profiled(ratio: Float[Arrayish, "shots 3 n"], seen: Evidence, weight: Float[Arrayish, "shots 3 n"]) -> Profiled:
    """Mask and dark signal by weighted linear least squares, bin by bin."""
    square = jnp.asarray(weight) ** 2
    apart = jnp.asarray(seen.exposure)[:, None, None]
    sure = 1 / jnp.asarray(seen.dark_variance)
    own, cross = (square * ratio**2).sum(0), (square * ratio * apart).sum(0)
    rest = (square * apart**2).sum(0) + sure
    light = square * seen.light
    by_ratio, by_dark = (light * ratio).sum(0), (light * apart).sum(0) + sure * seen.dark
    information = own - cross**2 / rest
    known = information > 0
    mask = jnp.where(known, (by_ratio - cross * by_dark / rest) / jnp.where(known, information, 1.0), 0.0)
    return Profiled(mask, (by_dark - cross * mask) / rest, information)


def whitened(
    ratio: Float[Array, "shots 3 n"],
    slope: Float[Array, "k shots 3 n"],
    seen: Evidence,
    weight: Float[Arrayish, "shots 3 n"],
) -> tuple[Float[Array, "shots_1 3 n"], Float[Array, "k shots_1 3 n"]]:
    """Errors of shots and dark in units of their sigma, and their slopes, off what mask and dark can take up.

    With m and d held at their best, the slope by the ratios alone is projected; the errors are at right angles to m
    and d already (Kaufman, BIT 15, 1975). J^T J is then the information of the profiled likelihood.
    """
    best = profiled(ratio, seen, weight)
    apart, sure = jnp.asarray(seen.exposure)[:, None, None], 1 / jnp.sqrt(jnp.asarray(seen.dark_variance))
    bright = (seen.light - best.mask * ratio - apart * best.dark) * weight
    errors = jnp.concatenate([bright, ((seen.dark - best.dark) * sure)[None]])
    nothing = jnp.zeros_like(sure)[None]
    dark_way = _unit(jnp.concatenate([apart * weight, sure[None]]))
    mask_way = jnp.concatenate([ratio * weight, nothing])
    mask_way = _unit(mask_way - dark_way * (dark_way * mask_way).sum(0))
    by_ratio = jnp.concatenate([-best.mask * slope * weight, jnp.zeros((len(slope), *nothing.shape))], axis=1)
    for way in (dark_way, mask_way):
        by_ratio = by_ratio - way * (way * by_ratio).sum(1, keepdims=True)
    return errors, by_ratio


def _unit(vectors: Float[Array, "shots_1 3 n"]) -> Float[Array, "shots_1 3 n"]:
    square = (vectors**2).sum(0)
    return vectors / jnp.sqrt(jnp.where(square > 0, square, 1.0))


@eqx.filter_jit
def linearised(
    x: Float[Arrayish, "18"],
    template: Backscatter,
    corner: Int[Arrayish, "n 2"],
    seen: Evidence,
    weight: Float[Arrayish, "shots 3 n"],
    logs: Float[Array, "n 3 pictures window2"],
) -> tuple[Float[Array, " m"], Float[Array, "m 18"]]:
    """Whitened errors at ``x`` and their slopes; ``logs`` is of ``log_values``."""
    ratio, slope = ratios_and_slopes(jnp.asarray(x), template, seen, corner, logs)
    errors, by_ratio = whitened(ratio, slope, seen, weight)
    return errors.ravel(), by_ratio.reshape(len(by_ratio), -1).T


@in_float64
def solve(
    template: Backscatter,
    seen: Evidence,
    weight: Float[np.ndarray, "shots 3 n"],
    order: Order,
    prior: Prior,
    start: Float[np.ndarray, "18"],
    corner: Int[np.ndarray, "n 2"],
) -> Fitted:
    """The most probable parameters of an order at given weights; ``corner`` is the window of each position."""
    logs = log_values(template, seen, corner)

    def at(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        errors, slopes = linearised(x, template, corner, seen, weight, logs)
        return np.asarray(errors), np.asarray(slopes)

    solution = most_probable(at, order.start(start, prior), order.free > 0, prior.mean, prior.sigma)
    return fitted_at(template, seen, weight, solution, corner)


@in_float64
def fitted_at(
    template: Backscatter,
    seen: Evidence,
    weight: Float[np.ndarray, "shots 3 n"],
    solution: Solution,
    corner: Int[np.ndarray, "n 2"],
) -> Fitted:
    """A solution with its mask and errors at given weights."""
    ratio, best = (jax.tree.map(np.asarray, part) for part in _described(template, solution.x, seen, weight, corner))
    apart = np.asarray(seen.exposure)[:, None, None]
    errors = np.asarray(seen.light) - best.mask * ratio - apart * best.dark
    return Fitted(solution, corner, ratio, best.mask, errors, np.asarray(seen.dark) - best.dark, weight)


@eqx.filter_jit
def _described(
    template: Backscatter,
    x: Float[Arrayish, "18"],
    seen: Evidence,
    weight: Float[Arrayish, "shots 3 n"],
    corner: Int[Arrayish, "n 2"],
) -> tuple[Float[Array, "shots 3 n"], Profiled]:
    ratio = shot_ratios(with_vector(template, jnp.asarray(x)), seen, corner)
    return ratio, profiled(ratio, seen, weight)


def weights(
    seen: Evidence,
    rate: Float[np.ndarray, "shots 3 n"],
    mask: Float[np.ndarray, "3 n"],
    share: float,
    usable: Bool[np.ndarray, "shots 3 n"],
) -> Float[np.ndarray, "shots 3 n"]:
    """1 / sigma of every sample at a modelled rate; ``share`` of the mask is what the model leaves undescribed."""
    shot = np.asarray(seen.shot)
    variance = np.maximum(shot * np.maximum(rate, 0.0) + np.asarray(seen.rest), LEAST_VARIANCE * shot**2)
    # White is the mask by definition: the model takes no part in it.
    variance[1:] += (share * mask) ** 2
    return np.where(usable, 1 / np.sqrt(variance), 0.0)


def weights_to_start(seen: Evidence) -> Float[np.ndarray, "shots 3 n"]:
    """Weights by what was measured, one electron on the safe side."""
    light = np.asarray(seen.light) - np.asarray(seen.exposure)[:, None, None] * np.asarray(seen.dark)
    nothing = np.zeros(light.shape[1:])
    return weights(seen, np.maximum(light, 0.0) + np.asarray(seen.shot), nothing, 0.0, np.asarray(seen.usable))


def chi2_of(fitted: Fitted, seen: Evidence) -> float:
    """Sum of squared errors in sigma, of shots and dark, the prior left out."""
    return float((fitted.z**2).sum() + (fitted.dark_errors**2 / np.asarray(seen.dark_variance)).sum())


def degrees_of_freedom(weight: Float[np.ndarray, "shots 3 n"], parameters: float) -> float:
    """Samples less one mask per bin (the dark signal has a sample of its own) less parameters."""
    used = weight > 0
    return max(float(used.sum() - used.any(axis=0).sum()) - parameters, 1.0)
