"""What a wire fit solves for: the rig as built, the harmonics its panel can show, and the vector of the parameters."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from udccal.cfa import SITES
from udccal.fitting.engine.gaussian import Prior
from udccal.fitting.wire.rules import WireRules, WireStart
from udccal.models.geometry import Geometry
from udccal.models.wire import HIGHEST_ORDER, Wire

SHAPE_NAMES = (
    "rotation_x_deg",
    "rotation_y_deg",
    "rotation_z_deg",
    "standoff_per_pitch",
    "offset_x_periods",
    "offset_y_periods",
    "footprint_per_pitch",
    "row_open",
    "column_open",
    "depth_per_pitch",
)
SHAPE_UNITS = ("deg", "deg", "deg", "1", "period", "period", "1", "1", "1", "1")
_FIELD_DEGREES = 4
_LEAST_SIGMA = 1e-6


@final
@dataclass(frozen=True)
class Harmonics:
    """Whole numbers (n, m), and the bound of each one's relative amplitude, largest first."""

    orders: Float[np.ndarray, "harmonics 2"]
    bounds: Float[np.ndarray, " harmonics"]


def possible_harmonics(start: WireStart, least: float | None = None, below: float = np.inf) -> Harmonics:
    """Harmonics whose bound is at least ``least`` (by default what is fitted) and less than ``below``.

    The bound is the slits' times the envelope of 2 J1(z) / z, z = pi D kappa / pitch, for a round pupil.
    """
    least = WireRules().least_amplitude if least is None else least
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
    """The rig as built, with a round pupil and an even field; the harmonics' ranges of kappa are not set."""
    degrees = (rules or WireRules()).smooth_degree + 1
    fields = np.zeros((len(harmonics), 2, 2, _FIELD_DEGREES))
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


def shape_vector(wire: Wire) -> Float[Array, "10"]:
    """Rotation (3, rad), log stand-off, offset (2), log pupil, row and column openings, depth."""
    lengths = wire.row_open, wire.column_open, wire.depth_per_pitch
    parts = (
        wire.rotation_rad,
        jnp.log(wire.standoff_per_pitch),
        wire.offset_periods,
        jnp.log(wire.footprint_per_pitch),
        *lengths,
    )
    return jnp.concatenate([jnp.atleast_1d(jnp.asarray(part)) for part in parts])


def with_shape(wire: Wire, shape: Float[np.ndarray, "10"] | Float[Array, "10"]) -> Wire:
    """The wire with other shape parameters, in the order of ``shape_vector``."""
    leaves = shape[:3], jnp.exp(shape[3]), shape[4:6], jnp.exp(shape[6]), shape[7], shape[8], shape[9]
    return eqx.tree_at(_shape_leaves, wire, leaves)


def _shape_leaves(w: Wire) -> tuple[object, ...]:
    placed = w.rotation_rad, w.standoff_per_pitch, w.offset_periods, w.footprint_per_pitch
    return *placed, w.row_open, w.column_open, w.depth_per_pitch


