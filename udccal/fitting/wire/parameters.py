"""What a wire fit solves for, and what it knows beforehand: its constants, the rig as built, parameters and prior."""

from __future__ import annotations

import enum
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import final

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from udccal.arguments import check_kind
from udccal.errors import FitError
from udccal.fitting.engine.gaussian import Prior
from udccal.fitting.engine.least_squares import SolverRules
from udccal.models.geometry import Geometry
from udccal.models.wire import HIGHEST_ORDER, Wire
from udccal.rig import RigDescription

# Weakly determined parameters may creep on for ever: the descent ends at a tenth of a sigma, or when steps stall.
SOLVER = SolverRules(least_gain=1e-2, stalled_gain=0.1)


@final
@dataclass(frozen=True)
class WireRules:
    """The constants of a wire fit.

    Attributes:
        samples: pixels of the joint fit; time grows with it, the map's sigma falls with its square root.
        search_part, shape_part: parts of ``samples`` for the search of the shape and for its first full fit.
        search_harmonics: number of the strongest harmonics, which are enough for the search.
        least_samples: fewest pixels of a flat.
        most_clipped: part of the flat's pixels that may be clipped.
        headroom_sigma: distance of single frames from saturation; with less, their average is not linear.
        rotation_sigma_rad: prior sigma of the rotation about the geometry's own.
        widening: the prior's sigma in units of the rig's tolerances, which are bounds of a careful build.
        amplitude_sigma, field_sigma: prior sigma of free amplitudes, and of relative changes of the pupil's transform.
        least_amplitude: relative size from which harmonics are fitted; the others are part of the map's sigma.
        least_counted: relative size from which the others count there.
        strong: relative sizes from which a harmonic may have many or few corrections to the round pupil.
        smooth_degrees: of the shading: those up to the first are always fitted, those up to the second if supported.
        scan_range: of stand-off and of pupil, relative to the rig description: a quotient of lengths, each 20 % off.
        scan_steps: of the stand-off in periods at the edge of the field, and of the pupil in radians of z, the
            argument of its transform.
        places: most places of the scan from which descents start.
        sharpness: of the openings' edges, to try; see ``with_harmonics``.
        rival: difference in minus twice the log posterior below which places may change their order with more pixels.
        unfinished: the same difference after the first steps.
        doubtful_variance: residual variance beyond which free amplitudes, which no pupil explains, are tried.
        free: number of harmonics with free amplitudes, and their degree over the sensor.
        least_gain: chi-squared that rows must explain; chance does not reach a third of it in 300 trials.
        worst_variance: residual variance beyond which the fit is poor: model error as strong as shot noise and PRNU.
        doubted_sigma: deviation in prior sigmas beyond which the rig description is doubted.
    """

    samples: int = 300_000
    search_part: float = 1 / 15
    shape_part: float = 1 / 6
    search_harmonics: int = 24
    least_samples: int = 4000
    most_clipped: float = 0.05
    headroom_sigma: float = 5.0
    rotation_sigma_rad: float = 0.04
    widening: float = 2.0
    amplitude_sigma: float = 0.05
    field_sigma: float = 0.5
    least_amplitude: float = 3e-5
    least_counted: float = 1e-6
    strong: tuple[float, float] = (2e-3, 2e-4)
    smooth_degrees: tuple[int, int] = (4, 8)
    scan_range: tuple[float, float] = (0.64, 1.56)
    scan_steps: tuple[float, float] = (0.06, 0.8)
    places: int = 5
    sharpness: tuple[float, ...] = (1.0, 0.5, 0.0)
    rival: float = 60.0
    unfinished: float = 400.0
    doubtful_variance: float = 1.15
    free: tuple[int, int] = (3, 3)
    least_gain: float = 100.0
    worst_variance: float = 2.0
    doubted_sigma: float = 3.0


@final
@dataclass(frozen=True)
class WireStart:
    """The rig as built, lengths in panel periods. Tolerances of stand-off and pupil are relative, others absolute."""

    standoff_per_pitch: float
    standoff_tolerance: float
    footprint_per_pitch: float
    pupil_tolerance: float
    row_open: float
    row_tolerance: float
    column_open: float
    column_tolerance: float
    depth_per_pitch: float
    depth_tolerance: float


