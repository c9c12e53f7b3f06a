"""The equations of a psf field in stamps: banded blocks of nodes by colour, and a dense block that colours share.

Nodes are eliminated colour by colour (Schur's complement); the dense block holds places, light and background of the
stars, maps and lateral colour. A cubic B-spline spans four rows, so that a row of nodes has entries with itself and the
three that follow: a band is the upper half of a matrix, a block for each row of nodes. A factor lies where its matrix
was.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import scipy.ndimage
import scipy.sparse
from jaxtyping import Bool, Float, Int
from scipy.linalg import cho_solve, cholesky, solve_triangular
from scipy.linalg.blas import dtrsm

from udccal.fitting.engine.least_squares import Step
from udccal.fitting.psf_stamps.data import Stamps
from udccal.fitting.psf_stamps.field import (
    BACKGROUND,
    OWN,
    TAPS,
    Changes,
    PsfField,
    by_maps,
    changes_of_images,
    changes_of_light,
    taps,
)
from udccal.fitting.psf_stamps.probability import State, Weighted, expectation

REACH, ACROSS = TAPS - 1, 2 * TAPS - 1  # of nodes that a sample has in common, along an axis
_AT_ONCE = 2**23  # numbers of a temporary array

Band = tuple[Float[np.ndarray, "_ _"], ...]


@dataclass(frozen=True)
class Colour:
    """H x = g of one colour, whose part of the dense block is ``index``; nodes are ordered node by node, then by image.

    After nodes are eliminated, ``band`` is their factor U, and ``cross`` and ``right_nodes`` are U^-T times their own.
    ``dense`` and ``right_dense`` are the colour's contribution to the dense block.
    """

    index: Int[np.ndarray, " own"]
    band: Band
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
        colours: equations with their nodes eliminated. kept: True for nodes of a colour that may change.
        tuned: logarithm of each precision's factor of change in a step.
    """

    cost: float
    samples: int
    mode: Float[np.ndarray, " unknowns"]
    gain: float
    root: Float[np.ndarray, "dense dense"]
    colours: tuple[Colour, ...]
    kept: Bool[np.ndarray, " nodes"]
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
        return _with_nodes(
            dense, [divided(c.band, x, False) for c, x in zip(self.colours, own, strict=True)], self.kept
        )

    def solved(self, right: Float[np.ndarray, " unknowns"]) -> Float[np.ndarray, " unknowns"]:
        """Solve the equations for another right side, in the order of ``Changes``, by the factors that are there."""
        dense, nodes = right[: len(self.root)].copy(), right[len(self.root) :].reshape(len(self.colours), -1)
        halves = [divided(c.band, x[self.kept, None], True) for c, x in zip(self.colours, nodes, strict=True)]
        for c, half in zip(self.colours, halves, strict=True):
            dense[c.index] -= c.cross.T @ half[:, 0]
        dense = cho_solve((self.root, True), dense)[:, None]
        own = [half - c.cross @ dense[c.index] for c, half in zip(self.colours, halves, strict=True)]
        images = [divided(c.band, x, False) for c, x in zip(self.colours, own, strict=True)]
        return _with_nodes(dense, images, self.kept)[:, 0]


def _with_nodes(
    dense: Float[np.ndarray, "dense k"], nodes: list[Float[np.ndarray, "own k"]], kept: Bool[np.ndarray, " nodes"]
) -> Float[np.ndarray, "unknowns k"]:
    """Return changes of all unknowns, in the order of ``Changes``."""
    every = np.zeros((len(nodes), len(kept), dense.shape[1]))
    every[:, kept] = nodes
    return np.concatenate([dense, every.reshape(-1, dense.shape[1])])


