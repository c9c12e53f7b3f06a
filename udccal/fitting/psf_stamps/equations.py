"""The equations of a psf field in stamps: banded blocks of nodes by colour, and a dense block that colours share.

Nodes are eliminated colour by colour (Schur's complement); the dense block holds places and light of the stars, maps
and lateral colour. A cubic B-spline spans four rows, so that a row of nodes has entries with itself and the three that
follow: a band is the upper half of a matrix, a row of nodes after the other. A factor lies where its matrix was.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse
from jaxtyping import Float, Int
from scipy.linalg import cholesky, solve_triangular
from scipy.linalg.blas import dtrsm

from udccal.fitting.engine.least_squares import Step
from udccal.fitting.psf_stamps.data import Stamps
from udccal.fitting.psf_stamps.field import TAPS, PsfField, degree_of, degrees, polynomials, taps
from udccal.fitting.psf_stamps.probability import State, Weighted, expectation, laplacian

# Parameters of one star: relative light, centre (x, y), and the four numbers of its map, row by row.
OWN = 7


@dataclass(frozen=True)
class Colour:
    """H x = g of one colour, whose part of the dense block is ``index``; nodes are ordered node by node, then by image.

    After nodes are eliminated, ``band`` is their factor U, and ``cross`` and ``right_nodes`` are U^-T times their own.
    ``dense`` and ``right_dense`` are the colour's contribution to the dense block.
    """

    index: Int[np.ndarray, " own"]
    band: Float[np.ndarray, "rows n 4*n"]
    cross: Float[np.ndarray, "nodes own"]
    dense: Float[np.ndarray, "own own"]
    right_nodes: Float[np.ndarray, " nodes"]
    right_dense: Float[np.ndarray, " own"]


@dataclass(frozen=True)
class Laplace:
    """The Gaussian about the mode next to a state, and the evidence there by Laplace's method.

    Attributes:
        cost: -2 log of the evidence, expanded about the state. samples: number of samples with a value.
        mode: relative to the state. gain: increase of the log posterior up to the mode.
        root: lower Cholesky factor of the dense block's precision.
        colours: equations with their nodes eliminated.
        tuned: logarithm of each precision's factor of change in a step.
    """

    cost: float
    samples: int
    mode: Float[np.ndarray, " unknowns"]
    gain: float
    root: Float[np.ndarray, "dense dense"]
    colours: tuple[Colour, ...]
    tuned: Float[np.ndarray, " groups"]

    @property
    def evidence(self) -> float:
        """Log evidence, expanded about the mode."""
        return self.gain - 0.5 * self.cost

    def step(self, damping: float) -> Step:
        """Return a part of the way to the mode: a raised diagonal would need new factors."""
        part = 1.0 / (1.0 + damping)
        return Step(part * self.mode, part * self.tuned[None], 2 * self.gain * part * (2 - part))

    def draws(self, rng: np.random.Generator, count: int) -> Float[np.ndarray, "unknowns draws"]:
        """Draw from the Gaussian about the mode."""
        dense = solve_triangular(self.root, rng.standard_normal((len(self.root), count)), lower=True, trans=1)
        own = [rng.standard_normal((len(c.cross), count)) - c.cross @ dense[c.index] for c in self.colours]
        return np.concatenate([dense, *(divided(c.band, x, False) for c, x in zip(self.colours, own, strict=True))])


def laplace(stamps: Stamps, state: State) -> Laplace:
    """Build and solve the equations at a state with priors; raise LinAlgError when they are singular."""
    seen, colours = expectation(stamps, state), []
    size = np.zeros(state.maps_from + len(state.maps))
    for plane in range(state.light_e.shape[1]):
        colour = normal_equations(stamps, state.field, seen, plane)
        size[colour.index] += colour.dense.diagonal()
        colours.append(_eliminated(colour, state, plane))
    schur, right = _dense_prior(state, size)
    for c in colours:
        schur[np.ix_(c.index, c.index)] += c.dense
        right[c.index] += c.right_dense
    root = cholesky(schur, lower=True)
    half = solve_triangular(root, right, lower=True)
    dense = solve_triangular(root, half, lower=True, trans=1)
    nodes = [divided(c.band, (c.right_nodes - c.cross @ dense[c.index])[:, None], False)[:, 0] for c in colours]
    gain = 0.5 * float(half @ half + sum(c.right_nodes @ c.right_nodes for c in colours))
    diagonals = [np.einsum("rii->ri", c.band[:, :, : c.band.shape[1]]).ravel() for c in colours]
    log_det = 2 * np.log(np.concatenate([np.diag(root), *diagonals])).sum()
    # Minus twice the log prior, up to constants that all orders have in common.
    prior = float(state.precisions @ state.squares()) - state.volume()[0]
    cost, mode = float(log_det - 2 * seen.log_likelihood + prior), np.concatenate([dense, *nodes])
    return Laplace(cost, int(stamps.known.sum()), mode, gain, root, tuple(colours), np.zeros_like(state.precisions))


def marginal_cov(root: Float[np.ndarray, "dense dense"], index: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n n"]:
    """Return the covariance of some unknowns of the dense block, with all others marginalised."""
    half = solve_triangular(root, np.eye(len(root))[:, index], lower=True)
    return half.T @ half


def shared_by(
    field: PsfField, unit: Float[np.ndarray, "stars 2"], plane: int
) -> tuple[Int[np.ndarray, " own"], scipy.sparse.csr_array]:
    """Return the dense block's unknowns that a colour depends on, and the matrix to the stars' own changes."""
    planes, stars, one = len(field.nodes), len(unit), np.eye(OWN)
    place = (2 + planes) * np.arange(stars)[:, None] + np.array([0, 1, 2 + plane])
    numbers = stars * (2 + planes) + np.arange(field.warp.size + field.lateral.size)
    warp, lateral = np.split(numbers, [field.warp.size])
    parts = [(place, np.eye(stars), one[:, [1, 2, 0]])]
    parts += [(warp.reshape(field.warp.shape)[plane], polynomials(unit, field.degrees[0])[:, 1:], one[:, 3:])]
    if plane != field.reference:
        basis = polynomials(unit, degree_of(1 + field.lateral.shape[1]))[:, 1:]
        parts += [(lateral.reshape(field.lateral.shape)[plane - (plane > field.reference)], basis, one[:, 1:3])]
    matrix = scipy.sparse.hstack([scipy.sparse.kron(basis, own) for _, basis, own in parts], format="csr")
    return np.concatenate([index.ravel() for index, _, _ in parts]), scipy.sparse.csr_array(matrix)


def normal_equations(stamps: Stamps, field: PsfField, seen: Weighted, plane: int) -> Colour:
    """Return the equations of one colour, without priors."""
    basis, grid = polynomials(stamps.unit, field.degrees[1]), field.nodes.shape[2:]
    index, shared = shared_by(field, stamps.unit, plane)
    weight = seen.weight * stamps.by_plane[plane]
    weighted = np.concatenate([seen.seen.jacobian, seen.residual[..., None]], axis=2) * weight[..., None]
    used = np.flatnonzero(weight)
    onto = taps(seen.seen, used, grid).T @ weighted.reshape(-1, OWN + 1)[used]
    onto = onto.reshape(len(stamps.unit), -1, OWN + 1).transpose(1, 0, 2)
    cross = [(onto[..., :OWN] * part[:, None]).reshape(len(onto), -1) @ shared for part in basis.T]
    own = seen.seen.jacobian.transpose(0, 2, 1) @ weighted
    return Colour(
        index=index,
        band=node_sums(basis, seen, used, grid),
        cross=np.stack(cross, axis=1).reshape(-1, len(index)),
        dense=(shared.T @ scipy.sparse.block_diag(list(own[..., :OWN]), format="csr") @ shared).toarray(),
        right_nodes=(onto[..., OWN] @ basis).ravel(),
        right_dense=shared.T @ own[..., OWN].ravel(),
    )


def node_sums(
    basis: Float[np.ndarray, "stars terms"], seen: Weighted, used: Int[np.ndarray, " used"], grid: tuple[int, ...]
) -> Float[np.ndarray, "rows n 4*n"]:
    """Sum products of two nodes' contributions over samples, as a band; raise LinAlgError without samples."""
    # Light of a star at position X enters the image t with the factor B_t(X), for every sample, and the weights of
    # a sample's 4 x 4 nodes are products of four down and four across. The contribution of a grid cell's samples is
    # therefore a product of pairs down, pairs across, and pairs of polynomials.
    if not used.size:
        raise np.linalg.LinAlgError("no sample is in use")
    (rows, columns), terms, reach = grid, basis.shape[1], TAPS - 1
    down, across = (part.reshape(-1, TAPS)[used] for part in (seen.seen.down, seen.seen.across))
    (one, other), (t, u) = np.triu_indices(TAPS), np.triu_indices(terms)
    both = (basis[:, t] * basis[:, u])[used // seen.weight.shape[1]] * seen.weight.ravel()[used, None]
    right = ((down[:, one] * down[:, other])[:, :, None] * both[:, None]).reshape(len(used), -1)
    index = seen.seen.first.ravel()[used, None] * len(one) + np.arange(len(one))
    products = (across[:, one] * across[:, other]).ravel(), index.ravel(), np.arange(0, index.size + 1, len(one))
    sums = scipy.sparse.csc_array(products, shape=(rows * columns * len(one), len(used))) @ right
    sums = sums.reshape(rows, columns, len(one), len(one), -1)[:-reach, :-reach]
    # Nodes at each distance in columns, for all pairs down; then these.
    spread = np.zeros((rows - reach, columns, 2 * reach + 1, len(one), len(t)))
    for pair, (j, k) in enumerate(zip(one, other, strict=True)):
        for first, beside in {(j, k - j), (k, j - k)}:
            spread[:, first : first + columns - reach, reach + beside] += sums[:, :, pair]
    stencil = np.zeros((rows, TAPS, columns, 2 * reach + 1, len(t)))
    for pair, (i, k) in enumerate(zip(one, other, strict=True)):
        stencil[i : i + rows - reach, k - i] += spread[:, :, :, pair]
    place = np.empty((terms, terms), dtype=int)
    place[t, u] = place[u, t] = np.arange(len(t))
    out = np.zeros((rows, columns, terms, TAPS, columns, terms))
    for away in range(-reach, TAPS):
        own, there = (slice(max(e, 0), columns + min(e, 0)) for e in (-away, away))
        np.einsum("rctdcu->rdctu", out[:, own, :, :, there])[...] = stencil[:, :, own, reach + away][..., place]
    return out.reshape(rows, columns * terms, -1)


def factor(band: Float[np.ndarray, "rows n 4*n"]) -> Float[np.ndarray, "rows n 4*n"]:
    """Replace the matrix by Cholesky's factor U of U^T U; raise LinAlgError if it is not positive definite."""
    rows, n = band.shape[:2]
    for i, row in enumerate(band):
        row[:, :n] = cholesky(row[:, :n], check_finite=False)
        beyond = row[:, n:] = _divide(row[:, :n], row[:, n:], True)
        for j in range(min(TAPS, rows - i) - 1):
            band[i + 1 + j, :, : (TAPS - 1 - j) * n] -= beyond[:, j * n : (j + 1) * n].T @ beyond[:, j * n :]
    return band


def divided(
    band: Float[np.ndarray, "rows n 4*n"], right: Float[np.ndarray, "size k"], transposed: bool
) -> Float[np.ndarray, "size k"]:
    """Return U^-1 right, or U^-T right, of a factor U; ``right`` is overwritten."""
    rows, n = band.shape[:2]
    out = right.reshape(rows, n, -1)
    for i in range(rows) if transposed else reversed(range(rows)):
        ahead = out[i + 1 : i + TAPS].reshape(-1, out.shape[2])
        beyond = band[i, :, n : n + len(ahead)]
        if not transposed:
            out[i] -= beyond @ ahead
        out[i] = _divide(band[i, :, :n], out[i], transposed)
        if transposed:
            ahead -= beyond.T @ out[i]
    return right


def _divide(upper: Float[np.ndarray, "n n"], right: Float[np.ndarray, "n k"], transposed: bool) -> np.ndarray:
    """Return U^-1 right, or U^-T right; BLAS gets the transposes, whose columns are contiguous."""
    return np.asarray(dtrsm(1.0, upper.T, right.T, side=1, lower=1, trans_a=int(transposed), overwrite_b=1)).T


def _eliminated(colour: Colour, state: State, plane: int) -> Colour:
    """Add the prior of images and eliminate the nodes; their arrays are overwritten."""
    terms, rows, columns = state.field.nodes.shape[1:]
    scale = scipy.sparse.diags_array(1.0 / state.size[plane].ravel())
    rough = laplacian(rows, columns)[0] @ scale
    rough, size = (rough.T @ rough).tocoo(), (scale @ scale).tocoo()
    right, band = colour.right_nodes.reshape(-1, terms), colour.band.reshape(rows, columns, terms, TAPS, columns, terms)
    for term, own in enumerate(state.of_images[plane][degrees(state.field.degrees[1])]):
        nodes = state.field.nodes[plane, term].ravel()
        for precision, prior in zip(own, (size, rough), strict=True):
            right[:, term] -= precision * (prior @ nodes)
            (r, c), (below, beside) = np.divmod(prior.row, columns), np.divmod(prior.col, columns)
            half = below >= r
            place = r[half], c[half], term, (below - r)[half], beside[half], term
            band[place] += precision * prior.data[half]
    factor(colour.band)
    half = divided(colour.band, colour.right_nodes[:, None], True)[:, 0]
    cross = divided(colour.band, colour.cross, True)
    schur, left = colour.dense - cross.T @ cross, colour.right_dense - cross.T @ half
    return replace(colour, cross=cross, right_nodes=half, dense=schur, right_dense=left)


def _dense_prior(
    state: State, size: Float[np.ndarray, " dense"]
) -> tuple[Float[np.ndarray, "dense dense"], Float[np.ndarray, " dense"]]:
    """Return the dense block's prior precision and right side; it holds changes that images can make as well."""
    seen = size[: state.maps_from].reshape(len(state.light_e), -1)
    # Stars that are left out completely keep their places and light.
    own = np.concatenate([np.where(seen > 0, 0.0, 1.0).ravel(), state.precisions[state.map_groups]])
    values = np.concatenate([np.zeros(seen.size), state.maps])
    held = (np.sqrt(seen.mean(axis=0)) * (seen > 0))[:, :, None] * np.eye(seen.shape[1])
    matrix, held = np.diag(own), held.reshape(seen.size, -1)
    matrix[: seen.size, : seen.size] += held @ held.T
    return matrix, -own * values
