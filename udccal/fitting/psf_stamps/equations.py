"""The equations of a psf field in stamps: nodes by colour, banded, and a dense block of what stars and colours share.

Nodes are eliminated colour by colour (Schur's complement); the dense block holds places and light of the stars, maps
and lateral colour.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse
from jaxtyping import Float, Int
from scipy.linalg import cholesky, solve_triangular

from udccal.fitting.psf_stamps.banded import Band, band_of, factor, node_sums, stencil_of
from udccal.fitting.psf_stamps.data import Scene
from udccal.fitting.psf_stamps.field import TAPS, PlaneField, degrees, polynomials
from udccal.fitting.psf_stamps.probability import OWN, State, Weighted, by_degree, expectation


@dataclass(frozen=True)
class Shared:
    """How stars' own changes follow from the unknowns of the dense block that a colour depends on.

    Attributes:
        index: of those unknowns in the dense block.
        matrix: from these to the stars' own changes.
        size: of the dense block.
    """

    index: Int[np.ndarray, " own"]
    matrix: scipy.sparse.csr_array
    size: int


@dataclass(frozen=True)
class Normal:
    """H x = g of one colour, without priors; nodes come node by node, the images of a node together.

    Attributes:
        sums: of nodes with their neighbours, as ``banded.node_sums`` gives them.
        cross: block of nodes with the colour's part of the dense block.
        dense: that part with itself.
    """

    sums: Float[np.ndarray, "rows 4 columns 7 terms terms"]
    cross: Float[np.ndarray, "nodes own"]
    dense: Float[np.ndarray, "own own"]
    right_nodes: Float[np.ndarray, " nodes"]
    right_dense: Float[np.ndarray, " own"]


@dataclass(frozen=True)
class Eliminated:
    """One colour, its nodes eliminated.

    Attributes:
        factor: U of the nodes; ``cross`` and ``right`` are U^-T times theirs.
        index: of the colour's part in the dense block.
        schur, right_dense: what it adds to the dense block's matrix and right side.
        diagonal: of the dense block by data, before the elimination.
    """

    factor: Band
    cross: Float[np.ndarray, "nodes own"]
    right: Float[np.ndarray, " nodes"]
    index: Int[np.ndarray, " own"]
    schur: Float[np.ndarray, "own own"]
    right_dense: Float[np.ndarray, " own"]
    diagonal: Float[np.ndarray, " own"]


@dataclass(frozen=True)
class Factors:
    """The Gaussian about the mode next to a state, as factors.

    Attributes:
        colours: with their nodes eliminated.
        root: lower Cholesky factor of the dense block's precision.
        mode: as changes of the state. gain: of the log posterior on the way there.
        log_likelihood: at the state.
    """

    colours: tuple[Eliminated, ...]
    root: Float[np.ndarray, "dense dense"]
    mode: Float[np.ndarray, " unknowns"]
    gain: float
    log_likelihood: float

    @property
    def log_det(self) -> float:
        """Of the precision."""
        return sum(c.factor.log_det for c in self.colours) + float(2 * np.log(np.diag(self.root)).sum())

    def draws(self, rng: np.random.Generator, count: int) -> Float[np.ndarray, "unknowns draws"]:
        """Draws about the mode."""
        dense = solve_triangular(self.root, rng.standard_normal((len(self.root), count)), lower=True, trans=1)
        nodes = [
            c.factor.backward(rng.standard_normal((len(c.cross), count)) - c.cross @ dense[c.index])
            for c in self.colours
        ]
        return np.concatenate([dense, *nodes])


def factors(scene: Scene, state: State) -> Factors:
    """Of the equations at a state, priors included.

    Raises:
        numpy.linalg.LinAlgError: when the equations are singular.
    """
    colours, likelihood = [], 0.0
    for plane, shared in enumerate(shared_by(state.fields, scene.unit)):
        weighted, each = expectation(scene, state, plane)
        likelihood += float(each.sum())
        colours.append(_eliminated(scene, state, plane, weighted, shared))
        del weighted
    size = np.zeros(shared.size)
    for c in colours:
        size[c.index] += c.diagonal
    schur, right = _dense_prior(state, size)
    for c in colours:
        schur[np.ix_(c.index, c.index)] += c.schur
        right[c.index] += c.right_dense
    root = cholesky(schur, lower=True)
    half = solve_triangular(root, right, lower=True)
    dense = solve_triangular(root, half, lower=True, trans=1)
    nodes = [c.factor.backward((c.right - c.cross @ dense[c.index])[:, None])[:, 0] for c in colours]
    gain = 0.5 * float(half @ half + sum(c.right @ c.right for c in colours))
    return Factors(tuple(colours), root, np.concatenate([dense, *nodes]), gain, likelihood)


def shared_by(fields: tuple[PlaneField, ...], unit: Float[np.ndarray, "stars 2"]) -> tuple[Shared, ...]:
    """By colour."""
    stars, planes = len(unit), len(fields)
    star, start = OWN * np.arange(stars), stars * (2 + planes)
    width = start + sum(np.size(f.warp) + np.size(f.lateral) for f in fields)
    one, first = np.ones(stars), np.arange(stars) * (2 + planes)
    out = []
    for plane, field in enumerate(fields):
        parts = [(star, first + 2 + plane, one), (star + 1, first, one), (star + 2, first + 1, one)]
        for degree, numbers, own in ((field.warp_degree, 4, 3), (field.lateral_degree, 2, 1)):
            for column in polynomials(unit, degree)[:, 1:].T:
                parts += [(star + own + i, np.full(stars, start + i), column) for i in range(numbers)]
                start += numbers
        rows, columns, values = (np.concatenate(part) for part in zip(*parts, strict=True))
        index, columns = np.unique(columns, return_inverse=True)
        shape = (OWN * stars, len(index))
        out.append(Shared(index, scipy.sparse.csr_array((values, (rows, columns)), shape=shape), width))
    return tuple(out)


def normal_equations(
    field: PlaneField, unit: Float[np.ndarray, "stars 2"], seen: Weighted, shared: scipy.sparse.csr_array
) -> Normal:
    """Of one colour, without priors."""
    basis = polynomials(unit, field.image_degree)
    rows, columns = field.nodes.shape[1:]
    weighted = np.concatenate([seen.slopes, seen.residual[..., None]], axis=2) * seen.weight[..., None]
    onto = _onto_nodes(seen, weighted, (rows, columns))
    own = seen.slopes.transpose(0, 2, 1) @ weighted
    return Normal(
        sums=node_sums(basis, seen, (rows, columns)),
        cross=_cross(basis, onto[..., :OWN], shared),
        dense=(shared.T @ scipy.sparse.block_diag(list(own[..., :OWN]), format="csr") @ shared).toarray(),
        right_nodes=(onto[..., OWN] @ basis).ravel(),
        right_dense=shared.T @ own[..., OWN].ravel(),
    )


def _eliminated(scene: Scene, state: State, plane: int, seen: Weighted, shared: Shared) -> Eliminated:
    """A function of its own, so that one colour's equations are gone before the next one's are made."""
    field, env, precisions = state.fields[plane], state.envelopes[plane], state.precisions[plane]
    normal = normal_equations(field, scene.unit, seen, shared.matrix)
    terms, rows, columns = field.nodes.shape
    rough, size = stencil_of(env.roughness, (rows, columns)), env.size.ravel() ** -2.0
    right = normal.right_nodes.reshape(-1, terms)
    for term, (a, b) in enumerate(precisions.image[degrees(field.image_degree)]):
        diagonal = normal.sums[..., term, term]
        diagonal += b * rough
        diagonal[:, 0, :, rough.shape[3] // 2] += a * size.reshape(rows, columns)
        flat = np.ravel(field.nodes[term])
        right[:, term] -= a * size * flat + b * (env.roughness @ flat)
    found = factor(band_of(normal.sums))
    half = found.forward(right.reshape(-1, 1).copy())[:, 0]
    cross = found.forward(normal.cross)
    schur, right_dense = normal.dense - cross.T @ cross, normal.right_dense - cross.T @ half
    return Eliminated(found, cross, half, shared.index, schur, right_dense, normal.dense.diagonal())


def _dense_prior(
    state: State, size: Float[np.ndarray, " dense"]
) -> tuple[Float[np.ndarray, "dense dense"], Float[np.ndarray, " dense"]]:
    """Precision of the dense block and its right side; what images could do as well (all light, all places) is held."""
    stars, planes = state.flux_e.shape
    own, values = np.zeros(len(size)), np.zeros(len(size))
    own[state.maps_from :] = np.concatenate([precisions.of_maps for precisions in state.precisions])
    values[state.maps_from :] = np.concatenate([np.ravel(part) for f in state.fields for part in (f.warp, f.lateral)])
    held = np.zeros((2 + planes, len(size)))
    for j in range(2 + planes):
        index = j + (2 + planes) * np.arange(stars)
        # Stars that are left out altogether stay where they are.
        own[index] = np.where(size[index] > 0, 0.0, 1.0)
        held[j, index] = np.sqrt(size[index].mean()) * (size[index] > 0)
    return np.diag(own) + held.T @ held, -own * values


def _cross(
    basis: Float[np.ndarray, "stars terms"], onto: Float[np.ndarray, "grid stars own"], shared: scipy.sparse.csr_array
) -> Float[np.ndarray, "nodes dense"]:
    """Of nodes with the dense block, from sums over each star's samples."""
    terms, width = basis.shape[1], shared.shape[1]
    each = [shared.multiply(np.repeat(column, OWN)[:, None]).T for column in basis.T]
    found = scipy.sparse.vstack(each, format="csr") @ np.ascontiguousarray(onto.reshape(len(onto), -1).T)
    return np.ascontiguousarray(found.reshape(terms, width, -1).transpose(2, 0, 1)).reshape(-1, width)


