"""Values of a field in stamps: derivatives that are those of the values; changes go where their vector says."""

from __future__ import annotations

from dataclasses import replace

import jax
import numpy as np
import scipy.ndimage

from udccal.fitting.psf_stamps.data import offsets
from udccal.fitting.psf_stamps.field import Changes, PsfField, by_maps, degree_of, polynomials, see, taps
from udccal.models.fields import polynomial_basis

_RNG = np.random.default_rng(8)
_UNIT = _RNG.uniform(-1, 1, (5, 2))
_CENTRE = _RNG.uniform(-0.5, 0.5, (5, 2))
_OFFSET = np.stack(np.meshgrid(np.arange(-3.0, 4), np.arange(-3.0, 4)), -1).reshape(-1, 2)
_MIX = np.array([[1.0, 0.0, 0.0], [0.0, 0.6, -0.8], [0.3, 1.0, 0.2]])
_PLANE = np.broadcast_to(np.arange(49) % 2, (5, 49))


def _field() -> PsfField:
    """Of two colours."""
    nodes = _RNG.standard_normal((2, 3, 12, 15))
    warp, lateral, pedestal = (
        0.05 * _RNG.standard_normal((2, 5, 2, 2)),
        0.1 * np.ones((1, 2, 2)),
        np.array([[1e-3, 0.0, 5e-4], [2e-3, 1e-3, 0.0]]),
    )
    return PsfField(nodes, warp, lateral, _MIX, pedestal, 0.9)


def test_polynomials_are_those_of_the_models() -> None:
    with jax.enable_x64(True):
        for degree in range(6):
            np.testing.assert_allclose(polynomials(_UNIT, degree), polynomial_basis(_UNIT, degree), atol=1e-14)
            assert degree_of(polynomials(_UNIT, degree).shape[1]) == degree


def test_derivatives_are_those_of_the_values() -> None:
    field, step = _field(), 1e-6
    with jax.enable_x64(True):
        seen = see(field, _UNIT, _CENTRE, _OFFSET, _PLANE)
        ends = [see(field, _UNIT, _CENTRE + s * np.array([step, 0.0]), _OFFSET, _PLANE).value for s in (1.0, -1.0)]
        np.testing.assert_allclose(seen.jacobian[..., 1], (ends[0] - ends[1]) / (2 * step), atol=1e-6)
        # The second number of the map's first polynomial, which is the position's y.
        turned = [
            field.warp + s * step * (np.arange(4).reshape(2, 2) == 1) * (np.arange(5) == 0)[:, None, None]
            for s in (1, -1)
        ]
        ends = [see(replace(field, warp=warp), _UNIT, _CENTRE, _OFFSET, _PLANE).value for warp in turned]
        expected = (ends[0] - ends[1]) / (2 * step)
        # Squares of the pixel's part are left out.
        np.testing.assert_allclose(seen.jacobian[..., 4] * polynomials(_UNIT, 1)[:, 1, None], expected, atol=2e-3)


def test_a_pedestal_is_the_same_part_of_the_light_wherever_images_are_brighter() -> None:
    """A star's own factor takes up the images' light: a pedestal in other units would change with it over the field."""
    nodes = np.zeros((1, 2, 40, 40))
    nodes[0, :, 18:22, 18:22] = 1.0
    field = PsfField(
        nodes,
        np.zeros((1, 2, 2, 2)),
        np.zeros((0, 2, 2)),
        np.array([[1.0, 0.0, 0.0], [0.2, 0.6, 0.0]]),
        np.array([[1e-3]]),
        0.9,
    )
    unit, offset = np.array([[0.0, 0.9], [0.0, -0.9]]), offsets(31, 31)
    with jax.enable_x64(True):
        seen = see(field, unit, np.zeros((2, 2)), offset, np.zeros((2, len(offset)), dtype=int))
        light, edge = seen.value.sum(axis=1), seen.value[:, 0]
        assert light.max() > 1.5 * light.min()
        # A sum over samples is the integral to 2e-4.
        np.testing.assert_allclose(edge / light, 1e-3 / (1 + 961e-3), rtol=1e-3)
        _, by_own = by_maps(field, unit, 0)
    np.testing.assert_allclose(by_own.toarray()[8::9, -1], field.light(unit)[:, 0])