def wire_start(rig: RigDescription) -> WireStart:
    """The start values of a wire fit by a rig's panel, lens and stand-off.

    Raises:
        FitError: when it is no rig description.
    """
    check_kind(rig, RigDescription, "Read one by udccal.load_rig(name).", FitError)
    panel, lens, standoff = rig.panel, rig.lens, rig.mounting.standoff_mm
    pitch, depth = panel.pitch_mm.value, panel.depth_mm
    pitch_tolerance = panel.pitch_mm.tolerance / pitch
    lens_tolerance = lens.focal_mm.tolerance / lens.focal_mm.value + lens.f_number.tolerance / lens.f_number.value
    return WireStart(
        standoff_per_pitch=standoff.value / pitch,
        standoff_tolerance=standoff.tolerance / standoff.value + pitch_tolerance,
        # The beam narrows a little from the pupil to the panel on its way to the focus distance.
        footprint_per_pitch=rig.pupil_diameter_mm * (1 - standoff.value / lens.focus_mm) / pitch,
        pupil_tolerance=lens_tolerance + pitch_tolerance,
        row_open=panel.row_open.value,
        row_tolerance=panel.row_open.tolerance,
        column_open=panel.column_open.value,
        column_tolerance=panel.column_open.tolerance,
        depth_per_pitch=depth.value / pitch,
        depth_tolerance=depth.tolerance / pitch,
    )


@final
@dataclass(frozen=True)
class Harmonics:
    """Whole numbers (n, m), and the bound of each one's relative amplitude, largest first."""

    orders: Float[np.ndarray, "harmonics 2"]
    bounds: Float[np.ndarray, " harmonics"]


def possible_harmonics(start: WireStart, least: float = WireRules.least_amplitude, below: float = np.inf) -> Harmonics:
    """Harmonics whose relative amplitude has a bound from ``least`` (by default the fitted ones') to ``below``.

    The bound is the slits' times the envelope of 2 J1(z) / z, z = pi D kappa / pitch, for a round pupil.
    """
    orders = np.arange(HIGHEST_ORDER + 1.0)
    m, n = (part.ravel() for part in np.meshgrid(orders, np.concatenate([-orders[:0:-1], orders]), indexing="ij"))
    n, m = n[(m > 0) | (n > 0)], m[(m > 0) | (n > 0)]
    z = np.pi * start.footprint_per_pitch * np.hypot(n, m)
    size = np.where((n != 0) & (m != 0), 0.5, 1.0) * np.minimum(1.0, 2 * np.sqrt(2 / np.pi) / z**1.5)
    for order, opening in ((m, start.row_open), (np.abs(n), start.column_open)):
        slit = np.minimum(2.0 / (np.pi * np.maximum(order, 1) * opening), 2.0 * (1 - opening) / opening)
        size = size * np.where(order == 0, 1.0, slit)
    found = [i for i in np.argsort(-size, kind="stable") if least <= size[i] < below]
    return Harmonics(np.stack([n[found], m[found]], axis=1), size[found])


def ideal_wire(
    geometry: Geometry, start: WireStart, harmonics: Float[np.ndarray, "harmonics 2"], rules: WireRules | None = None
) -> Wire:
    """The wire of the rig as built, with a round pupil and an even field; ranges of kappa are not set.

    Args:
        geometry: gives the rays.
        start: the rig as built.
        harmonics: orders (n, m) along X and Y.
        rules: for the degrees of the shading.
    """
    degrees = (rules or WireRules()).smooth_degrees[1] + 1
    fields = np.zeros((len(harmonics), 2, 2, 4))
    fields[:, 0, 0, 0] = 1.0
    return Wire(
        geometry=geometry,
        rotation_rad=np.zeros(3),
        standoff_per_pitch=np.float64(start.standoff_per_pitch),
        offset_periods=np.zeros(2),
        footprint_per_pitch=np.float64(start.footprint_per_pitch),
        row_open=np.float64(start.row_open),
        column_open=np.float64(start.column_open),
        depth_per_pitch=np.float64(start.depth_per_pitch),
        harmonics=harmonics,
        frequency=np.tile([0.0, 1.0], (len(harmonics), 1)),
        fields=fields,
        amplitudes=np.zeros((0, 2, 1, 1)),
        baseline=np.zeros((degrees, degrees)),
    )


_POSE = "rotation_x_deg", "rotation_y_deg", "rotation_z_deg", "standoff_per_pitch"
_PUPIL = "offset_x_periods", "offset_y_periods", "footprint_per_pitch"
SHAPE_NAMES = (*_POSE, *_PUPIL, "row_open", "column_open", "depth_per_pitch")


