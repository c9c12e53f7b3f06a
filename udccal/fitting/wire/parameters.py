"""The parameters of a wire fit: which numbers of a wire they are, and which of these the data support."""

from __future__ import annotations

import enum
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import final

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from udccal.fitting.engine.gaussian import Prior
from udccal.fitting.engine.orders import Attempt, Choice, bic, choose
from udccal.fitting.wire.rules import WireRules, WireStart, ideal_wire
from udccal.models.wire import Wire

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
    """Kind of a parameter, and the meaning of its four indices.

    Shading: 0, 0, Legendre degree in y and in x. Site: logarithm of the gain of one of three CFA sites, as the sum over
    all four is 0. Amplitude: harmonic, phase, degree in y and in x. Field: harmonic, phase, carrier, degree. Shape: one
    of ten.
    """

    SHADING = 0
    SITE = 1
    AMPLITUDE = 2
    FIELD = 3
    SHAPE = 4


def element_name(kind: int, a: int, b: int, c: int, d: int) -> str:
    """Name of a fitted element of the wire's arrays: the array, and its indices."""
    if kind == Kind.SHADING:
        return f"baseline.{c}.{d}"
    return f"{'amplitudes' if kind == Kind.AMPLITUDE else 'fields'}.{a}.{b}.{c}.{d}"


@final
@dataclass(frozen=True)
class Parameters:
    """The numbers of a wire that are fitted; they form the vector ``x``.

    Attributes:
        nothing: the wire where all linear coefficients are 0; numbers that are not fitted keep their values here.
        columns: (kind, four indices) of each parameter, kind by kind.
        groups: group of each column; a group is kept or dropped as a whole, and -1 is always kept.
    """

    nothing: Wire
    columns: Int[np.ndarray, "n 5"]
    groups: Int[np.ndarray, " n"]

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

    @property
    def strengths(self) -> Int[np.ndarray, " harmonics"]:
        """Column of each harmonic's strength in even light; -1 where there is none."""
        found = np.full(len(self.nothing.harmonics), -1)
        columns = np.flatnonzero(self.of(Kind.FIELD) & ~self.columns[:, 2:].any(axis=1))
        found[self.columns[columns, 1]] = columns
        return found

    def kept(self, keep: Bool[np.ndarray, " n"]) -> Parameters:
        """Only the columns marked."""
        return Parameters(self.nothing, self.columns[keep], self.groups[keep])

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
        built = replace(
            ideal_wire(self.nothing.geometry, start, np.zeros((0, 2))), offset_periods=self.nothing.offset_periods
        )
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
    """All columns, for shading, site gains, the wire's amplitudes, corrections to the round pupil, and the shape.

    Args:
        wire: its arrays set the number of amplitudes and fields; numbers without a column keep their values.
        rules: for the degrees.
        sites: number of sites of the CFA's cell.
        bounds: of the harmonics' relative amplitudes; stronger ones have more corrections.
        panel: whether there is one; without it there is no shape.
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


@final
@dataclass(frozen=True)
class Selected:
    """Columns that are kept, and the solution with them alone."""

    keep: Bool[np.ndarray, " all"]
    values: Float[np.ndarray, " all"]


def select(
    matrix: Float[np.ndarray, "all all"],
    right: Float[np.ndarray, " all"],
    power: float,
    samples: int,
    groups: Int[np.ndarray, " all"],
) -> Choice[Selected]:
    """Drop groups of columns, the weakest first, while that lowers BIC.

    A group of k columns is kept when leaving it out raises chi-squared, in units of the residual variance of the full
    model (so that PRNU counts as noise), by more than k ln(samples). The result holds the full choice and the last
    steps to the best one.

    Args:
        matrix, right: normal equations of all columns.
        power: weighted sum of the squared data.
        samples: number of data.
        groups: group of each column; -1 is always kept.
    """
    unit = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    # The tiny ridge only decides between columns that the data cannot distinguish.
    cov = np.linalg.inv(matrix / np.outer(unit, unit) + 1e-10 * np.eye(len(unit))) / np.outer(unit, unit)
    values, keep, total = cov @ right, np.ones(len(right), dtype=bool), len(np.unique(groups[groups >= 0]))
    variance = max((power - float(right @ values)) / max(samples - len(right), 1), 1e-300)
    tried: list[Attempt[Selected]] = []
    while True:
        optional = np.unique(groups[keep & (groups >= 0)])
        criterion = bic((power - float(right @ values)) / variance, float(keep.sum()), samples)
        selected = Selected(keep, values)
        tried.append(Attempt(f"{len(optional)} of {total} terms", int(keep.sum()), criterion, selected))
        # The exact rise of chi-squared when one group is left out, by column.
        inside = [np.flatnonzero(groups == group) for group in optional]
        rises = [values[g] @ np.linalg.solve(cov[np.ix_(g, g)], values[g]) / len(g) / variance for g in inside]
        if not rises or min(rises) >= np.log(samples):
            return choose((tried[0], *tried[1:][-8:]))
        weakest = inside[int(np.argmin(rises))]
        gone = np.linalg.solve(cov[np.ix_(weakest, weakest)], cov[weakest])
        # By Schur's complement, the inverse without these rows and columns.
        values, cov = values - gone.T @ values[weakest], cov - cov[:, weakest] @ gone
        values[weakest], cov[weakest], cov[:, weakest] = 0.0, 0.0, 0.0
        keep = keep & (groups != groups[weakest[0]])
