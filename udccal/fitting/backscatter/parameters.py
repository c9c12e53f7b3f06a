"""The backscatter term as a vector of parameters: coordinates, prior, orders, and the most probable values.

Lengths, softness, reflection and crosstalk cannot be negative: the solver works on their logarithms. The prior is
normal in the solver's coordinates: nominal values with the tolerances of the rig, and wide where no data sheet helps.
Light is close to linear in other coordinates (``linear_of``), in which orders with and without a part can be combined.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import final

import numpy as np
from jaxtyping import Bool, Float

from udccal.fitting.engine.gaussian import Prior
from udccal.fitting.engine.least_squares import Blocks, Step, minimise
from udccal.models.backscatter import Backscatter
from udccal.rig import RigDescription

Vector = Float[np.ndarray, "18"]
Cov = Float[np.ndarray, "18 18"]
Free = Bool[np.ndarray, "18"]
NAMES = (
    "gamma", "standoff_mm", "pupil_diameter_mm", "softness_px", "reflection", "reflection_mm",
    "offset_x_px", "offset_y_px", "red_x_px", "red_y_px", "blue_x_px", "blue_y_px",
    "mix_rg", "mix_rb", "mix_gr", "mix_gb", "mix_br", "mix_bg",
)  # fmt: skip
DISTANCE, PUPIL, SOFTNESS, REFLECTION, DEPTH = range(1, 6)
# Offset of the green emitters from the centres of their pixels, and of red and blue from green; crosstalk.
OFFSET, EMITTERS, MIX = slice(6, 8), slice(8, 12), slice(12, 18)
# Rows and columns of the crosstalk in the mix.
OFF_DIAGONAL = np.nonzero(~np.eye(3, dtype=bool))
LOGARITHMIC = np.isin(np.arange(18), np.r_[1:6, 12:18])
# Parameters in the solver's coordinates to whitened errors and their Jacobian.
ErrorsAt = Callable[[Vector], tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m 18"]]]
# Replaces the logarithm of 0.
_ABSENT = -40.0


@final
@dataclass(frozen=True)
class BackscatterRules:
    """Constants of a backscatter fit: its samples, its outliers, and its criteria.

    Attributes:
        positions: number of places on the sensor at which the footprint is fitted.
        fewest_pictures: in addition to white and dark.
        clipped: fraction of saturation from which a mean counts as clipped.
        most_clipped: fraction of clipped bins above which a shot is left out whole; others lose their clipped bins.
        visible_sigma: white counts as dark below this many sigma of a bin at the 90th percentile of bins.
        worse_pictures: a picture whose residuals are this many times those of the others is an outlier.
        nothing_fits: model error, as a fraction of white, from which orders are not compared.
        held_out: the n in "every n-th picture is predicted by a fit without it".
        cells: number of parts of the sensor, across and down, over which residuals are averaged to find a pattern.
        worst_error: the most for held-out pictures, without noise, as a fraction of their peak.
        undetermined: sigma of the footprints' places over the prior's, from which pictures hold too little information,
        known: unless sigma is below this: ln of distance and pupil, offsets in panel px.
        steady: variance between frames of a picture, over noise, from which the panel may flicker.
        better_without: model error without the dark frame, or white, over that with it, up to which its light counts
            as other than that of the rest.
        unlike_white: white's brightness differs from the pictures' by more than this; less is scatter.
        brightness: scatter of pictures' brightness, in model errors, beyond which the panel is told to differ.
        most_outliers: the largest fraction of pictures that may be outliers.
    """

    positions: int = 96
    fewest_pictures: int = 6
    clipped: float = 0.98
    most_clipped: float = 0.02
    visible_sigma: float = 2.0
    worse_pictures: float = 4.0
    nothing_fits: float = 0.05
    held_out: int = 4
    cells: int = 3
    worst_error: float = 0.05
    undetermined: float = 0.5
    known: tuple[float, float, float, float] = (0.1, 0.1, 0.5, 0.5)
    steady: float = 1.3
    better_without: float = 0.5
    unlike_white: float = 0.01
    brightness: float = 3.0
    most_outliers: float = 0.25


@final
@dataclass(frozen=True)
class Order:
    """A candidate: its free parameters; the others are held."""

    name: str
    free: Free

    @property
    def parameters(self) -> int:
        """Number of fitted parameters."""
        return int(self.free.sum())

    @property
    def against(self) -> float:
        """-2 ln of this order's prior probability over that of an order with all parameters free.

        Panels have a cover glass, their primaries lie side by side and cameras' colours overlap: an order without one
        of these must be twice as probable by the data.
        """
        return float((~self.free[[REFLECTION, EMITTERS.start, MIX.start]]).sum() * 2 * np.log(2.0))

    def start(self, x: Vector, prior: Prior) -> Vector:
        """Return ``x`` with the held parameters at this order's values."""
        held = prior.mean.copy()
        held[EMITTERS], held[REFLECTION], held[MIX] = 0.0, _ABSENT, _ABSENT
        return np.where(self.free, np.where(x <= _ABSENT, prior.mean, x), held)

    def without(self, name: str, *held: int | slice) -> Order:
        """Return an order in which more parameters are held."""
        return Order(name, self.free & ~np.isin(np.arange(len(self.free)), np.r_[held]))

    def without_crosstalk(self) -> Order:
        """Return an order in which every camera colour sees only its own primary."""
        return self.without(f"{self.name}, no crosstalk", MIX)


