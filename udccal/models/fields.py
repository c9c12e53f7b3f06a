"""Smooth fields over the sensor: polynomials of bounded total degree in centred, scaled pixel coordinates."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from udccal.models.arrays import Arrayish


def polynomial_terms(degree: int) -> int:
    """Return the number of monomials x^i y^j with i + j <= ``degree``; 0 for a negative degree."""
    return (degree + 1) * (degree + 2) // 2 if degree >= 0 else 0


def polynomial_basis(unit: Float[Arrayish, "n 2"], degree: int) -> Float[Array, "n terms"]:
    """Return the products of Legendre polynomials P_i(x) P_j(y), i + j <= degree.

    Args:
        unit: positions (x, y) scaled to about [-1, 1].
        degree: largest total degree; -1 gives no terms.
    """
    unit = jnp.asarray(unit)
    x, y = _legendre(unit[:, 0], degree), _legendre(unit[:, 1], degree)
    columns = [x[i] * y[total - i] for total in range(degree + 1) for i in range(total + 1)]
    return jnp.stack(columns, axis=1) if columns else jnp.zeros((unit.shape[0], 0), unit.dtype)


def _legendre(x: Float[Array, " n"], degree: int) -> list[Float[Array, " n"]]:
    """Return P_0 ... P_degree by Bonnet's recursion."""
    values = [jnp.ones_like(x), x]
    for k in range(1, degree):
        values.append(((2 * k + 1) * x * values[k] - k * values[k - 1]) / (k + 1))
    return values[: degree + 1]