@final
@dataclass(frozen=True)
class Parameters:
    """Which numbers of a wire are fitted: they make the vector ``x``, in the order of the attributes.

    Attributes:
        nothing: the wire where all linear coefficients are nothing; others that no column has stay as they are here.
        baseline: Legendre pairs (degree in y, in x). After them come the logarithms of three CFA-site gains; the
            fourth follows, as their sum is 0.
        amplitudes: (harmonic, phase, degree in y, in x).
        fields: (harmonic, phase, carrier, degree).
        groups: numbers columns that are kept or dropped together; -1 is always kept.
        panel: whether the ten shape parameters end the vector.
    """

    nothing: Wire
    baseline: Int[np.ndarray, "smooth 2"]
    amplitudes: Int[np.ndarray, "beside 4"]
    fields: Int[np.ndarray, "columns 4"]
    groups: Int[np.ndarray, " n"]
    panel: bool

    @property
    def sites(self) -> slice:
        """Where the site gains are: they are no part of the map."""
        return slice(len(self.baseline), len(self.baseline) + SITES - 1)

    @property
    def linear(self) -> int:
        """How many there are but the shape."""
        return self.sites.stop + len(self.amplitudes) + len(self.fields)

    def kept(self, keep: Bool[np.ndarray, " n"]) -> Parameters:
        """Only the columns marked; site gains and shape always stay."""
        baseline, _, amplitudes, fields, _ = self._split(keep)
        keep = np.concatenate([baseline, np.ones(SITES - 1, bool), amplitudes, fields, np.ones(10 * self.panel, bool)])
        columns = self.baseline[baseline], self.amplitudes[amplitudes], self.fields[fields]
        return Parameters(self.nothing, *columns, self.groups[keep], self.panel)

    def vector(self, wire: Wire, gains: Float[np.ndarray, "4"]) -> Float[np.ndarray, " n"]:
        """``x`` of a wire and the gains of the CFA sites."""
        linear = (
            np.asarray(wire.baseline)[tuple(self.baseline.T)],
            np.log(gains)[: SITES - 1],
            np.asarray(wire.amplitudes)[tuple(self.amplitudes.T)],
            np.asarray(wire.fields)[tuple(self.fields.T)],
        )
        return np.concatenate([*linear, np.asarray(shape_vector(wire))[: 10 * self.panel]])

    def wire(self, x: Float[np.ndarray, " n"]) -> Wire:
        """The wire of these parameters."""
        smooth, _, beside, pupil, shape = self._split(x)
        leaves = [np.array(leaf) for leaf in (self.nothing.baseline, self.nothing.amplitudes, self.nothing.fields)]
        for leaf, columns, values in zip(
            leaves, (self.baseline, self.amplitudes, self.fields), (smooth, beside, pupil), strict=True
        ):
            leaf[tuple(columns.T)] = values
        wire = eqx.tree_at(lambda w: (w.baseline, w.amplitudes, w.fields), self.nothing, tuple(leaves))
        wire = with_shape(wire, shape) if self.panel else wire
        return jax.tree.map(lambda leaf: np.asarray(leaf, dtype=np.float64), wire)

    def gains(self, x: Float[np.ndarray, " n"]) -> Float[np.ndarray, "4"]:
        """Gains of the CFA sites."""
        logs = x[self.sites]
        return np.exp(np.append(logs, -logs.sum()))

    def prior(self, start: WireStart, rules: WireRules) -> Prior:
        """From the rig description, widened; of the origin no more is known than where ``nothing`` has it."""
        mean, sigma = np.zeros(self.linear), np.full(self.linear, np.inf)
        mean[self.linear - len(self.fields) :] = np.asarray(self.nothing.fields)[tuple(self.fields.T)]
        sigma[self.sites.stop :] = rules.amplitude_sigma
        sigma[self.linear - len(self.fields) :] = rules.field_sigma
        if not self.panel:
            return Prior.independent(mean, sigma)
        built = [
            np.log(start.standoff_per_pitch),
            *np.asarray(self.nothing.offset_periods),
            np.log(start.footprint_per_pitch),
        ]
        shape = [0.0, 0.0, 0.0, *built, start.row_open, start.column_open, start.depth_per_pitch]
        return Prior.independent(np.append(mean, shape), np.append(sigma, shape_sigma(start, rules)))

    def _split(self, x: np.ndarray) -> list[np.ndarray]:
        ends = self.sites.start, self.sites.stop, self.sites.stop + len(self.amplitudes), self.linear
        return np.split(x, ends)


def shape_sigma(start: WireStart, rules: WireRules) -> Float[np.ndarray, "10"]:
    """One standard deviation of the shape parameters by the rig description; the origin is anywhere in a period."""
    openings = start.row_tolerance, start.column_tolerance, start.depth_tolerance
    tolerances = rules.widening * np.array([start.standoff_tolerance, start.pupil_tolerance, *openings])
    turned = [rules.rotation_sigma_rad] * 3
    return np.maximum([*turned, tolerances[0], 1.0, 1.0, *tolerances[1:]], _LEAST_SIGMA)


def parameters_of(wire: Wire, rules: WireRules, bounds: Iterable[float] = (), panel: bool = True) -> Parameters:
    """Shading, site gains, the amplitudes that a wire has room for, and corrections to the round pupil.

    Args:
        wire: what no column has stays as it is here: its fields, and its shape where there is no panel.
        rules: for the degrees.
        bounds: of the harmonics' relative amplitudes; stronger ones have more corrections.
        panel: whether there is one; without, there is no shape.
    """
    linear = np.zeros_like(wire.baseline), np.zeros_like(wire.amplitudes)
    nothing = eqx.tree_at(lambda w: (w.baseline, w.amplitudes), wire, linear)
    smooth = _pairs(len(nothing.baseline))
    strongest, _, degrees, _ = np.shape(nothing.amplitudes)
    beside = [(h, phase, *pair) for h in range(strongest) for phase in (0, 1) for pair in _pairs(degrees)]
    fields = []
    for h, bound in enumerate(bounds):
        # What a real pupil changes of the weakest harmonics is too small to be seen.
        counts = (4, 3) if bound > rules.strong else (2, 1) if bound > rules.middle else (0, 0)
        # The two carriers of a degree stand or fall together.
        fields += [(h, phase, c, degree) for phase in (0, 1) for degree in range(counts[phase]) for c in (0, 1)]
    keys: list[tuple[int, ...] | None] = [(i + j,) if i + j > rules.always_smooth else None for i, j in smooth]
    keys += [None] * (SITES - 1) + [(h, phase, i + j) for h, phase, i, j in beside]
    keys += [(h, phase, 0, degree) for h, phase, _, degree in fields] + [None] * (10 * panel)
    numbers: dict[tuple[int, ...], int] = {}
    groups = np.array([-1 if key is None else numbers.setdefault(key, len(numbers)) for key in keys])
    amplitudes, corrections = (np.array(rows, dtype=np.int64).reshape(-1, 4) for rows in (beside, fields))
    return Parameters(nothing, np.array(smooth), amplitudes, corrections, groups, panel)


def _pairs(count: int) -> list[tuple[int, int]]:
    return [(i, j) for i in range(count) for j in range(count - i)]