def laplace(stamps: Stamps, state: State) -> Laplace:
    """Build and solve the equations at a state with priors; raise LinAlgError when they are singular."""
    seen, (stars, planes), kept = expectation(stamps, state), state.light_e.shape, state.kept.ravel()
    numbers, count = np.arange(state.vector.size), state.maps_from + state.maps
    prior, nodes = state.prior, numbers[count:].reshape(planes, -1)[:, kept]
    pull, size, colours = prior @ state.vector, np.zeros(count), []
    for own, mine in enumerate(nodes):
        colour = normal_equations(stamps, state, seen, own)
        size[colour.index] += colour.dense.diagonal()
        colours.append(_eliminated(colour, prior[mine][:, mine], pull[mine]))
    schur, right = prior[:count, :count].toarray(), -pull[:count]
    light = numbers[: state.maps_from].reshape(stars, -1)[:, : 2 + planes].ravel()
    schur[np.ix_(light, light)] += _held(state, size)
    for c in colours:
        schur[np.ix_(c.index, c.index)] += c.dense
        right[c.index] += c.right_dense
    if not (np.isfinite(schur).all() and np.isfinite(right).all()):
        raise np.linalg.LinAlgError("the equations are not finite")
    root = cholesky(schur, lower=True)
    half = solve_triangular(root, right, lower=True)
    dense = solve_triangular(root, half, lower=True, trans=1)
    images = [divided(c.band, (c.right_nodes - c.cross @ dense[c.index])[:, None], False) for c in colours]
    gain = 0.5 * float(half @ half + sum(c.right_nodes @ c.right_nodes for c in colours))
    diagonals = [np.diag(row) for c in colours for row in c.band]
    log_det = 2 * np.log(np.concatenate([np.diag(root), *diagonals])).sum()
    # Minus twice the log prior, up to constants that all orders have in common.
    of_prior = float(state.precisions @ state.squares()) - state.volume()[0]
    cost = float(log_det - 2 * seen.log_likelihood + of_prior)
    mode, tuned = _with_nodes(dense[:, None], images, kept)[:, 0], np.zeros_like(state.precisions)
    return Laplace(cost, int(stamps.known.sum()), mode, gain, root, tuple(colours), kept, tuned)


