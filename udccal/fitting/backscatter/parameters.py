"""The backscatter term as a vector of parameters: coordinates, prior, orders, and the documented constants of its fit.

Lengths, softness, reflection and crosstalk cannot be negative: the solver works on their logarithms. The prior is
normal in the solver's coordinates: nominal values with the tolerances of the rig, and wide where no data sheet helps.
Light is close to linear in other coordinates (``linear_of``), in which orders with and without a part can be mixed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import final

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from udccal.fitting.engine.gaussian import Prior
from udccal.fitting.engine.least_squares import SolverRules
from udccal.models.backscatter import Backscatter
from udccal.rig import RigDescription

Vector = Float[np.ndarray, "18"]
NAMES = (
    "gamma", "standoff_mm", "pupil_diameter_mm", "softness_px", "reflection", "reflection_mm",
    "offset_x_px", "offset_y_px", "red_x_px", "red_y_px", "blue_x_px", "blue_y_px",
    "mix_rg", "mix_rb", "mix_gr", "mix_gb", "mix_br", "mix_bg",
)  # fmt: skip
UNITS = ("1", "mm", "mm", "px", "1", "mm", *["px"] * 6, *["1"] * 6)
DISTANCE, PUPIL, SOFTNESS, REFLECTION, DEPTH = range(1, 6)
# Of the green emitters from the centres of their pixels, and of red and blue from green; crosstalk. PLACES are the
# parameters that say where footprints lie and how they look.
OFFSET, EMITTERS, MIX, PLACES = slice(6, 8), slice(8, 12), slice(12, 18), slice(1, 12)
# Rows and columns of the crosstalk in the mix.
OFF_DIAGONAL = np.nonzero(~np.eye(3, dtype=bool))
_LOGARITHMIC = np.isin(np.arange(18), np.r_[1:6, 12:18])
# In place of the logarithm of 0.
_ABSENT = -40.0


@final
@dataclass(frozen=True)
class BackscatterRules:
    """What a backscatter fit looks at, what it leaves out, and when it is content.

    Attributes:
        positions: places on the sensor that the footprint is fitted at.
        fewest_pictures: beside white and dark.
        clipped: fraction of saturation from which a mean counts as clipped.
        most_clipped: a shot with a larger fraction of clipped bins is left out whole; of others, the clipped bins are.
        visible_sigma, present_sigma: white that is below this many sigma of a bin at the 90th percentile of bins, or of
            all bins together, is no light.
        slack_px: room that a window of panel pixels leaves for the footprint to move during a fit.
        most_wider: a fit whose footprints need a window this many times as wide has gone astray.
        first_error: model error, as a fraction of white, that a fit from far away is taken to have.
        settled: such a fit goes on while its model error shrinks by more than this factor.
        reflections: light of the second plane over that of the first, where fits of two planes start. Where the farther
            one is the brighter, a fit that begins with the nearer one brighter may end at its mirror image.
        worse_pictures: a picture described so many times worse than the others does not belong.
        nothing_fits: model error, as a fraction of white, from which orders are not compared.
        held_out: every so-manyth picture is predicted by a fit without it.
        cells: residuals are averaged over so many parts of the sensor, across and down, in search of a pattern.
        worst_error: of held-out pictures, noise apart, as a fraction of their peak.
        undetermined: sigma of where footprints lie, over that of the prior, from which pictures say too little, ...
        known: ... unless it is as well known as this: ln of distance and pupil, offsets in panel pixels.
        steady: variance between frames of a picture, over noise, from which the panel may flicker.
        most_outliers: fraction of the pictures.
        solver: of every descent.
    """

    positions: int = 96
    fewest_pictures: int = 6
    clipped: float = 0.98
    most_clipped: float = 0.02
    visible_sigma: float = 2.0
    present_sigma: float = 5.0
    slack_px: float = 0.7
    most_wider: float = 3.0
    first_error: float = 0.3
    settled: float = 0.7
    reflections: tuple[float, ...] = (4.0, 1.0, 0.2)
    worse_pictures: float = 4.0
    nothing_fits: float = 0.05
    held_out: int = 4
    cells: int = 3
    worst_error: float = 0.05
    undetermined: float = 0.5
    known: tuple[float, float, float, float] = (0.1, 0.1, 0.5, 0.5)
    steady: float = 1.3
    most_outliers: float = 0.25
    solver: SolverRules = field(default_factory=lambda: SolverRules(iterations=60))


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
        return float((~self.free[[REFLECTION, EMITTERS.start, MIX.start]]).sum() * 2 * np.log(2.0))

    def start(self, x: Vector, prior: Prior) -> Vector:
        """``x`` with the held parameters at where this order has them."""
        held = prior.mean.copy()
        held[EMITTERS], held[REFLECTION], held[MIX] = 0.0, _ABSENT, _ABSENT
        return np.where(self.free, np.where(x <= _ABSENT, prior.mean, x), held)

    def without(self, name: str, *held: int | slice) -> Order:
        """The same with more parameters held."""
        free = self.free.copy()
        for one in held:
            free[one] = False
        return Order(name, free)

    def without_crosstalk(self) -> Order:
        """The same where every camera colour sees its own primary only."""
        return self.without(f"{self.name}, no crosstalk", MIX)


TWO_PLANES = Order("two planes", np.ones(len(NAMES), dtype=bool))
ONE_PLANE = TWO_PLANES.without("one plane", REFLECTION, DEPTH)
# Simplest first.
KERNELS = (ONE_PLANE.without("one plane, primaries in one place", EMITTERS), ONE_PLANE, TWO_PLANES)


def split_plane(x: Vector, prior: Prior, reflection: float) -> Vector:
    """One plane's parameters with a reflection added: the two planes' light comes from where the one's came from."""
    split = x.copy()
    split[REFLECTION], split[DEPTH] = np.log(reflection), prior.mean[DEPTH]
    between = np.exp(x[DISTANCE]) - np.exp(split[DEPTH]) * reflection / (1 + reflection)
    split[DISTANCE] = np.log(between) if between > 0 else x[DISTANCE]
    return split