def test_a_map_stretches_light_but_not_the_pixels() -> None:
    # An image of a Gaussian that pixels average, behind a map that makes the Gaussian 20 % wider and turns it.
    sigma, warp, axis = 1.0, np.array([[1.2, 0.05], [0.05, 0.9]]), np.arange(31) - 15.0
    place = 0.5 * axis
    grid = np.exp(-0.5 * (place[:, None] ** 2 + place**2) / (sigma**2 + 1 / 12))
    image = scipy.ndimage.spline_filter(grid / grid[15, 15], order=3)
    offset = offsets(7, 7)
    whole, light = np.linalg.inv(warp @ warp.T * sigma**2 + np.eye(2) / 12), warp @ warp.T * sigma**2
    peak = (sigma**2 + 1 / 12) / np.sqrt(np.linalg.det(light + np.eye(2) / 12))
    expected = peak * np.exp(-0.5 * np.einsum("si,ij,sj->s", offset, whole, offset))
    field = PsfField(
        image[None, None],
        (warp - np.eye(2))[None, None].repeat(2, axis=1),
        np.zeros((0, 2, 2)),
        np.ones((1, 1)),
        np.zeros((1, 1)),
        0.5,
    )
    with jax.enable_x64(True):
        seen = see(field, np.array([[0.5, 0.5]]), np.zeros((1, 2)), offset, np.zeros((1, 49), dtype=int))
    # A map that stretches pixels as well is off by 0.03.
    np.testing.assert_allclose(seen.value[0], expected, atol=2e-3)


def test_a_colour_has_its_own_image_map_and_place() -> None:
    field = _field()
    alone = PsfField(field.nodes[1:], field.warp[1:], np.zeros((0, 2, 2)), _MIX, field.pedestal[1:], 0.9)
    beside = _CENTRE + 0.1 * polynomials(_UNIT, 1)[:, 1:].sum(axis=1)[:, None]
    with jax.enable_x64(True):
        both = see(field, _UNIT, _CENTRE, _OFFSET, _PLANE).value
        own = see(alone, _UNIT, beside, _OFFSET, np.zeros((5, 49), dtype=int)).value
    np.testing.assert_allclose(both[:, 1::2], own[:, 1::2], atol=1e-12)
    assert np.abs(both[:, ::2] - own[:, ::2]).max() > 0.1


def test_weights_of_nodes_give_the_values() -> None:
    # Without shear, since weights are products of two axes.
    field = replace(_field(), warp=_field().warp * np.eye(2), pedestal=np.zeros((2, 3)))
    with jax.enable_x64(True):
        seen = see(field, _UNIT, _CENTRE, _OFFSET, np.ones((5, 49), dtype=int))
    images = np.einsum("st,it,in->sn", polynomials(_UNIT, 1), _MIX, field.nodes[1].reshape(3, -1))
    used = np.array([0, 50, 60, 200])
    np.testing.assert_allclose(taps(seen, used, (12, 15)) @ images.ravel(), seen.value.ravel()[used], atol=1e-12)


def test_changes_are_applied_where_their_vector_says() -> None:
    field, zeros = _field(), np.zeros((30 + 40 + 4 + 6 + 1080, 1))
    nothing = field.moved(Changes.of(field, 5, zeros))
    np.testing.assert_array_equal(nothing.nodes, field.nodes)
    one = zeros.copy()
    # The second image of the second colour's fourth node, behind five stars, two maps, a lateral colour, two pedestals.
    one[30 + 40 + 4 + 6 + 540 + 3 * 3 + 1] = 1.0
    one[30 + 40 + 4 + 4] = 3.0
    one[30 + 40] = 2.0
    moved = field.moved(Changes.of(field, 5, one))
    assert np.flatnonzero(moved.nodes - field.nodes).tolist() == [540 + 180 + 3]
    assert (moved.lateral - field.lateral).ravel().tolist() == [2.0, 0.0, 0.0, 0.0]
    assert (moved.pedestal - field.pedestal).tolist() == [[0.0, 0.0, 0.0], [0.0, 3.0, 0.0]]
