"""Normal distributions of parameters: before the data, after the data, and of any function of the parameters."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Generic, TypeVar, final

import numpy as np
from jaxtyping import Float

from udccal.numerics import in_float64

Term = TypeVar("Term")

# Slopes are taken over this part of a sigma: there a function is straight, and its rounding does not show.
_STEP_SIGMA = 0.05


@final
@dataclass(frozen=True)
class Prior:
    """A normal distribution of ``n`` parameters before the data: |root (x - mean)|^2 is what it adds to chi-squared.

    Attributes:
        mean: in the parameters' units.
        root: a root of the inverse covariance. Parameters that nothing is known of have zeros in their column.
    """

    mean: Float[np.ndarray, " n"]
    root: Float[np.ndarray, "rows n"]

    @classmethod
    def independent(cls, mean: Float[np.ndarray, " n"], sigma: Float[np.ndarray, " n"]) -> Prior:
        """Independent parameters; a sigma of infinity says that nothing is known."""
        return cls(np.asarray(mean, dtype=np.float64), np.diag(1.0 / np.asarray(sigma, dtype=np.float64)))

    @property
    def precision(self) -> Float[np.ndarray, "n n"]:
        """Inverse covariance."""
        return np.asarray(self.root.T @ self.root)

    @property
    def sigma(self) -> Float[np.ndarray, " n"]:
        """One standard deviation of each parameter while the others are known; infinite where nothing is known."""
        with np.errstate(divide="ignore"):
            return np.asarray(1.0 / np.linalg.norm(self.root, axis=0))

    def cost(self, x: Float[np.ndarray, " n"]) -> float:
        """What the prior adds to chi-squared at ``x``."""
        off = self.root @ (x - self.mean)
        return float(off @ off)

    def right(self, x: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """What the prior adds to the right side of normal equations set up at ``x``."""
        return np.asarray(-self.root.T @ (self.root @ (x - self.mean)))


@final
@dataclass(frozen=True)
class Posterior(Generic[Term]):
    """A normal distribution of a fit's parameters after the data, and the term that they make.

    Attributes:
        mean: of the parameters, in the fit's own coordinates.
        factor: ``factor @ factor.T`` is their covariance. It may have more columns than there are parameters: model
            error that a fit has found is added as further columns.
        term_at: pure function from parameters to the term.
    """

    mean: Float[np.ndarray, " n"]
    factor: Float[np.ndarray, "n k"]
    term_at: Callable[[Float[np.ndarray, " n"]], Term] = field(repr=False)

    @classmethod
    def from_cov(
        cls,
        mean: Float[np.ndarray, " n"],
        cov: Float[np.ndarray, "n n"],
        term_at: Callable[[Float[np.ndarray, " n"]], Term],
    ) -> Posterior[Term]:
        """From a covariance, whose directions of rounding below zero are taken for zero."""
        return cls(np.asarray(mean, dtype=np.float64), square_root(cov), term_at)

    @property
    def cov(self) -> Float[np.ndarray, "n n"]:
        """Covariance of the parameters."""
        return np.asarray(self.factor @ self.factor.T)

    @property
    def sigma(self) -> Float[np.ndarray, " n"]:
        """One standard deviation of each parameter."""
        return np.asarray(np.sqrt((self.factor**2).sum(axis=1)))

    @in_float64
    def sigma_of(self, f: Callable[[Term], Float[np.ndarray, "*shape"]]) -> Float[np.ndarray, "*shape"]:
        """One standard deviation of every number that ``f`` makes of the term, to first order.

        The slopes of ``f`` are taken along the columns of ``factor`` by central differences (the delta method), so that
        ``f`` may be any pure function, traced by JAX or not. Memory is that of a few outputs of ``f``.

        Args:
            f: from a term to an array; called twice per column of ``factor``.

        Returns:
            an array of the shape and in the units of ``f(term)``.
        """
        variance = np.zeros(np.shape(f(self.term_at(self.mean))))
        for column in self.factor.T:
            if column.any():
                up, down = (
                    np.asarray(f(self.term_at(self.mean + step * column)), dtype=np.float64)
                    for step in (_STEP_SIGMA, -_STEP_SIGMA)
                )
                variance += ((up - down) / (2 * _STEP_SIGMA)) ** 2
        return np.asarray(np.sqrt(variance))

    @in_float64
    def draws(self, rng: np.random.Generator, count: int) -> tuple[Term, ...]:
        """Terms drawn from the posterior."""
        steps = self.factor @ rng.standard_normal((self.factor.shape[1], count))
        return tuple(self.term_at(self.mean + step) for step in steps.T)


def square_root(cov: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """A matrix whose product with its transpose is ``cov``; parameters of very unlike size keep their digits."""
    size = np.sqrt(np.maximum(np.diag(cov), 0.0))
    unit = np.where(size > 0, size, 1.0)
    values, vectors = np.linalg.eigh((cov + cov.T) / (2 * np.outer(unit, unit)))
    return np.asarray(unit[:, None] * vectors * np.sqrt(np.maximum(values, 0.0)))


def scaled_inverse(matrix: Float[np.ndarray, "*k n n"], rcond: float = 1e-12) -> Float[np.ndarray, "*k n n"]:
    """Inverse of symmetric matrices of very unlike scales; what they do not determine comes back as zero.

    Args:
        matrix: positive semi-definite.
        rcond: eigenvalues of the matrix with a unit diagonal below this part of the largest count as none.
    """
    size = np.sqrt(np.maximum(np.einsum("...ii->...i", matrix), 0.0))
    unit = np.where(size > 1e-150, size, np.inf)
    outer = unit[..., :, None] * unit[..., None, :]
    values, vectors = np.linalg.eigh(matrix / outer)
    size = np.abs(values)
    seen = size > rcond * size.max(axis=-1, keepdims=True, initial=0.0)
    values = np.where(seen, 1 / np.where(seen, values, 1.0), 0.0)
    return np.asarray((vectors * values[..., None, :]) @ np.swapaxes(vectors, -1, -2) / outer)
