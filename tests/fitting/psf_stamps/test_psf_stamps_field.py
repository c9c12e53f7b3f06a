"""Values of a field in stamps: the same however they are asked for, and slopes that are those of the values."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from udccal.fitting.psf_stamps.field import Changes, PlaneField, polynomials, see
from udccal.models.fields import polynomial_basis

_RNG = np.random.default_rng(8)
_UNIT = _RNG.uniform(-1, 1, (5, 2))
_CENTRE = _RNG.uniform(-0.5, 0.5, (5, 2))
_OFFSET = np.broadcast_to(np.stack(np.meshgrid(np.arange(-3.0, 4), np.arange(-3.0, 4)), -1).reshape(-1, 2), (5, 49, 2))


def _field() -> PlaneField:
    nodes = _RNG.standard_normal((3, 12, 15))
    return PlaneField(nodes, 0.05 * _RNG.standard_normal((5, 2, 2)), 0.1 * np.ones((2, 2)), 1, 2, 1, 0.9)


def test_polynomials_are_those_of_the_models() -> None:
    with jax.enable_x64(True):
        for degree in range(6):
            np.testing.assert_allclose(polynomials(_UNIT, degree), polynomial_basis(_UNIT, degree), atol=1e-14)


def test_traced_and_plain_values_agree() -> None:
    field = _field()
    with jax.enable_x64(True):
        plain = see(field, _UNIT, _CENTRE, _OFFSET)
        traced = jax.jit(lambda unit, centre: see(field, unit, centre, _OFFSET))(_UNIT, _CENTRE)
        for one, other in zip(plain, traced, strict=True):
            assert isinstance(one, np.ndarray)
            np.testing.assert_allclose(one, other, atol=1e-12)


def test_slopes_are_those_of_the_values() -> None:
    field = _field()

    def values(centre: jax.Array) -> jax.Array:
        return jnp.asarray(see(field, _UNIT, centre, _OFFSET).value)

    with jax.enable_x64(True):
        _, by_x = jax.jvp(values, (jnp.asarray(_CENTRE),), (jnp.ones((5, 2)) * jnp.array([1.0, 0.0]),))
        np.testing.assert_allclose(see(field, _UNIT, _CENTRE, _OFFSET).slopes[..., 0], by_x, atol=1e-10)


def test_changes_are_applied_where_their_vector_says() -> None:
    field, zeros = _field(), np.zeros((10 + 5 + 20 + 4 + 540, 1))
    nothing = Changes.of((field,), 5, zeros).applied((field,))[0]
    np.testing.assert_array_equal(nothing.nodes, field.nodes)
    one = zeros.copy()
    # The second image of the fourth node, behind five stars, a map of five polynomials and a lateral colour of two.
    one[15 + 20 + 4 + 3 * 3 + 1] = 1.0
    change = Changes.of((field,), 5, one).applied((field,))[0].nodes - field.nodes
    assert np.flatnonzero(change).tolist() == [180 + 3]