def footprint_per_pupil(rig: RigDescription) -> float:
    """Diameter of the pupil's footprint on the panel over that of the pupil: rays converge towards the focus."""
    return 1.0 - rig.mounting.standoff_mm.value / rig.lens.focus_mm


def prior_of(rig: RigDescription) -> Prior:
    """Return the prior that the rig's description gives every parameter, in the solver's coordinates.

    ``reflection`` is the light by way of the glass over the light straight from the emitters. The outer face reflects
    4 % of the light that emitters send forwards (Fresnel, index 1.5). A fraction that no data sheet gives leaks past
    their opaque backs. The prior assumes 4 % for this leak, too, with a sigma of a factor of e: 1.5 to 11 %. Two sigma
    include a leak of half a per cent on one side, and a coated face, which reflects a tenth as much, on the other.

    Args:
        rig: gives the values (mean) and their tolerances (sigma), in the units of ``UNITS``.
    """
    panel, lens, mounting = rig.panel, rig.lens, rig.mounting
    standoff, pitch = mounting.standoff_mm, panel.pitch_mm
    depth = 2 * panel.glass_thickness_mm / panel.glass_index
    softness_px, reflection, crosstalk = 0.15, 1.0, 0.1
    lengths = [standoff.value, rig.pupil_diameter_mm * footprint_per_pupil(rig), softness_px, reflection, depth]
    pupil = lens.focal_mm.tolerance / lens.focal_mm.value + lens.f_number.tolerance / lens.f_number.value + 0.02
    mean = np.concatenate([[panel.gamma.value], np.log(lengths), np.zeros(6), np.full(6, np.log(crosstalk))])
    scales = [panel.gamma.tolerance + 0.02, (standoff.tolerance + 0.1) / standoff.value, pupil, 0.7, 1.0, 0.3]
    # How far the pupil may be from its nominal panel pixel: the mounting's tolerance, and pitches that add up.
    offset = [
        place.tolerance + place.value * pitch.tolerance / pitch.value + 0.5
        for place in (mounting.panel_x_px, mounting.panel_y_px)
    ]
    return Prior.independent(mean, np.concatenate([scales, offset, np.full(4, 0.3), np.full(6, 0.7)]))


