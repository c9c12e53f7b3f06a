"""The backscatter term as a vector of parameters: coordinates of the solver, what is known beforehand, and orders.

Lengths, softness, reflection and crosstalk cannot be negative: the solver sees their logarithms. The prior is normal in
the solver's coordinates: nominal values with the tolerances of the rig, and wide where no data sheet says anything.
"""

from __future__ import annotations

from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from udccal.models.backscatter import Backscatter
from udccal.rig import RigDescription

NAMES = (
    "gamma", "distance_mm", "pupil_mm", "softness_px", "reflection", "reflection_mm", "offset_x_px", "offset_y_px",
    "red_x_px", "red_y_px", "blue_x_px", "blue_y_px", "mix_rg", "mix_rb", "mix_gr", "mix_gb", "mix_br", "mix_bg",
)  # fmt: skip
UNITS = ("1", "mm", "mm", "px", "1", "mm", *["px"] * 6, *["1"] * 6)
# Distance, pupil, softness, reflection and its depth; crosstalk.
_LOGARITHMIC = np.array([1, 2, 3, 4, 5, 12, 13, 14, 15, 16, 17])
_LENGTHS_BY_PITCH = [1, 2, 5]
# Stands for the logarithm of nothing.
_ABSENT = -40.0
_DISTANCE, REFLECTION, _DEPTH, CROSSTALK = 1, 4, 5, slice(12, 18)
# Of the green emitters from the centres of their pixels, and of red and blue from green.
OFFSET, EMITTERS = slice(6, 8), slice(8, 12)
# Those that tell where footprints lie and how they look.
PLACES = slice(1, 12)
_OFF_DIAGONAL = (np.array([0, 0, 1, 1, 2, 2]), np.array([1, 2, 0, 2, 0, 1]))
_SOFTNESS_PX, _CROSSTALK = 0.15, 0.1
# Light by way of the glass over light straight from the emitters: of what these send forwards, the outer face reflects
# 4 % (Fresnel, index 1.5), and a part that no data sheet states leaks past their opaque backs. That part is taken to be
# 4 %, too, give or take a factor of e: from 1.5 to 11 % within one sigma. Two sigma hold a leak of half a per cent on
# one side, and a coated face, which reflects a tenth as much, on the other.
_REFLECTION, _REFLECTION_LN_SIGMA = 1.0, 1.0
# -2 ln(1 / 2)
_ODDS_AGAINST = 1.4


@dataclass(frozen=True)
class Prior:
    """Mean and sigma of every parameter in the solver's coordinates."""

    mean: Float[np.ndarray, "18"]
    sigma: Float[np.ndarray, "18"]


@dataclass(frozen=True)
class Order:
    """What a candidate leaves free: ``free`` is 1 for parameters that are fitted, 0 for those held."""

    name: str
    free: Float[np.ndarray, "18"]

    @property
    def parameters(self) -> int:
        """How many are fitted."""
        return int(self.free.sum())

    @property
    def against(self) -> float:
        """-2 ln of how likely this order is beforehand, against one that leaves everything free.

        Panels have a cover glass, their primaries lie side by side and cameras' colours overlap: an order that does
        without one of these has to be twice as good.
        """
        without = (~self.free[[REFLECTION, EMITTERS.start, CROSSTALK.start]].astype(bool)).sum()
        return float(without) * _ODDS_AGAINST

    def held(self) -> tuple[str, ...]:
        """Names of the parameters that are not fitted."""
        return tuple(name for name, one in zip(NAMES, self.free, strict=True) if not one)

    def start(self, x: Float[np.ndarray, "18"], prior: Prior) -> Float[np.ndarray, "18"]:
        """``x`` with the held parameters at where this order has them."""
        neutral = prior.mean.copy()
        neutral[EMITTERS] = 0.0
        if not self.free[CROSSTALK].any():
            neutral[CROSSTALK] = _ABSENT
        if not self.free[REFLECTION]:
            neutral[REFLECTION] = _ABSENT
        begun = np.where((self.free > 0) & (x <= _ABSENT), prior.mean, x)
        return np.where(self.free > 0, begun, neutral)


def _kernel(name: str, *held: int) -> Order:
    free = np.ones(len(NAMES))
    free[list(held)] = 0.0
    return Order(name, free)


ONE_PLANE = _kernel("one plane", REFLECTION, _DEPTH)
TWO_PLANES = _kernel("two planes")
# Simplest first.
KERNELS = (
    _kernel("one plane, primaries in one place", REFLECTION, _DEPTH, 8, 9, 10, 11),
    ONE_PLANE,
    TWO_PLANES,
)


def without_crosstalk(order: Order) -> Order:
    """The same kernel where every camera colour sees its own primary only."""
    free = order.free.copy()
    free[CROSSTALK] = 0.0
    return Order(f"{order.name}, no crosstalk", free)


def split_plane(x: Float[np.ndarray, "18"], prior: Prior, reflection: float) -> Float[np.ndarray, "18"]:
    """One plane's parameters with a reflection added: the two planes' light comes from where the one's came from."""
    split = x.copy()
    depth = np.exp(prior.mean[_DEPTH])
    split[REFLECTION], split[_DEPTH] = np.log(reflection), prior.mean[_DEPTH]
    between = np.exp(x[_DISTANCE]) - depth * reflection / (1 + reflection)
    split[_DISTANCE] = np.log(between) if between > 0 else x[_DISTANCE]
    return split