def shape_vector(wire: Wire) -> Float[np.ndarray, "10"]:
    """Rotation (3, rad), log stand-off, offset (2), log pupil, row and column openings, depth."""
    logs = [[np.log(float(length))] for length in (wire.standoff_per_pitch, wire.footprint_per_pitch)]
    rest = [[float(length)] for length in (wire.row_open, wire.column_open, wire.depth_per_pitch)]
    return np.concatenate([wire.rotation_rad, logs[0], wire.offset_periods, logs[1], *rest])


def with_shape(wire: Wire, shape: Float[np.ndarray, "10"] | Float[Array, "10"]) -> Wire:
    """The wire with other shape parameters, in the order of ``shape_vector``; numbers may be traced by JAX."""
    return replace(
        wire,
        rotation_rad=shape[:3],
        standoff_per_pitch=np.e ** shape[3],
        offset_periods=shape[4:6],
        footprint_per_pitch=np.e ** shape[6],
        row_open=shape[7],
        column_open=shape[8],
        depth_per_pitch=shape[9],
    )


def shape_sigma(start: WireStart, rules: WireRules) -> Float[np.ndarray, "10"]:
    """Sigma of the shape parameters by the rig description; the origin may be anywhere in a period."""
    openings = start.row_tolerance, start.column_tolerance, start.depth_tolerance
    tolerances = rules.widening * np.array([start.standoff_tolerance, start.pupil_tolerance, *openings])
    turned = [rules.rotation_sigma_rad] * 3
    return np.maximum([*turned, tolerances[0], 1.0, 1.0, *tolerances[1:]], 1e-6)


class Kind(enum.IntEnum):
    """Kind of a parameter; the comments say what its four indices are."""

    SHADING = 0  # 0, 0, Legendre degree in y and in x
    SITE = 1  # CFA site, 0, 0, 0: logarithm of its gain; the last site has none, as the sum over all is 0
    AMPLITUDE = 2  # harmonic, phase, degree in y and in x
    FIELD = 3  # harmonic, phase, carrier, degree
    SHAPE = 4  # place in ``shape_vector``, 0, 0, 0


@final
@dataclass(frozen=True)
class Parameters:
    """The numbers of a wire that are fitted; they form the vector ``x``."""

    nothing: Wire  # all linear coefficients are 0; numbers that are not fitted keep their values here
    columns: Int[np.ndarray, "n 5"]  # (kind, four indices) of each parameter, kind by kind
    groups: Int[np.ndarray, " n"]  # of each column; a group is kept or dropped as a whole, and -1 is always kept

    def of(self, kind: Kind) -> Bool[np.ndarray, " n"]:
        """Mask of the parameters of this kind."""
        return np.asarray(self.columns[:, 0] == kind)

    def indices(self, kind: Kind) -> tuple[Int[np.ndarray, " some"], ...]:
        """The four indices of the parameters of this kind."""
        return tuple(self.columns[self.of(kind), 1:].T)

    @property
    def linear(self) -> int:
        """Number of parameters without the shape, which comes last."""
        return int(np.count_nonzero(~self.of(Kind.SHAPE)))

    @property
    def sites(self) -> int:
        """Sites of the CFA's cell; the logarithms of their gains sum to 0, so that there is one parameter less."""
        return int(np.count_nonzero(self.of(Kind.SITE))) + 1

    @property
    def panel(self) -> bool:
        """Whether there is a panel; without one there is no shape."""
        return self.linear < len(self.columns)

    def kept(self, keep: Bool[np.ndarray, " n"]) -> Parameters:
        """Only the columns marked."""
        return replace(self, columns=self.columns[keep], groups=self.groups[keep])

    def vector(self, wire: Wire, gains: Float[np.ndarray, " sites"]) -> Float[np.ndarray, " n"]:
        """``x`` of a wire and the gains of the CFA sites."""
        return np.concatenate([leaf[self.indices(kind)] for kind, leaf in _leaves(wire, gains).items()])

    def wire(self, x: Float[np.ndarray, " n"]) -> Wire:
        """The wire of these parameters."""
        leaves = _leaves(self.nothing, np.ones(self.sites))
        for kind, leaf in leaves.items():
            leaf[self.indices(kind)] = x[self.of(kind)]
        baseline, amplitudes, fields = leaves[Kind.SHADING][0, 0], leaves[Kind.AMPLITUDE], leaves[Kind.FIELD]
        wire = replace(self.nothing, baseline=baseline, amplitudes=amplitudes, fields=fields)
        wire = with_shape(wire, leaves[Kind.SHAPE].ravel()) if self.panel else wire
        return jax.tree.map(lambda leaf: np.asarray(leaf, dtype=np.float64), wire)

    def gains(self, x: Float[np.ndarray, " n"]) -> Float[np.ndarray, " sites"]:
        """Gains of the CFA sites."""
        logs = x[self.of(Kind.SITE)]
        return np.exp(np.append(logs, -logs.sum()))

    def prior(self, start: WireStart, rules: WireRules) -> Prior:
        """Prior by the rig description, widened; the origin is that of ``nothing``, within a period."""
        ideal = ideal_wire(self.nothing.geometry, start, np.zeros((0, 2)))
        built = replace(ideal, offset_periods=self.nothing.offset_periods)
        mean, shape = self.vector(self.nothing, np.ones(self.sites)), self.indices(Kind.SHAPE)[0]
        sigma = np.array([np.inf, np.inf, rules.amplitude_sigma, rules.field_sigma, np.nan])[self.columns[:, 0]]
        mean[self.linear :] = shape_vector(built)[shape]
        sigma[self.linear :] = shape_sigma(start, rules)[shape]
        return Prior.independent(mean, sigma)