def marginal_cov(root: Float[np.ndarray, "dense dense"], index: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n n"]:
    """Return the covariance of some unknowns of the dense block, with all others marginalised."""
    half = solve_triangular(root, np.eye(len(root))[:, index], lower=True)
    return half.T @ half


def shared_by(
    field: PsfField, unit: Float[np.ndarray, "stars 2"], plane: int
) -> tuple[Int[np.ndarray, " own"], scipy.sparse.csr_array]:
    """Return the dense block's unknowns that a colour depends on, and the matrix to the stars' own changes."""
    planes, stars = len(field.nodes), len(unit)
    place = (2 + 2 * planes) * np.arange(stars)[:, None] + np.array([0, 1, 2 + plane, 2 + planes + plane])
    of_maps, matrix = by_maps(field, unit, plane)
    own = np.eye(OWN)[:, [1, 2, 0, BACKGROUND]]
    whole = scipy.sparse.hstack([scipy.sparse.kron(np.eye(stars), own), matrix], format="csr")
    return np.concatenate([place.ravel(), stars * (2 + 2 * planes) + of_maps]), scipy.sparse.csr_array(whole)


def normal_equations(stamps: Stamps, state: State, seen: Weighted, plane: int) -> Colour:
    """Return the equations of one colour, without priors."""
    field = state.field
    basis, grid, kept = field.strengths(stamps.unit), field.nodes.shape[2:], state.kept
    index, shared = shared_by(field, stamps.unit, plane)
    weight = seen.weight * stamps.by_plane[plane]
    jacobian = seen.seen.jacobian
    weighted = np.concatenate([jacobian, seen.residual[..., None]], axis=2) * weight[..., None]
    used = np.flatnonzero(weight)
    onto = taps(seen.seen, used, grid).T @ weighted.reshape(-1, OWN + 1)[used]
    onto = np.ascontiguousarray(onto.reshape(len(stamps.unit), -1, OWN + 1).transpose(0, 2, 1))
    cross, images = np.empty((kept.sum(), len(index))), np.nonzero(kept)[2]
    for image, strength in enumerate(basis.T):
        by_own = onto[:, :OWN, kept[..., image].ravel()] * strength[:, None, None]
        cross[images == image] = (shared.T @ by_own.reshape(len(stamps.unit) * OWN, -1)).T
    own = jacobian.transpose(0, 2, 1) @ weighted
    return Colour(
        index=index,
        band=node_sums(basis, seen, used, kept),
        cross=cross,
        dense=(shared.T @ scipy.sparse.block_diag(list(own[..., :OWN]), format="csr") @ shared).toarray(),
        right_nodes=(onto[:, OWN].T @ basis)[kept.reshape(-1, len(basis.T))],
        right_dense=shared.T @ own[..., OWN].ravel(),
    )


def changes_of_samples(
    stamps: Stamps, field: PsfField, seen: Weighted, draws: Float[np.ndarray, "unknowns k"]
) -> Float[np.ndarray, "stars samples k"]:
    """Return the changes of samples' expectation under changes of all unknowns, zero for unused samples."""
    out = np.zeros((stamps.known.size, draws.shape[1]))
    changes = Changes.of(field, len(stamps.unit), draws)
    for plane in range(len(field.nodes)):
        index, shared = shared_by(field, stamps.unit, plane)
        used = np.flatnonzero(seen.weight * stamps.by_plane[plane])
        images = changes_of_images(field, stamps.unit, changes, plane)
        out[used] = changes_of_light(seen.seen, shared @ draws[index], images, used)
    return out.reshape(*stamps.known.shape, -1)


def node_sums(
    basis: Float[np.ndarray, "stars terms"],
    seen: Weighted,
    used: Int[np.ndarray, " used"],
    kept: Bool[np.ndarray, "rows columns terms"],
) -> Band:
    """Sum products of two nodes over samples, as a band of the nodes ``kept``; LinAlgError without samples."""
    if not used.size:
        raise np.linalg.LinAlgError("no sample is in use")
    terms = kept.shape[2]
    # Light of a star at position X enters the image t with the factor C_t(X), for every sample. Sums of one star serve
    # all pairs of images, therefore, and those of all stars a single image.
    t, u = np.triu_indices(terms)
    pairs = basis[:, t] * basis[:, u]
    # Nodes of further images, and those of the first one in their reach.
    near = scipy.ndimage.maximum_filter(kept[..., -1], 2 * REACH + 1)
    inner = tuple(slice(*np.flatnonzero(near.any(axis=axis))[[0, -1]] + [0, 1]) for axis in (1, 0))
    first = np.zeros((*kept.shape[:2], TAPS, ACROSS))
    every = np.zeros((*first[inner].shape, len(t)))
    for stars, sums in _stencils(seen, used, kept.shape[:2], alone=terms == 1):
        first += np.tensordot(pairs[stars, 0][: len(sums)], sums, axes=1)
        if terms > 1:
            close = sums[:, *inner]
            every += (close.reshape(len(close), -1).T @ pairs[stars]).reshape(*close.shape[1:], -1)
    place = np.where(kept, np.cumsum(kept).reshape(kept.shape) - 1, -1)
    rows = [kept[i : i + TAPS].sum(axis=(1, 2)) for i in range(len(kept))]
    size, width = np.array([(row[0], row.sum()) for row in rows]).T
    ends = np.cumsum(size * width)
    whole, start = np.zeros(ends[-1]), ends - size * width - (np.cumsum(size) - size) * (width + 1)
    _fill(whole, place[..., :1], start, width, first[..., None, None])
    if terms > 1:
        number = np.empty((terms, terms), dtype=int)
        number[t, u] = number[u, t] = np.arange(len(t))
        _fill(whole, place[inner], start[inner[0]], width[inner[0]], every[..., number])
    return tuple(part.reshape(-1, n) for part, n in zip(np.split(whole, ends[:-1]), width, strict=True))


def _stencils(
    seen: Weighted, used: Int[np.ndarray, " used"], grid: tuple[int, ...], alone: bool
) -> Iterator[tuple[slice, Float[np.ndarray, "stars rows columns down across"]]]:
    """Yield sums of products of nodes so far apart, down from 0 and across from -3, for some stars, or all together."""
    stars, samples = seen.weight.shape
    nodes, step = grid[0] * grid[1], np.arange(TAPS)
    some = stars if alone else max(1, _AT_ONCE // (nodes * TAPS * ACROSS))
    for begin in range(0, stars, some):
        part = slice(begin, min(begin + some, stars))
        own = used[slice(*np.searchsorted(used, (part.start * samples, part.stop * samples)))]
        down, across = (taps.reshape(-1, TAPS)[own] for taps in (seen.seen.down, seen.seen.across))
        first = seen.seen.first.ravel()[own] + (0 if alone else nodes * (own // samples - begin))
        products = np.zeros((len(own), TAPS, ACROSS))
        for tap in step:
            products[:, tap, REACH - tap : ACROSS - tap] = across[:, tap, None] * across
        beside, weighted = products.reshape(-1, ACROSS), seen.weight.ravel()[own, None] * down
        groups = 1 if alone else part.stop - part.start
        sums = np.empty((groups * nodes, TAPS, ACROSS))
        for away in step:
            # Of each sample and node across, the nodes down that have another one so far away.
            index = first[:, None, None] + step[:, None] + grid[1] * step[: TAPS - away]
            product = np.broadcast_to((weighted[:, : TAPS - away] * down[:, away:])[:, None], index.shape)
            ends, shape = np.arange(0, index.size + 1, TAPS - away), (len(sums), len(beside))
            sums[:, away] = scipy.sparse.csc_array((product.ravel(), index.ravel(), ends), shape=shape) @ beside
        yield part, sums.reshape(groups, *grid, TAPS, ACROSS)


def _fill(
    whole: Float[np.ndarray, " entries"],
    place: Int[np.ndarray, "rows columns terms"],
    start: Int[np.ndarray, " rows"],
    width: Int[np.ndarray, " rows"],
    values: Float[np.ndarray, "rows columns down across terms terms"],
) -> None:
    """Put sums where a band has their nodes, of number ``place``; -1 for those that it lacks."""
    rows, columns, _ = place.shape
    first = start[:, None, None] + place * width[:, None, None]
    for down in range(TAPS):
        for across in range(-REACH if down else 0, TAPS):
            here = np.s_[: rows - down, max(-across, 0) : columns - max(across, 0)]
            there = place[down:, max(across, 0) : columns + min(across, 0), None]
            both = (place[here][..., None] >= 0) & (there >= 0)
            at = first[here][..., None] + there
            whole[at[both]] = values[here][:, :, down, REACH + across][both]


def factor(band: Band) -> Band:
    """Replace the matrix by Cholesky's factor U of U^T U; raise LinAlgError if it is not positive definite."""
    for i, row in enumerate(band):
        n, at = len(row), 0
        row[:, :n] = cholesky(row[:, :n], check_finite=False)
        beyond = row[:, n:] = _divide(row[:, :n], row[:, n:], True)
        for below in band[i + 1 : i + TAPS]:
            below[:, : beyond.shape[1] - at] -= beyond[:, at : at + len(below)].T @ beyond[:, at:]
            at += len(below)
    return band


def divided(band: Band, right: Float[np.ndarray, "size k"], transposed: bool) -> Float[np.ndarray, "size k"]:
    """Return U^-1 right, or U^-T right, of a factor U; ``right`` is overwritten."""
    ends = np.cumsum([len(row) for row in band])
    for row, end in list(zip(band, ends, strict=True))[:: 1 if transposed else -1]:
        n = len(row)
        own, ahead, beyond = right[end - n : end], right[end : end - n + row.shape[1]], row[:, n:]
        if not transposed:
            own -= beyond @ ahead
        own[...] = _divide(row[:, :n], own, transposed)
        if transposed:
            ahead -= beyond.T @ own
    return right


def _divide(upper: Float[np.ndarray, "n n"], right: Float[np.ndarray, "n k"], transposed: bool) -> np.ndarray:
    """Return U^-1 right, or U^-T right; BLAS gets the transposes, whose columns are contiguous."""
    return np.asarray(dtrsm(1.0, upper.T, right.T, side=1, lower=1, trans_a=int(transposed), overwrite_b=1)).T


def _eliminated(colour: Colour, prior: scipy.sparse.csr_array, pull: Float[np.ndarray, " nodes"]) -> Colour:
    """Add the prior of images and eliminate the nodes; their arrays are overwritten."""
    at = 0
    for row in colour.band:
        row += prior[at : at + row.shape[0], at : at + row.shape[1]].toarray()
        at += len(row)
    factor(colour.band)
    half = divided(colour.band, (colour.right_nodes - pull)[:, None], True)[:, 0]
    cross = divided(colour.band, colour.cross, True)
    schur, left = colour.dense - cross.T @ cross, colour.right_dense - cross.T @ half
    return replace(colour, cross=cross, right_nodes=half, dense=schur, right_dense=left)


def _held(state: State, size: Float[np.ndarray, " dense"]) -> Float[np.ndarray, "light light"]:
    """Return what holds changes of places and light that images can make as well, the first unknowns of each star."""
    stars, planes = state.light_e.shape
    # Stars that are left out completely keep their places and light.
    seen = size[: state.maps_from].reshape(stars, -1)[:, : 2 + planes]
    held = (np.sqrt(seen.mean(axis=0)) * (seen > 0))[:, :, None] * np.eye(2 + planes)
    held = held.reshape(seen.size, -1)
    return held @ held.T + np.diag(np.where(seen > 0, 0.0, 1.0).ravel())
