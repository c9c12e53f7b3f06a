"""The backscatter term as a vector of parameters: coordinates, what is known beforehand, and orders.

Lengths, softness, reflection and crosstalk cannot be negative: the solver sees their logarithms. The prior is normal in
the solver's coordinates: nominal values with the tolerances of the rig, and wide where no data sheet says anything.
The light is close to linear in other coordinates (``linear_of``), in which orders with and without a part can be mixed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from udccal.fitting.engine.gaussian import Prior
from udccal.models.backscatter import Backscatter
from udccal.rig import RigDescription

Vector = Float[np.ndarray, "18"]
NAMES = (
    "gamma", "standoff_mm", "pupil_diameter_mm", "softness_px", "reflection", "reflection_mm",
    "offset_x_px", "offset_y_px", "red_x_px", "red_y_px",
    "blue_x_px", "blue_y_px", "mix_rg", "mix_rb", "mix_gr", "mix_gb", "mix_br", "mix_bg",
)  # fmt: skip
UNITS = ("1", "mm", "mm", "px", "1", "mm", *["px"] * 6, *["1"] * 6)
DISTANCE, PUPIL, SOFTNESS, REFLECTION, DEPTH = range(1, 6)
# Of the green emitters from the centres of their pixels, and of red and blue from green; crosstalk.
OFFSET, EMITTERS, MIX = slice(6, 8), slice(8, 12), slice(12, 18)
# Those that tell where footprints lie and how they look.
PLACES = slice(1, 12)
_LOGARITHMIC = np.array([1, 2, 3, 4, 5, 12, 13, 14, 15, 16, 17])
_LENGTHS_BY_PITCH = [DISTANCE, PUPIL, DEPTH]
# Stands for the logarithm of nothing.
_ABSENT = -40.0
_MOST_REFLECTED = 1 - 1e-9
_OFF_DIAGONAL = (np.array([0, 0, 1, 1, 2, 2]), np.array([1, 2, 0, 2, 0, 1]))
_SOFTNESS_PX, _CROSSTALK = 0.15, 0.1
# Light by way of the glass over light straight from the emitters: of what these send forwards, the outer face reflects
# 4 % (Fresnel, index 1.5), and a part that no data sheet states leaks past their opaque backs. That part is taken to be
# 4 %, too, give or take a factor of e: from 1.5 to 11 % within one sigma. Two sigma hold a leak of half a per cent on
# one side, and a coated face, which reflects a tenth as much, on the other.
_REFLECTION, _REFLECTION_LN_SIGMA = 1.0, 1.0
# -2 ln(1 / 2)
_ODDS_AGAINST = 1.4


@final
@dataclass(frozen=True)
class Order:
    """What a candidate leaves free: the others are held."""

    name: str
    free: Bool[np.ndarray, "18"]

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
        return float((~self.free[[REFLECTION, EMITTERS.start, MIX.start]]).sum()) * _ODDS_AGAINST

    def start(self, x: Vector, prior: Prior) -> Vector:
        """``x`` with the held parameters at where this order has them."""
        held = prior.mean.copy()
        held[EMITTERS] = 0.0
        if not self.free[MIX].any():
            held[MIX] = _ABSENT
        if not self.free[REFLECTION]:
            held[REFLECTION] = _ABSENT
        return np.where(self.free, np.where(x <= _ABSENT, prior.mean, x), held)

    def without_crosstalk(self) -> Order:
        """The same where every camera colour sees its own primary only."""
        return _order(f"{self.name}, no crosstalk", self.free, MIX)


def _order(name: str, free: Bool[np.ndarray, "18"], *held: int | slice) -> Order:
    free = free.copy()
    for one in held:
        free[one] = False
    return Order(name, free)


TWO_PLANES = Order("two planes", np.ones(len(NAMES), dtype=bool))
ONE_PLANE = _order("one plane", TWO_PLANES.free, REFLECTION, DEPTH)
# Simplest first.
KERNELS = (_order("one plane, primaries in one place", ONE_PLANE.free, EMITTERS), ONE_PLANE, TWO_PLANES)


def split_plane(x: Vector, prior: Prior, reflection: float) -> Vector:
    """One plane's parameters with a reflection added: the two planes' light comes from where the one's came from."""
    split = x.copy()
    split[REFLECTION], split[DEPTH] = np.log(reflection), prior.mean[DEPTH]
    between = np.exp(x[DISTANCE]) - np.exp(split[DEPTH]) * reflection / (1 + reflection)
    split[DISTANCE] = np.log(between) if between > 0 else x[DISTANCE]
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
    """What the rig's description says about every parameter, in the solver's coordinates."""
    panel, lens, mounting = rig.panel, rig.lens, rig.mounting
    depth = 2 * panel.glass_thickness_mm / panel.glass_index
    lengths = [
        mounting.standoff_mm.value,
        rig.pupil_diameter_mm * footprint_share(rig),
        _SOFTNESS_PX,
        _REFLECTION,
        depth,
    ]
    pupil = lens.focal_mm.tolerance / lens.focal_mm.value + lens.f_number.tolerance / lens.f_number.value + 0.02
    distance = (mounting.standoff_mm.tolerance + 0.1) / mounting.standoff_mm.value
    mean = np.concatenate([[panel.gamma.value], np.log(lengths), np.zeros(6), np.full(6, np.log(_CROSSTALK))])
    scales = [panel.gamma.tolerance + 0.02, distance, pupil, 0.7, _REFLECTION_LN_SIGMA, 0.3]
    sigma = np.concatenate([scales, offset_reach_px(rig), np.full(4, 0.3), np.full(6, 0.7)])
    return Prior.independent(mean, sigma)