def _leaves(wire: Wire, gains: Float[np.ndarray, " sites"]) -> dict[Kind, Float[np.ndarray, "_ _ _ _"]]:
    """Copies of all arrays that may be fitted, by kind, with that kind's four indices."""
    parts = wire.baseline, np.log(gains), wire.amplitudes, wire.fields, shape_vector(wire)
    leaves = (np.array(part, dtype=np.float64) for part in parts)
    shapes = (1, 1, *np.shape(wire.baseline)), (-1, 1, 1, 1), np.shape(wire.amplitudes), np.shape(wire.fields)
    return {k: leaf.reshape(s) for k, leaf, s in zip(Kind, leaves, (*shapes, (-1, 1, 1, 1)), strict=True)}


def parameters_of(
    wire: Wire, rules: WireRules, sites: int, bounds: Iterable[float] = (), panel: bool = True
) -> Parameters:
    """All columns for ``wire``, whose arrays set their number, and for the ``sites`` of the CFA's cell.

    The stronger harmonics are by the ``bounds`` of their amplitudes, the more corrections to a round pupil they have.
    Without a ``panel`` there is no shape. Numbers without a column keep their values.
    """
    nothing = replace(wire, baseline=np.zeros_like(wire.baseline), amplitudes=np.zeros_like(wire.amplitudes))
    strongest, _, degrees, _ = np.shape(nothing.amplitudes)
    columns = [(Kind.SHADING, 0, 0, i, j) for i, j in _pairs(len(nothing.baseline))]
    columns += [(Kind.SITE, site, 0, 0, 0) for site in range(sites - 1)]
    columns += [(Kind.AMPLITUDE, h, p, i, j) for h in range(strongest) for p in (0, 1) for i, j in _pairs(degrees)]
    for h, bound in enumerate(bounds):
        # A real pupil's changes of the weakest harmonics are too small to be seen.
        counts = (4, 3) if bound > rules.strong[0] else (2, 1) if bound > rules.strong[1] else (0, 0)
        columns += [(Kind.FIELD, h, p, c, degree) for p in (0, 1) for degree in range(counts[p]) for c in (0, 1)]
    columns += [(Kind.SHAPE, k, 0, 0, 0) for k in range(10 * panel)]
    table = np.array(columns, dtype=np.int64)
    # The shading's terms of one total degree form a group, as do an amplitude's, and both carriers of a field's degree.
    kind, harmonic, phase, i, degree = table.T
    degree = np.where(kind == Kind.FIELD, degree, i + degree)
    optional = (kind == Kind.AMPLITUDE) | (kind == Kind.FIELD)
    optional |= (kind == Kind.SHADING) & (degree > rules.smooth_degrees[0])
    groups = np.unique(np.stack([kind, harmonic, phase, degree]), axis=1, return_inverse=True)[1].ravel()
    return Parameters(nothing, table, np.where(optional, groups, -1))


def _pairs(count: int) -> list[tuple[int, int]]:
    return [(i, j) for i in range(count) for j in range(count - i)]
