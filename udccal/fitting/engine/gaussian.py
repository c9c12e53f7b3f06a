"""Normal distributions of parameters: before the data, after the data, and of any function of the parameters."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Generic, TypeVar, final

import numpy as np
from jaxtyping import Float

from udccal.arguments import array_of, found_instead
from udccal.errors import FitError
from udccal.numerics import in_float64
from udccal.result import Propagated

Term = TypeVar("Term")

# Derivatives are taken over this part of a sigma: a function is straight over it, and its rounding does not show.
_STEP_SIGMA = 0.05


@final
@dataclass(frozen=True)
class Prior:
    """A normal distribution of ``n`` parameters before the data; it adds |root (x - mean)|^2 to chi-squared.

    Attributes:
        mean: in the parameters' units.
        root: a root of the inverse covariance. The column of a parameter is zero where nothing is known of it.
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
        """The chi-squared that the prior adds at ``x``."""
        off = self.root @ (x - self.mean)
        return float(off @ off)

    def right(self, x: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """The prior's part of the right side of normal equations set up at ``x``."""
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
        """Make a posterior from a covariance; eigenvalues that rounding put below zero count as zero."""
        return cls(np.asarray(mean, dtype=np.float64), square_root(cov), term_at)

    @property
    def term(self) -> Term:
        """The term of the mean."""
        return self.term_at(self.mean)

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

        The derivatives of ``f`` are central differences along the columns of ``factor`` (the delta method). ``f`` may
        therefore be any pure function, traced by JAX or not. Memory is that of a few outputs of ``f``.

        Args:
            f: from a term to an array; called twice per column of ``factor``.

        Returns:
            an array of the shape and in the units of ``f(term)``.

        Raises:
            FitError: when ``f`` is no function, or gives anything but finite real numbers; so does ``propagate``.
        """
        variance = np.zeros(_numbers_of(f, self.term).shape)
        for slope in self._slopes(f):
            variance += slope**2
        return np.asarray(np.sqrt(variance))

    @in_float64
    def propagate(self, f: Callable[[Term], Float[np.ndarray, "*shape"]]) -> Propagated:
        """``f(term)`` with its covariance, to first order; unlike ``sigma_of`` it holds all derivatives together."""
        value = _numbers_of(f, self.term)
        slopes = [slope.ravel() for slope in self._slopes(f)]
        return Propagated(value, np.stack(slopes, axis=1) if slopes else np.zeros((value.size, 0)))

    def _slopes(self, f: Callable[[Term], Float[np.ndarray, "*shape"]]) -> Iterator[Float[np.ndarray, "*shape"]]:
        """Derivatives of ``f`` along each column of ``factor`` that is not zero."""
        for column in self.factor.T:
            if column.any():
                up, down = (
                    _numbers_of(f, self.term_at(self.mean + step * column)) for step in (_STEP_SIGMA, -_STEP_SIGMA)
                )
                yield (up - down) / (2 * _STEP_SIGMA)

    @in_float64
    def draws(self, rng: np.random.Generator, count: int) -> tuple[Term, ...]:
        """Terms drawn from the posterior."""
        steps = self.factor @ rng.standard_normal((self.factor.shape[1], count))
        return tuple(self.term_at(self.mean + step) for step in steps.T)


def _numbers_of(f: Callable[[Term], object], term: Term) -> Float[np.ndarray, "*shape"]:
    """What a caller's function makes of a term; a FitError where that is anything but finite real numbers."""
    advice = "Give a function from a term to a number or an array."
    if not callable(f):
        raise FitError(f"Expected a function of the term, found {found_instead(f)}. {advice}")
    made = f(term)
    found = array_of(made)
    if found.dtype.kind not in "biuf":
        raise FitError(f"Expected real numbers of the function, found {found_instead(made)}. {advice}")
    if bad := int(np.count_nonzero(~np.isfinite(found))):
        raise FitError(
            f"Expected finite numbers of the function, found {bad} of {found.size} that are not. Leave out of its "
            "array what has no value at the term or near it."
        )
    return found.astype(np.float64)


def square_root(cov: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """A matrix whose product with its transpose is ``cov``.

    It is scaled to a unit diagonal first, so that parameters of very different sizes keep their digits.

    Args:
        cov: positive semi-definite, n x n, in products of the parameters' units; negative eigenvalues count as zero.

    Returns:
        n x n, one row per parameter, in that parameter's unit.
    """
    size = np.sqrt(np.maximum(np.diag(cov), 0.0))
    unit = np.where(size > 0, size, 1.0)
    values, vectors = np.linalg.eigh((cov + cov.T) / (2 * np.outer(unit, unit)))
    return np.asarray(unit[:, None] * vectors * np.sqrt(np.maximum(values, 0.0)))


def scaled_inverse(matrix: Float[np.ndarray, "*k n n"], rcond: float = 1e-12) -> Float[np.ndarray, "*k n n"]:
    """Pseudo-inverse of symmetric matrices whose parameters have very different scales.

    Args:
        matrix: positive semi-definite, one n x n matrix or a stack of them.
        rcond: the matrix is scaled to a unit diagonal; eigenvalues below this part of the largest count as zero.

    Returns:
        matrices of the same shape; directions that a matrix does not determine are zero.
    """
    size = np.sqrt(np.maximum(np.einsum("...ii->...i", matrix), 0.0))
    unit = np.where(size > 1e-150, size, np.inf)
    outer = unit[..., :, None] * unit[..., None, :]
    values, vectors = np.linalg.eigh(matrix / outer)
    size = np.abs(values)
    seen = size > rcond * size.max(axis=-1, keepdims=True, initial=0.0)
    values = np.where(seen, 1 / np.where(seen, values, 1.0), 0.0)
    return np.asarray((vectors * values[..., None, :]) @ np.swapaxes(vectors, -1, -2) / outer)


def cramer_rao(
    information: Float[np.ndarray, "n n"], slopes: Float[np.ndarray, "quantities n"] | None = None
) -> Float[np.ndarray, " quantities"]:
    """Smallest standard deviation of unbiased estimates of the parameters or of functions of them (Cramér–Rao bound).

    Parameters of very different size are scaled before the inversion.

    Args:
        information: Fisher information on the n parameters.
        slopes: derivatives of each quantity by the parameters; without them the parameters are the quantities.

    Returns:
        one sigma per quantity, in its unit; infinite where the data do not determine it.
    """
    root = np.sqrt(np.diag(information))
    seen = root > 0
    scale = np.where(seen, root, 1.0)
    inverse = scaled_inverse(information, 1e-13)
    directions = np.eye(len(root)) if slopes is None else np.asarray(slopes, dtype=np.float64)
    variance = np.einsum("qi,ij,qj->q", directions, inverse, directions)
    # A direction in the null space of the information comes back shortened from its projection.
    short = (directions @ (inverse @ information) - directions) / scale
    lost = np.linalg.norm(short, axis=1) > 1e-6 * np.linalg.norm(directions / scale, axis=1)
    return np.where(lost, np.inf, np.sqrt(np.maximum(variance, 0.0)))