def values_of(x: Vector) -> Vector:
    """The parameters in the units of ``UNITS``, lengths for the nominal pitch, the pupil as its footprint."""
    values = np.array(x, dtype=np.float64)
    logarithms = values[_LOGARITHMIC]
    values[_LOGARITHMIC] = np.where(logarithms > _ABSENT, np.exp(logarithms), 0.0)
    return values


@final
@dataclass(frozen=True)
class Moments:
    """Mean and covariance of the values, in the units of ``UNITS``."""

    mean: Vector
    cov: Float[np.ndarray, "18 18"]

    @classmethod
    def log_normal(cls, x: Vector, cov: Float[np.ndarray, "18 18"]) -> Moments:
        """Where the solver's coordinates are normal."""
        logarithmic = np.isin(np.arange(len(NAMES)), _LOGARITHMIC)
        mean = values_of(x)
        mean[logarithmic] *= np.exp(0.5 * np.diag(cov)[logarithmic])
        scale = np.where(logarithmic, mean, 1.0)
        both = np.outer(logarithmic, logarithmic)
        return cls(mean, np.outer(scale, scale) * np.where(both, np.expm1(cov), cov))

    @classmethod
    def mixture(cls, parts: Sequence[Moments], weights: Float[np.ndarray, " parts"]) -> Moments:
        """The covariance of each part, and how their means differ."""
        mean = np.einsum("p,pk->k", weights, np.stack([one.mean for one in parts]))
        off = np.stack([one.mean for one in parts]) - mean
        within = np.einsum("p,pkl->kl", weights, np.stack([one.cov for one in parts]))
        return cls(mean, within + np.einsum("p,pk,pl->kl", weights, off, off))


def pitch_error(values: Vector, rig: RigDescription) -> Vector:
    """By how much each value moves with one sigma of the pitch: pictures tell lengths in panel pixels only."""
    pitch = rig.panel.pitch_mm
    moved = np.zeros(len(NAMES))
    moved[_LENGTHS_BY_PITCH] = values[_LENGTHS_BY_PITCH] * pitch.tolerance / pitch.value
    return moved


def linear_of(x: Vector) -> Vector:
    """The parameters with the reflected share of all light, and crosstalk, for their logarithms: 0 where absent."""
    theta, values = np.array(x, dtype=np.float64), values_of(x)
    theta[REFLECTION] = values[REFLECTION] / (1 + values[REFLECTION])
    theta[MIX] = values[MIX]
    return theta


def vector_of(term: Backscatter) -> Vector:
    """The solver's coordinates of a term, whose logarithms have 1e-6 for what is absent."""
    emitters, mix = np.asarray(term.emitters_px), np.asarray(term.mix)
    lengths = (term.standoff_mm, term.pupil_diameter_mm, term.softness_px, term.reflection, term.reflection_mm)
    places = (emitters[1], emitters[0] - emitters[1], emitters[2] - emitters[1])
    crosstalk = (mix / np.diag(mix)[:, None])[_OFF_DIAGONAL]
    x = np.concatenate([[float(np.asarray(one)) for one in (term.gamma, *lengths)], *places, crosstalk])
    x[_LOGARITHMIC] = np.log(np.maximum(x[_LOGARITHMIC], 1e-6))
    return x


def linear_slope(x: Vector) -> Vector:
    """Derivative of each of ``linear_of`` by the solver's coordinate."""
    theta, slope = linear_of(x), np.ones(len(NAMES))
    slope[REFLECTION] = theta[REFLECTION] * (1 - theta[REFLECTION])
    slope[MIX] = theta[MIX]
    return slope


def with_linear(term: Backscatter, theta: Float[Array, "18"]) -> Backscatter:
    """The term with parameters of ``linear_of``."""
    offset = theta[OFFSET]
    emitters = jnp.stack([offset + theta[8:10], offset, offset + theta[10:12]])
    distance, pupil, softness, _, depth = jnp.exp(theta[1:6])
    reflected = jnp.minimum(theta[REFLECTION], _MOST_REFLECTED)
    mix = jnp.eye(3, dtype=theta.dtype).at[_OFF_DIAGONAL].set(theta[MIX])
    return eqx.tree_at(
        lambda t: (
            t.gamma, t.standoff_mm, t.pupil_diameter_mm, t.softness_px, t.reflection, t.reflection_mm, t.emitters_px,
            t.mix,
        ),
        term,
        (
            theta[0], distance, pupil, softness, reflected / (1 - reflected), depth, emitters,
            mix / mix.sum(axis=1, keepdims=True),
        ),
    )  # fmt: skip


def mix_and_jacobian(theta: Vector) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "6 3 3"]]:
    """Camera colour from primary, rows sum to 1, and its derivatives by the crosstalk."""
    row, column = _OFF_DIAGONAL
    mix, jacobian, each = np.eye(3), np.zeros((6, 3, 3)), np.arange(6)
    mix[row, column] = theta[MIX]
    whole = mix.sum(axis=1)
    mix = mix / whole[:, None]
    jacobian[each, row] = -mix[row] / whole[row, None]
    jacobian[each, row, column] += 1 / whole[row]
    return mix, jacobian
