"""Symmetric matrices of a grid's nodes, row of nodes by row of nodes: Cholesky's factor, solutions, draws.

A cubic B-spline spans four rows, so that a row of nodes meets the three that follow it and no others. All is done in
place: a factor lies where its matrix was, a solution where its right side was.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.linalg.blas import dtrsm
from scipy.linalg.lapack import dpotrf

AHEAD = 3  # rows of nodes that a row of nodes meets beyond itself


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
