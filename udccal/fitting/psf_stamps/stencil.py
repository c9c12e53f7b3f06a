"""How nodes of a grid meet in the normal equations: each with its neighbours within three rows and columns.

Light of a star at position X enters the image t with the factor B_t(X), whatever the sample, and the weights of a
sample's 4 x 4 nodes are products of four down and four across. So do their squares: what samples of a cell of the grid
bring is a product of pairs down, pairs across, and pairs of polynomials.
"""

from __future__ import annotations

import itertools

import numpy as np
import scipy.sparse
from jaxtyping import Float, Int

from udccal.fitting.psf_stamps.bands import AHEAD, Band
from udccal.fitting.psf_stamps.field import TAPS
from udccal.fitting.psf_stamps.likelihood import Weighted

_PAIRS = tuple(itertools.combinations_with_replacement(range(TAPS), 2))
_FIRST, _SECOND = np.array(_PAIRS).T
_NEAR = 2 * AHEAD + 1


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
