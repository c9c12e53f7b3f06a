"""The normal equations of a psf field in stamps: nodes by colour, and a border of what stars and colours share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse
from jaxtyping import Float, Int
from scipy.linalg import cholesky, solve_triangular

from udccal.fitting.psf_stamps.blocks import Blocks, Factor, factor
from udccal.fitting.psf_stamps.field import OWN, TAPS, PlaneField, polynomials
from udccal.fitting.psf_stamps.prior import BLOCK_ROWS


@dataclass(frozen=True)
class Weighted:
    """One colour's samples under the present model.

    Attributes:
        first: flat index of the first of a sample's 4 x 4 nodes. tap: the nodes' weights, times the star's light.
        slopes: to what a star may change by itself: relative light, centre (x, y), map (row by row).
        residual: what is left, in electrons. weight: inverse variances, 0 where nothing is known.
        mean: expected, in electrons.
    """

    first: Int[np.ndarray, "stars samples"]
    tap: Float[np.ndarray, "stars samples 16"]
    slopes: Float[np.ndarray, "stars samples own"]
    residual: Float[np.ndarray, "stars samples"]
    weight: Float[np.ndarray, "stars samples"]
    mean: Float[np.ndarray, "stars samples"]


@dataclass(frozen=True)
class Normal:
    """H x = g of one colour without priors; nodes come node by node, the images of a node together."""

    nodes: Blocks
    meet: Float[np.ndarray, "nodes border"]
    border: Float[np.ndarray, "border border"]
    right_nodes: Float[np.ndarray, " nodes"]
    right_border: Float[np.ndarray, " border"]


@dataclass(frozen=True)
class Posterior:
    """Gaussian: its mode as a step from where the equations were set up, and its covariance as factors."""

    factors: tuple[Factor, ...]
    half_meets: tuple[Float[np.ndarray, "_nodes border"], ...]
    root: Float[np.ndarray, "border border"]
    nodes: tuple[Float[np.ndarray, "_nodes"], ...]
    border: Float[np.ndarray, " border"]

    @property
    def log_det(self) -> float:
        """Of the precision."""
        return sum(f.log_det for f in self.factors) + float(2 * np.log(np.diag(self.root)).sum())

    def draws(
        self, rng: np.random.Generator, count: int
    ) -> tuple[list[Float[np.ndarray, "_nodes draws"]], Float[np.ndarray, "border draws"]]:
        """Draws about the mode: nodes by colour, and border."""
        border = solve_triangular(self.root, rng.standard_normal((len(self.root), count)), lower=True, trans=1)
        nodes = [
            f.backward(rng.standard_normal((len(half), count)) - half @ border)
            for f, half in zip(self.factors, self.half_meets, strict=True)
        ]
        return nodes, border


def solve(
    normals: tuple[Normal, ...],
    border_prior: Float[np.ndarray, "border border"],
    border_pull: Float[np.ndarray, " border"],
) -> Posterior:
    """Mode and factors; the nodes' priors are in ``normals`` already.

    Raises:
        numpy.linalg.LinAlgError: when the equations are singular.
    """
    factors = tuple(factor(n.nodes) for n in normals)
    both = [
        f.forward(np.concatenate([n.meet, n.right_nodes[:, None]], axis=1))
        for f, n in zip(factors, normals, strict=True)
    ]
    halves = tuple(b[:, :-1] for b in both)
    schur = border_prior + sum(n.border - h.T @ h for n, h in zip(normals, halves, strict=True))
    right = border_pull + sum(n.right_border - b[:, :-1].T @ b[:, -1] for n, b in zip(normals, both, strict=True))
    root = cholesky(schur, lower=True)
    border = solve_triangular(root, solve_triangular(root, right, lower=True), lower=True, trans=1)
    nodes = tuple(f.backward(b[:, -1:] - b[:, :-1] @ border[:, None])[:, 0] for f, b in zip(factors, both, strict=True))
    return Posterior(factors, halves, root, nodes, border)


def border_maps(
    fields: tuple[PlaneField, ...], unit: Float[np.ndarray, "stars 2"]
) -> tuple[scipy.sparse.csr_array, ...]:
    """By colour, how stars' own changes follow from the border: (x, y, light by colour) by star; maps, lateral."""
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
        out.append(scipy.sparse.csr_array((values, (rows, columns)), shape=(OWN * stars, width)))
    return tuple(out)