TWO_PLANES = Order("two planes", np.ones(len(NAMES), dtype=bool))
ONE_PLANE = TWO_PLANES.without("one plane", REFLECTION, DEPTH)
# Simplest first.
KERNELS = (ONE_PLANE.without("one plane, primaries in one place", EMITTERS), ONE_PLANE, TWO_PLANES)


def footprint_per_pupil(rig: RigDescription) -> float:
    """Return the diameter of the footprint on the panel over the pupil's: rays converge towards the focus."""
    return 1.0 - rig.mounting.standoff_mm.value / rig.lens.focus_mm


def prior_of(rig: RigDescription) -> Prior:
    """Return the prior that the rig's description gives every parameter, in the solver's coordinates.

    ``reflection`` is the light by way of the glass over the light straight from the emitters. The outer face reflects
    4 % of the light that emitters send forwards (Fresnel, index 1.5). A fraction that no data sheet gives leaks past
    their opaque backs. The prior assumes 4 % for this leak, too, with a sigma of a factor of e: 1.5 to 11 %. Two sigma
    include a leak of half a per cent on one side, and a coated face, which reflects a tenth as much, on the other.

    Args:
        rig: gives the values (mean) and their tolerances (sigma), in the units of the estimates.
    """
    panel, lens, mounting = rig.panel, rig.lens, rig.mounting
    standoff, pitch = mounting.standoff_mm, panel.pitch_mm
    depth = 2 * panel.glass_thickness_mm / panel.glass_index
    softness_px, reflection, crosstalk = 0.15, 1.0, 0.1
    lengths = [standoff.value, rig.pupil_diameter_mm * footprint_per_pupil(rig), softness_px, reflection, depth]
    pupil = lens.focal_mm.tolerance / lens.focal_mm.value + lens.f_number.tolerance / lens.f_number.value + 0.02
    mean = np.concatenate([[panel.gamma.value], np.log(lengths), np.zeros(6), np.full(6, np.log(crosstalk))])
    scales = [panel.gamma.tolerance + 0.02, (standoff.tolerance + 0.1) / standoff.value, pupil, 0.7, 1.0, 0.3]
    # Sigma of the pupil's panel pixel: the mounting's tolerance, and the accumulated tolerance of the pitch.
    offset = [
        place.tolerance + place.value * pitch.tolerance / pitch.value + 0.5
        for place in (mounting.panel_x_px, mounting.panel_y_px)
    ]
    return Prior.independent(mean, np.concatenate([scales, offset, np.full(4, 0.3), np.full(6, 0.7)]))


def values_of(x: Vector) -> Vector:
    """Return the parameters in the estimates' units: lengths at the nominal pitch, the footprint for the pupil."""
    with np.errstate(over="ignore"):
        return np.where(LOGARITHMIC, np.where(x > _ABSENT, np.exp(x), 0.0), x)


