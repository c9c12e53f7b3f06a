"""Symmetric matrices of blocks on and beside the diagonal, with a dense border: factors, solutions, draws.

Nodes of a grid, three rows to a block, listen to nodes of the neighbouring blocks only, since a cubic B-spline spans
four rows. What few unknowns are shared by all (places, light, maps) stands in the border.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.linalg import cholesky, solve_triangular


@dataclass(frozen=True)
class Blocks:
    """A symmetric block-tridiagonal matrix: ``below[i]`` couples block i + 1 (rows) to block i (columns)."""

    diagonal: Float[np.ndarray, "blocks n n"]
    below: Float[np.ndarray, "blocks_less_1 n n"]


@dataclass(frozen=True)
class Factor:
    """Lower block-bidiagonal Cholesky factor."""

    diagonal: Float[np.ndarray, "blocks n n"]
    below: Float[np.ndarray, "blocks_less_1 n n"]

    @property
    def log_det(self) -> float:
        """Of the matrix that was factored."""
        return float(2 * np.log(np.einsum("bii->bi", self.diagonal)).sum())

    def forward(self, right: Float[np.ndarray, "size k"]) -> Float[np.ndarray, "size k"]:
        """L^-1 right."""
        count, n = self.diagonal.shape[:2]
        out = np.array(right, dtype=np.float64).reshape(count, n, -1)
        for i in range(count):
            if i:
                out[i] -= self.below[i - 1] @ out[i - 1]
            out[i] = solve_triangular(self.diagonal[i], out[i], lower=True, check_finite=False)
        return out.reshape(count * n, -1)

    def backward(self, right: Float[np.ndarray, "size k"]) -> Float[np.ndarray, "size k"]:
        """L^-T right."""
        count, n = self.diagonal.shape[:2]
        out = np.array(right, dtype=np.float64).reshape(count, n, -1)
        for i in range(count - 1, -1, -1):
            if i < count - 1:
                out[i] -= self.below[i].T @ out[i + 1]
            out[i] = solve_triangular(self.diagonal[i], out[i], lower=True, trans=1, check_finite=False)
        return out.reshape(count * n, -1)


def factor(matrix: Blocks) -> Factor:
    """Cholesky's factor.

    Raises:
        numpy.linalg.LinAlgError: when the matrix is not positive definite.
    """
    diagonal, below = np.empty_like(matrix.diagonal), np.empty_like(matrix.below)
    for i in range(len(diagonal)):
        block = matrix.diagonal[i]
        if i:
            block = block - below[i - 1] @ below[i - 1].T
        diagonal[i] = cholesky(block, lower=True, check_finite=False)
        if i < len(below):
            below[i] = solve_triangular(diagonal[i], matrix.below[i].T, lower=True, check_finite=False).T
    return Factor(diagonal, below)