def normal_equations(
    field: PlaneField, unit: Float[np.ndarray, "stars 2"], seen: Weighted, border: scipy.sparse.csr_array
) -> Normal:
    """Of one colour."""
    basis = polynomials(unit, field.image_degree)
    stars, terms = basis.shape
    rows, columns = field.nodes.shape[1:]
    weighted = np.concatenate([seen.slopes, seen.residual[..., None]], axis=2) * seen.weight[..., None]
    onto = np.stack([_onto_nodes(seen, k, weighted[k], (rows, columns)) for k in range(stars)], axis=1)
    own = np.einsum("ksi,ksj->kij", seen.slopes, weighted)
    meet = np.empty((rows * columns, terms, border.shape[1]))
    for term in range(terms):
        spread = onto[..., :OWN] * basis[:, term, None]
        meet[:, term] = (border.T @ spread.reshape(rows * columns, -1).T).T
    return Normal(
        nodes=_node_blocks(basis, seen, (rows, columns)),
        meet=meet.reshape(rows * columns * terms, -1),
        border=(border.T @ scipy.sparse.block_diag(list(own[..., :OWN]), format="csr") @ border).toarray(),
        right_nodes=(onto[..., OWN] @ basis).ravel(),
        right_border=border.T @ own[..., OWN].ravel(),
    )


def _onto_nodes(
    seen: Weighted, star: int, values: Float[np.ndarray, "samples k"], grid: tuple[int, int]
) -> Float[np.ndarray, "nodes k"]:
    """One star's taps, transposed: from samples to nodes."""
    step = (np.arange(TAPS)[:, None] * grid[1] + np.arange(TAPS)).ravel()
    index = (seen.first[star][:, None] + step).ravel()
    ends = np.arange(0, index.size + 1, TAPS**2)
    taps = scipy.sparse.csr_array((seen.tap[star].ravel(), index, ends), shape=(len(values), grid[0] * grid[1]))
    return np.asarray(taps.T @ values)


def _node_blocks(basis: Float[np.ndarray, "stars terms"], seen: Weighted, grid: tuple[int, int]) -> Blocks:
    """Sums over samples, by rows of the grid's cells."""
    rows, columns = grid
    terms = basis.shape[1]
    line, n = columns * terms, BLOCK_ROWS * columns * terms
    count = rows // BLOCK_ROWS
    diagonal, below = np.zeros((count, n, n)), np.zeros((count - 1, n, n))
    used = np.flatnonzero(seen.weight.ravel() > 0)
    used = used[np.argsort(seen.first.ravel()[used], kind="stable")]
    cell = seen.first.ravel()[used]
    edges = np.searchsorted(cell, np.arange(rows - TAPS + 2) * columns)
    for top in range(rows - TAPS + 1):
        own = used[edges[top] : edges[top + 1]]
        if not own.size:
            continue
        root = np.sqrt(seen.weight.ravel()[own])[:, None] * seen.tap.reshape(-1, TAPS**2)[own]
        design = (root[:, :, None] * basis[own // seen.weight.shape[1]][:, None, :]).reshape(len(own), -1)
        local = _row_of_cells(design, seen.first.ravel()[own] - top * columns, columns, terms)
        block, skip = divmod(top, BLOCK_ROWS)
        head = min(TAPS, BLOCK_ROWS - skip) * line
        diagonal[block, skip * line :, skip * line :][:head, :head] += local[:head, :head]
        if head < TAPS * line:
            tail = TAPS * line - head
            below[block, :tail, skip * line :] += local[head:, :head]
            diagonal[block + 1, :tail, :tail] += local[head:, head:]
    return Blocks(diagonal, below)


def _row_of_cells(
    design: Float[np.ndarray, "samples taps_terms"], cell: Int[np.ndarray, " samples"], columns: int, terms: int
) -> Float[np.ndarray, "n n"]:
    """Normal matrix of four rows of nodes, from the samples between the middle two, which are sorted by cell."""
    cells, line = columns - TAPS + 1, columns * terms
    counts = np.bincount(cell, minlength=cells)
    padded = np.zeros((cells, int(counts.max()), design.shape[1]))
    padded[cell, np.arange(len(cell)) - (np.cumsum(counts) - counts)[cell]] = design
    sums = padded.transpose(0, 2, 1) @ padded
    tap = np.arange(TAPS)
    place = (tap[:, None, None] * columns + tap[:, None]) * terms + np.arange(terms)
    place = place.ravel() + terms * np.arange(cells)[:, None]
    out = np.zeros((TAPS * line) ** 2)
    index = place[:, :, None] * (TAPS * line) + place[:, None, :]
    for phase in range(TAPS):  # cells four apart share no nodes
        out[index[phase::TAPS]] += sums[phase::TAPS]
    return out.reshape(TAPS * line, TAPS * line)