def values_of(x: Vector) -> Vector:
    """Return the parameters in the units of ``UNITS``: lengths at the nominal pitch, the footprint for the pupil."""
    with np.errstate(over="ignore"):
        return np.where(_LOGARITHMIC, np.where(x > _ABSENT, np.exp(x), 0.0), x)


@final
@dataclass(frozen=True)
class Moments:
    """Mean and covariance of parameters, such as the values in the units of ``UNITS``."""

    mean: Vector
    cov: Float[np.ndarray, "18 18"]

    @classmethod
    def log_normal(cls, x: Vector, cov: Float[np.ndarray, "18 18"]) -> Moments:
        """Of the values where the solver's coordinates are normal."""
        mean = values_of(x) * np.where(_LOGARITHMIC, np.exp(0.5 * np.diag(cov)), 1.0)
        scale = np.where(_LOGARITHMIC, mean, 1.0)
        both = np.outer(_LOGARITHMIC, _LOGARITHMIC)
        return cls(mean, np.outer(scale, scale) * np.where(both, np.expm1(cov), cov))

    @classmethod
    def mixture(
        cls, parts: Sequence[Moments], weights: Float[np.ndarray, " parts"], mean: Vector | None = None
    ) -> Moments:
        """The covariance of each part, and how far it is from ``mean``, by default from the mean of all."""
        means = np.stack([one.mean for one in parts])
        off = means - (mean := weights @ means if mean is None else mean)
        within = np.einsum("p,pkl->kl", weights, np.stack([one.cov for one in parts]))
        return cls(mean, within + np.einsum("p,pk,pl->kl", weights, off, off))


def linear_of(x: Vector) -> Vector:
    """Return the parameters in coordinates in which light is close to linear.

    ``reflection`` becomes the reflected fraction of all light, and crosstalk itself replaces its logarithm: both are 0
    where absent. All others are as in ``x``.

    Args:
        x: the solver's coordinates, in the order of ``NAMES``; lengths (mm) and softness (panel px) are logarithms.
    """
    theta, values = np.array(x, dtype=np.float64), values_of(x)
    theta[REFLECTION] = values[REFLECTION] / (1 + values[REFLECTION])
    theta[MIX] = values[MIX]
    return theta


def linear_slope(x: Vector) -> Vector:
    """Return the derivative of each number of ``linear_of`` by its own solver's coordinate.

    Args:
        x: the solver's coordinates, in the order of ``NAMES``.
    """
    theta, slope = linear_of(x), np.ones(len(NAMES))
    slope[REFLECTION] = theta[REFLECTION] * (1 - theta[REFLECTION])
    slope[MIX] = theta[MIX]
    return slope


def vector_of(term: Backscatter) -> Vector:
    """Return the solver's coordinates of a term, in the order of ``NAMES``; logarithms use 1e-6 for 0.

    Args:
        term: with lengths in mm, and places in panel px.
    """
    emitters, mix = np.asarray(term.emitters_px), np.asarray(term.mix)
    lengths = (term.standoff_mm, term.pupil_diameter_mm, term.softness_px, term.reflection, term.reflection_mm)
    places = (emitters[1], emitters[0] - emitters[1], emitters[2] - emitters[1])
    crosstalk = (mix / np.diag(mix)[:, None])[OFF_DIAGONAL]
    x = np.concatenate([[float(np.asarray(one)) for one in (term.gamma, *lengths)], *places, crosstalk])
    return np.where(_LOGARITHMIC, np.log(np.maximum(x, 1e-6)), x)


def with_linear(term: Backscatter, theta: Float[Array, "18"]) -> Backscatter:
    """Return the term with parameters of ``linear_of``."""
    offset = theta[OFFSET]
    distance, pupil, softness, _, depth = jnp.exp(theta[1:6])
    reflected = jnp.minimum(theta[REFLECTION], 1 - 1e-9)
    mix = jnp.eye(3, dtype=theta.dtype).at[OFF_DIAGONAL].set(theta[MIX])
    return replace(
        term,
        gamma=theta[0],
        standoff_mm=distance,
        pupil_diameter_mm=pupil,
        softness_px=softness,
        reflection=reflected / (1 - reflected),
        reflection_mm=depth,
        emitters_px=jnp.stack([offset + theta[8:10], offset, offset + theta[10:12]]),
        mix=mix / mix.sum(axis=1, keepdims=True),
    )