def _onto_nodes(
    seen: Weighted, values: Float[np.ndarray, "stars samples k"], grid: tuple[int, int]
) -> Float[np.ndarray, "nodes stars k"]:
    """The stars' taps, transposed: from each star's samples to nodes."""
    stars, samples, k = values.shape
    nodes = grid[0] * grid[1]
    step = (np.arange(TAPS)[:, None] * grid[1] + np.arange(TAPS)).ravel()
    index = (seen.first[..., None] + step) * stars + np.arange(stars)[:, None, None]
    weights = seen.down[..., :, None] * seen.across[..., None, :]
    ends = np.arange(0, index.size + 1, TAPS**2)
    taps = scipy.sparse.csr_array((weights.ravel(), index.ravel(), ends), shape=(stars * samples, nodes * stars))
    return np.asarray(taps.T @ values.reshape(-1, k)).reshape(nodes, stars, k)


def marginal_cov(root: Float[np.ndarray, "dense dense"], index: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n n"]:
    """Covariance of some unknowns of the dense block, all others marginalised."""
    columns = np.zeros((len(root), len(index)))
    columns[index, np.arange(len(index))] = 1.0
    half = solve_triangular(root, columns, lower=True)
    return half.T @ half


@dataclass(frozen=True)
class MapCoefficients:
    """Coefficients of maps above some degree: where in the dense block, of which degree and colour, and values."""

    index: Int[np.ndarray, " n"]
    degree: Int[np.ndarray, " n"]
    colour: Int[np.ndarray, " n"]
    value: Float[np.ndarray, " n"]
    precision: Float[np.ndarray, " n"]

    @classmethod
    def above(cls, state: State, degree: int) -> MapCoefficients:
        """Of all colours."""
        start, columns = state.maps_from, []
        for plane, (field, own) in enumerate(zip(state.fields, state.precisions, strict=True)):
            group, flat = by_degree(own.warp, 4), np.ravel(field.warp)
            parts = start + np.arange(len(flat)), 1 + group, np.full(len(flat), plane), flat, own.warp[group]
            columns.append([part[1 + group > degree] for part in parts])
            start += len(flat) + np.size(field.lateral)
        return cls(*(np.concatenate(parts) for parts in zip(*columns, strict=True)))
