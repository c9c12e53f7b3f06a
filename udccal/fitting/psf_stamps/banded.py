"""Banded symmetric matrices of a grid's nodes: their sums over samples, Cholesky's factor, solutions.

A cubic B-spline spans four rows, so that a row of nodes has entries with itself and the three that follow. All is done
in place: a factor lies where its matrix was, a solution where its right side was.

Light of a star at position X enters the image t with the factor B_t(X), whatever the sample, and the weights of a
sample's 4 x 4 nodes are products of four down and four across. So do their squares: what samples of a cell of the grid
bring is a product of pairs down, pairs across, and pairs of polynomials.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import scipy.sparse
from jaxtyping import Float, Int
from scipy.linalg.blas import dtrsm
from scipy.linalg.lapack import dpotrf

from udccal.fitting.psf_stamps.field import TAPS
from udccal.fitting.psf_stamps.probability import Weighted

AHEAD = TAPS - 1  # rows of nodes beyond its own that a row of nodes has entries with
_PAIRS = tuple(itertools.combinations_with_replacement(range(TAPS), 2))
_FIRST, _SECOND = np.array(_PAIRS).T
_NEAR = 2 * AHEAD + 1


@dataclass(frozen=True)
class Band:
    """Upper half of a symmetric matrix, or its factor U: the matrix is U^T U.

    Attributes:
        diagonal: a row of nodes with itself.
        beyond: a row of nodes with the three that follow; zero where there are none.
    """

    diagonal: Float[np.ndarray, "rows n n"]
    beyond: Float[np.ndarray, "rows n 3*n"]

    @property
    def log_det(self) -> float:
        """Of the matrix whose factor this is."""
        return float(2 * np.log(np.einsum("rii->ri", self.diagonal)).sum())

    def forward(self, right: Float[np.ndarray, "size k"]) -> Float[np.ndarray, "size k"]:
        """U^-T right, of a factor; ``right`` is overwritten."""
        rows, n = self.diagonal.shape[:2]
        out = right.reshape(rows, n, -1)
        for i in range(rows):
            _divide(self.diagonal[i], out[i], True)
            ahead = out[i + 1 : i + 1 + AHEAD].reshape(-1, out.shape[2])
            ahead -= self.beyond[i, :, : len(ahead)].T @ out[i]
        return right

    def backward(self, right: Float[np.ndarray, "size k"]) -> Float[np.ndarray, "size k"]:
        """U^-1 right, of a factor; ``right`` is overwritten."""
        rows, n = self.diagonal.shape[:2]
        out = right.reshape(rows, n, -1)
        for i in range(rows - 1, -1, -1):
            ahead = out[i + 1 : i + 1 + AHEAD].reshape(-1, out.shape[2])
            out[i] -= self.beyond[i, :, : len(ahead)] @ ahead
            _divide(self.diagonal[i], out[i], False)
        return right


def factor(matrix: Band) -> Band:
    """Cholesky's factor, in the place of the matrix.

    Raises:
        numpy.linalg.LinAlgError: when the matrix is not positive definite.
    """
    rows, n = matrix.diagonal.shape[:2]
    for i in range(rows):
        _, failed = dpotrf(matrix.diagonal[i].T, lower=1, clean=1, overwrite_a=1)
        if failed:
            raise np.linalg.LinAlgError(f"row {i} of nodes: minor {failed} is not positive")
        beyond = matrix.beyond[i]
        _divide(matrix.diagonal[i], beyond, True)
        taken = beyond.T @ beyond
        for j in range(min(AHEAD, rows - 1 - i)):
            own = taken[j * n : (j + 1) * n, j * n :]
            matrix.diagonal[i + 1 + j] -= own[:, :n]
            matrix.beyond[i + 1 + j, :, : own.shape[1] - n] -= own[:, n:]
    return matrix


def _divide(upper: Float[np.ndarray, "n n"], right: Float[np.ndarray, "n k"], transposed: bool) -> None:
    """U^-T right or U^-1 right, in place; BLAS sees the transposes, whose columns are contiguous."""
    dtrsm(1.0, upper.T, right.T, side=1, lower=1, trans_a=int(transposed), overwrite_b=1)


def node_sums(
    basis: Float[np.ndarray, "stars terms"], seen: Weighted, grid: tuple[int, int]
) -> Float[np.ndarray, "rows 4 columns 7 terms terms"]:
    """Sums over samples: [r, d, c, e, t, u] is image t at node (r, c) with image u at node (r + d, c + e - 3)."""
    rows, columns = grid
    one, other = np.triu_indices(basis.shape[1])
    both = basis[:, one] * basis[:, other]
    cells = columns - AHEAD
    spread = np.zeros((rows - AHEAD, columns, _NEAR, len(_PAIRS), both.shape[1]))
    for top, own in enumerate(_by_rows(seen, grid)):
        if own.size:
            local = _row_of_cells(both, seen, own, seen.first.ravel()[own] - top * columns, cells)
            for pair, (j, k) in enumerate(_PAIRS):
                spread[top, j : j + cells, AHEAD + k - j] += local[:, pair]
                if k > j:
                    spread[top, k : k + cells, AHEAD + j - k] += local[:, pair]
    out = np.zeros((rows, TAPS, columns, _NEAR, both.shape[1]))
    for pair, (i, k) in enumerate(_PAIRS):
        out[i : i + rows - AHEAD, k - i] += spread[:, :, :, pair]
    place = np.empty((basis.shape[1], basis.shape[1]), dtype=int)
    place[one, other] = place[other, one] = np.arange(len(one))
    return out[..., place]


def stencil_of(matrix: scipy.sparse.csr_array, grid: tuple[int, int]) -> Float[np.ndarray, "rows 4 columns 7"]:
    """The same of one image, from a symmetric matrix of nodes that reaches no farther."""
    out = np.zeros((grid[0], TAPS, grid[1], _NEAR))
    entries = matrix.tocoo()
    (r, c), (below, beside) = np.divmod(entries.row, grid[1]), np.divmod(entries.col, grid[1])
    upper = below >= r
    out[r[upper], (below - r)[upper], c[upper], (beside - c + AHEAD)[upper]] = entries.data[upper]
    return out


def band_of(sums: Float[np.ndarray, "rows 4 columns 7 terms terms"]) -> Band:
    """As a matrix; nodes come node by node, the images of a node together."""
    rows, _, columns, _, terms, _ = sums.shape
    diagonal = np.zeros((rows, columns, terms, 1, columns, terms))
    beyond = np.zeros((rows, columns, terms, AHEAD, columns, terms))
    for near in range(-AHEAD, AHEAD + 1):
        own = slice(max(-near, 0), columns - max(near, 0))
        there = slice(max(near, 0), columns - max(-near, 0))
        for into, values in ((diagonal, sums[:, :1]), (beyond, sums[:, 1:])):
            view = np.einsum("rctdcu->rdctu", into[:, own, :, :, there])
            view[...] = values[:, :, own, near + AHEAD]
    n = columns * terms
    return Band(diagonal.reshape(rows, n, n), beyond.reshape(rows, n, AHEAD * n))


def _by_rows(seen: Weighted, grid: tuple[int, int]) -> list[Int[np.ndarray, " _samples"]]:
    """Samples that are used, by rows of the grid's cells, and sorted by cell."""
    used = np.flatnonzero(seen.weight.ravel() > 0)
    first = seen.first.ravel()[used]
    order = np.argsort(first, kind="stable")
    edges = np.searchsorted(first[order], np.arange(grid[0] - AHEAD + 1) * grid[1])
    return [used[order[low:high]] for low, high in itertools.pairwise(edges)]


def _row_of_cells(
    both: Float[np.ndarray, "stars pairs_of_terms"],
    seen: Weighted,
    own: Int[np.ndarray, " samples"],
    cell: Int[np.ndarray, " samples"],
    cells: int,
) -> Float[np.ndarray, "cells pairs pairs pairs_of_terms"]:
    """Of the samples ``own``, which are sorted by cell: pairs across, pairs down, pairs of terms."""
    counts = np.bincount(cell, minlength=cells)
    place = cell, np.arange(len(cell)) - (np.cumsum(counts) - counts)[cell]
    down, across = (part.reshape(-1, TAPS)[own] for part in (seen.down, seen.across))
    star, weight = own // seen.weight.shape[1], seen.weight.ravel()[own]
    one = np.zeros((cells, int(counts.max()), len(_PAIRS)))
    one[place] = across[:, _FIRST] * across[:, _SECOND]
    other = np.zeros((*one.shape, both.shape[1]))
    other[place] = (weight[:, None] * down[:, _FIRST] * down[:, _SECOND])[:, :, None] * both[star][:, None, :]
    product = one.transpose(0, 2, 1) @ other.reshape(*one.shape[:2], -1)
    return product.reshape(cells, len(_PAIRS), len(_PAIRS), -1)