def value_slope(values: Vector) -> Vector:
    """Return the derivative of each of ``values_of`` by its own solver's coordinate."""
    return np.where(LOGARITHMIC, values, 1.0)


def linear_of(x: Vector) -> Vector:
    """Return the parameters in coordinates in which light is close to linear, from the solver's.

    ``reflection`` becomes the reflected fraction of all light, and crosstalk itself replaces its logarithm: both are 0
    where absent. All others are as in ``x``: lengths (mm) and softness (panel px) are logarithms.
    """
    theta, values = np.array(x, dtype=np.float64), values_of(x)
    theta[REFLECTION] = values[REFLECTION] / (1 + values[REFLECTION])
    theta[MIX] = values[MIX]
    return theta


def linear_slope(x: Vector) -> Vector:
    """Return the derivative of each number of ``linear_of`` by its own solver's coordinate."""
    theta, slope = linear_of(x), np.ones(len(NAMES))
    slope[REFLECTION] = theta[REFLECTION] * (1 - theta[REFLECTION])
    slope[MIX] = theta[MIX]
    return slope


def vector_of(term: Backscatter) -> Vector:
    """Return the solver's coordinates of a term (mm, panel px), in the order of ``NAMES``; 1e-6 has the place of 0."""
    emitters, mix = np.asarray(term.emitters_px), np.asarray(term.mix)
    lengths = (term.standoff_mm, term.pupil_diameter_mm, term.softness_px, term.reflection, term.reflection_mm)
    places = (emitters[1], emitters[0] - emitters[1], emitters[2] - emitters[1])
    crosstalk = (mix / np.diag(mix)[:, None])[OFF_DIAGONAL]
    x = np.concatenate([[float(np.asarray(one)) for one in (term.gamma, *lengths)], *places, crosstalk])
    return np.where(LOGARITHMIC, np.log(np.maximum(x, 1e-6)), x)


def emitters_of(theta: Vector) -> Float[np.ndarray, "3 2"]:
    """Return the place of each primary's emitter from the centre of its pixel, in panel px."""
    return theta[OFFSET] + np.insert(theta[EMITTERS].reshape(2, 2), 1, 0.0, axis=0)


def with_linear(term: Backscatter, theta: Vector) -> Backscatter:
    """Return the term with parameters of ``linear_of``."""
    distance, pupil, softness, _, depth = np.exp(theta[1:6])
    reflected, mix = np.minimum(theta[REFLECTION], 1 - 1e-9), np.eye(3)
    mix[OFF_DIAGONAL] = theta[MIX]
    return replace(
        term,
        gamma=theta[0],
        standoff_mm=distance,
        pupil_diameter_mm=pupil,
        softness_px=softness,
        reflection=reflected / (1 - reflected),
        reflection_mm=depth,
        emitters_px=emitters_of(theta),
        mix=mix / mix.sum(axis=1, keepdims=True),
    )


@final
@dataclass(frozen=True)
class MostProbable:
    """The most probable parameters; ``cov`` is 0 for those that are held, ``cost`` includes the prior's part."""

    x: Vector
    cov: Cov
    cost: float
    converged: bool


@final
@dataclass(frozen=True)
class _Descent:
    """The engine's problem, with a prior that says nothing of the parameters that are held."""

    errors_at: ErrorsAt
    free: Free
    prior: Prior
    name: str = "backscatter"

    def equations_at(self, place: Vector) -> Blocks:
        errors, jacobian = self.errors_at(place)
        return replace(Blocks.of_errors(errors, jacobian * self.free).with_prior(self.prior, place), held=~self.free)

    def moved(self, place: Vector, step: Step) -> Vector:
        return place + step.shared


def most_probable(errors_at: ErrorsAt, start: Vector, free: Free, prior: Prior) -> MostProbable:
    """Minimise the cost of errors and prior over the free parameters."""
    found = minimise(_Descent(errors_at, free, Prior(prior.mean, prior.root * free)), start)
    last, cov = found.equations, np.zeros((len(free), len(free)))
    if np.isfinite(last.cost):
        cov = found.with_rest(last.cov())
    return MostProbable(found.place, cov, last.cost, found.converged)