def offset_reach_px(rig: RigDescription) -> Float[np.ndarray, "2"]:
    """How far the pupil may be from its nominal panel pixel: the mounting's tolerance, and pitches that add up."""
    mounting, pitch = rig.mounting, rig.panel.pitch_mm
    stretch = pitch.tolerance / pitch.value
    return np.array(
        [place.tolerance + place.value * stretch + 0.5 for place in (mounting.panel_x_px, mounting.panel_y_px)]
    )


def footprint_share(rig: RigDescription) -> float:
    """Diameter of the pupil's footprint on the panel over that of the pupil: rays converge towards the focus."""
    return 1.0 - rig.mounting.standoff_mm.value / rig.lens.focus_mm


def prior_of(rig: RigDescription) -> Prior:
    """What the rig's description says about every parameter."""
    panel, lens, mounting = rig.panel, rig.lens, rig.mounting
    depth = 2 * panel.glass_thickness_mm / panel.glass_index
    lengths = [mounting.standoff_mm.value, rig.pupil_mm * footprint_share(rig), _SOFTNESS_PX, _REFLECTION, depth]
    pupil = lens.focal_mm.tolerance / lens.focal_mm.value + lens.f_number.tolerance / lens.f_number.value + 0.02
    distance = (mounting.standoff_mm.tolerance + 0.1) / mounting.standoff_mm.value
    mean = np.concatenate([[panel.gamma.value], np.log(lengths), np.zeros(6), np.full(6, np.log(_CROSSTALK))])
    scales = [panel.gamma.tolerance + 0.02, distance, pupil, 0.7, _REFLECTION_LN_SIGMA, 0.3]
    return Prior(mean, np.concatenate([scales, offset_reach_px(rig), np.full(4, 0.3), np.full(6, 0.7)]))


def values_of(x: Float[np.ndarray, "18"]) -> Float[np.ndarray, "18"]:
    """The parameters in the units of ``UNITS``, lengths for the nominal pitch, the pupil as its footprint."""
    values = np.array(x, dtype=np.float64)
    logarithms = values[_LOGARITHMIC]
    values[_LOGARITHMIC] = np.where(logarithms > _ABSENT, np.exp(logarithms), 0.0)
    return values


@dataclass(frozen=True)
class Moments:
    """Mean and covariance of the values, in the units of ``UNITS``."""

    mean: Float[np.ndarray, "18"]
    cov: Float[np.ndarray, "18 18"]


def moments_of(x: Float[np.ndarray, "18"], cov: Float[np.ndarray, "18 18"]) -> Moments:
    """Of the values where the solver's coordinates are normal: those of a logarithm are log-normal."""
    logarithmic = np.zeros(len(NAMES), dtype=bool)
    logarithmic[_LOGARITHMIC] = True
    mean = values_of(x)
    mean[logarithmic] *= np.exp(0.5 * np.diag(cov)[logarithmic])
    scale = np.where(logarithmic, mean, 1.0)
    both = np.outer(logarithmic, logarithmic)
    return Moments(mean, np.outer(scale, scale) * np.where(both, np.expm1(cov), cov))


def moments_over(parts: list[Moments], weights: Float[np.ndarray, " parts"]) -> Moments:
    """Of a mixture: the covariance of each part, and how their means differ."""
    mean = np.einsum("p,pk->k", weights, np.stack([one.mean for one in parts]))
    off = np.stack([one.mean for one in parts]) - mean
    within = np.einsum("p,pkl->kl", weights, np.stack([one.cov for one in parts]))
    return Moments(mean, within + np.einsum("p,pk,pl->kl", weights, off, off))


def pitch_share(values: Float[np.ndarray, "18"], rig: RigDescription) -> Float[np.ndarray, "18"]:
    """By how much each value moves with one sigma of the pitch: pictures tell lengths in panel pixels only."""
    pitch = rig.panel.pitch_mm
    share = np.zeros(len(NAMES))
    share[_LENGTHS_BY_PITCH] = values[_LENGTHS_BY_PITCH] * pitch.tolerance / pitch.value
    return share


def with_vector(term: Backscatter, x: Float[Array, "18"]) -> Backscatter:
    """The term with the values of a parameter vector."""
    common = x[6:8]
    emitters = jnp.stack([common + x[8:10], common, common + x[10:12]])
    distance, pupil, softness, reflection, depth = jnp.exp(x[1:6])
    return eqx.tree_at(
        lambda t: (
            t.gamma, t.distance_mm, t.pupil_mm, t.softness_px, t.reflection, t.reflection_mm, t.emitters_px, t.mix
        ),
        term,
        (x[0], distance, pupil, softness, reflection, depth, emitters, mix_of(x)),
    )  # fmt: skip


def mix_of(x: Float[Array, "18"]) -> Float[Array, "3 3"]:
    """Camera colour from primary; rows sum to 1."""
    mix = jnp.eye(3, dtype=x.dtype).at[_OFF_DIAGONAL].set(jnp.exp(x[CROSSTALK]))
    return mix / mix.sum(axis=1, keepdims=True)


def mix_and_slopes(x: Float[np.ndarray, "18"]) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "6 3 3"]]:
    """``mix_of`` and its slopes by the crosstalk parameters."""
    crosstalk, each = np.exp(x[CROSSTALK]), np.arange(6)
    mix = np.eye(3)
    mix[_OFF_DIAGONAL] = crosstalk
    row, column = _OFF_DIAGONAL
    scale = crosstalk / mix.sum(axis=1)[row]
    mix = mix / mix.sum(axis=1, keepdims=True)
    slopes = np.zeros((6, 3, 3))
    slopes[each, row] = -mix[row] * scale[:, None]
    slopes[each, row, column] += scale
    return mix, slopes
