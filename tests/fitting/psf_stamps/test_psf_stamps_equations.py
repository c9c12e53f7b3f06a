"""The equations of a psf field in stamps: sums over samples and factors, against dense matrices."""

from __future__ import annotations

from dataclasses import replace

import jax
import numpy as np
import pytest

from tests.scenes.two_gaussians import make
from udccal.fitting.psf_stamps.data import Stamps, StampsRules
from udccal.fitting.psf_stamps.equations import (
    Band,
    divided,
    factor,
    laplace,
    marginal_cov,
    node_sums,
    normal_equations,
    shared_by,
)
from udccal.fitting.psf_stamps.field import TAPS, polynomials
from udccal.fitting.psf_stamps.probability import State, Weighted, expectation, laplacian
from udccal.fitting.psf_stamps.search import Evidence, improve, start

_ROWS, _N, _RULES = 6, 5, StampsRules()


def dense(band: Band) -> np.ndarray:
    """All of a symmetric matrix whose upper half is a band."""
    size, at = sum(len(row) for row in band), 0
    out = np.zeros((size, size))
    for row in band:
        out[at : at + len(row), at : at + row.shape[1]] = row
        at += len(row)
    return np.triu(out) + np.triu(out, 1).T


def band(seed: int) -> Band:
    """Positive definite, of rows of different length."""
    rng, sizes = np.random.default_rng(seed), [_N] * 3 + [_N - 2] * (_ROWS - 3)
    rows = [rng.standard_normal((n, sum(sizes[i : i + TAPS]))) for i, n in enumerate(sizes)]
    for row in rows:
        row[:, : len(row)] = 40.0 * np.eye(len(row))
    return tuple(rows)


def stamps_and_state() -> tuple[Stamps, State]:
    stamps, _ = make(1, count=12, size=9)
    return stamps, start(stamps, _RULES, 1).with_images(np.eye(3), _RULES)


@pytest.fixture
def weighted() -> tuple[Stamps, State, Weighted]:
    stamps, state = stamps_and_state()
    with jax.enable_x64(True):
        return stamps, state, expectation(stamps, state)


def design(seen: Weighted, basis: np.ndarray, nodes: tuple[int, ...]) -> np.ndarray:
    """Of every sample: weights of all nodes' images, node by node."""
    stars, samples = seen.weight.shape
    out = np.zeros((stars, samples, nodes[0] * nodes[1], basis.shape[1]))
    for i in range(TAPS):
        for j in range(TAPS):
            weight = (seen.seen.down[..., i] * seen.seen.across[..., j])[..., None] * basis[:, None, :]
            index = (seen.seen.first + i * nodes[1] + j)[..., None, None]
            np.put_along_axis(out, index, weight[:, :, None, :], axis=2)
    return out.reshape(stars * samples, -1)


def test_factor_and_solutions_are_those_of_the_dense_matrix() -> None:
    matrix = dense(band(3))
    found = factor(band(3))
    upper = np.triu(dense(found))
    np.testing.assert_allclose(upper.T @ upper, matrix, atol=1e-10)
    right = np.random.default_rng(4).standard_normal((len(matrix), 3))
    solution = divided(found, divided(found, right.copy(), True), False)
    np.testing.assert_allclose(matrix @ solution, right, atol=1e-10)


def test_a_matrix_that_is_not_positive_is_refused() -> None:
    broken = band(3)
    broken[4][:, : len(broken[4])] -= 200 * np.eye(len(broken[4]))
    with pytest.raises(np.linalg.LinAlgError, match="not positive definite"):
        factor(broken)


@pytest.mark.parametrize("margin", [0, 4])
def test_sums_over_samples_are_those_of_the_design(weighted: tuple[Stamps, State, Weighted], margin: int) -> None:
    stamps, state, seen = weighted
    grid, basis = state.field.nodes.shape[2:], polynomials(stamps.unit, 1)
    seen.weight[2, 5] = 0.0
    kept = replace(state, margin=margin).kept
    taps = design(seen, basis, grid)[:, kept.ravel()]
    expected = taps.T @ (seen.weight.ravel()[:, None] * taps)
    found = node_sums(basis, seen, np.flatnonzero(seen.weight), kept)
    np.testing.assert_allclose(dense(found), expected, atol=1e-10 * np.abs(expected).max())


def test_right_sides_and_blocks_are_those_of_the_jacobian(weighted: tuple[Stamps, State, Weighted]) -> None:
    stamps, state, seen = weighted
    _, shared = shared_by(state.field, stamps.unit, 0)
    taps = design(seen, polynomials(stamps.unit, 1), state.field.nodes.shape[2:])
    stars, samples, own = seen.seen.jacobian.shape
    spread = np.zeros((stars, samples, stars, own))
    spread[np.arange(stars), :, np.arange(stars)] = seen.seen.jacobian
    jacobian = spread.reshape(stars * samples, -1) @ shared.toarray()
    normal, weight = normal_equations(stamps, state, seen, 0), seen.weight.ravel()[:, None]
    for found, expected in (
        (normal.cross, taps.T @ (weight * jacobian)),
        (normal.dense, jacobian.T @ (weight * jacobian)),
        (normal.right_nodes, taps.T @ (weight[:, 0] * seen.residual.ravel())),
        (normal.right_dense, jacobian.T @ (weight[:, 0] * seen.residual.ravel())),
    ):
        np.testing.assert_allclose(found, expected, atol=1e-9 * np.abs(expected).max())


def test_the_jacobian_of_the_dense_block_is_that_of_the_expectation() -> None:
    stamps, _ = make(1, count=12, size=9)
    mosaic = replace(stamps, channel=np.arange(12 * 81).reshape(12, 9, 9) % 3)
    state = start(mosaic, _RULES, 1).with_images(np.eye(3), _RULES)
    size = state.maps_from + state.maps
    change = 1e-5 * np.random.default_rng(2).standard_normal(size)
    whole = np.concatenate([change, np.zeros(np.size(state.field.nodes))])
    with jax.enable_x64(True):
        seen = expectation(mosaic, state)
        ends = [mosaic.value_e - expectation(mosaic, state.shifted(s * whole)).residual for s in (1.0, -1.0)]
    for plane in range(3):
        index, shared = shared_by(state.field, mosaic.unit, plane)
        own = (shared @ change[index]).reshape(12, -1)
        expected = np.einsum("kso,ko->ks", seen.seen.jacobian, own)
        seen_here = mosaic.by_plane[plane] & (seen.weight > 0)
        found = (ends[0] - ends[1])[seen_here] / 2
        np.testing.assert_allclose(found, expected[seen_here], atol=1e-4 * np.abs(expected).max())


def test_a_star_that_is_left_out_brings_nothing() -> None:
    stamps, state = stamps_and_state()
    keep = state.keep.copy()
    keep[4] = False
    with jax.enable_x64(True):
        seen, every = expectation(stamps, replace(state, keep=keep)), expectation(stamps, state)
        alone = expectation(stamps, replace(state, keep=~keep))
    assert not seen.weight[4].any()
    assert seen.log_likelihood + alone.log_likelihood == pytest.approx(every.log_likelihood)
    assert seen.weight[3].any()


def test_the_mode_and_its_covariance_are_those_of_equations_written_out() -> None:
    stamps, state = stamps_and_state()
    state = replace(state, precisions=np.append(state.precisions[:-2], [0.2, 0.7]))
    with jax.enable_x64(True):
        found, seen = laplace(stamps, state), expectation(stamps, state)
        normal = normal_equations(stamps, state, seen, 0)
    size, nodes = state.maps_from + state.maps, len(normal.right_nodes)
    matrix, pull = np.zeros((2, size + nodes, size + nodes)), np.zeros(size + nodes)
    matrix[0, :size, :size], matrix[0, size:, size:] = normal.dense, dense(normal.band)
    matrix[0, size:, :size], matrix[0, :size, size:] = normal.cross, normal.cross.T
    scale = np.diag(1 / state.size[0].ravel())
    matrix[1, size - 14 : size, size - 14 : size] = np.diag(np.repeat(state.precisions[-5:-2], [8, 1, 5]))
    rough = laplacian(*state.size.shape[1:])[0].toarray() @ scale
    for term, (a, b) in enumerate(state.of_images[0]):
        image = np.s_[size + term :: 3]
        matrix[1, image, image] = a * scale**2 + b * rough.T @ rough
    background = np.arange(3, 48, 4)
    mean, scatter = state.precisions[-2:]
    matrix[1][np.ix_(background, background)] = scatter * np.eye(12) + (mean - scatter) / 12
    here = np.concatenate([np.zeros(size), np.reshape(state.field.nodes, (3, -1)).T.ravel()])
    pull[: len(normal.right_dense)], pull[size:] = normal.right_dense, normal.right_nodes
    held = np.zeros((3, size + nodes))
    for j in range(3):
        own = np.arange(j, 48, 4)
        held[j, own] = np.sqrt(normal.dense.diagonal()[own].mean())
    whole = matrix.sum(axis=0) + held.T @ held
    mode = np.linalg.solve(whole, pull - matrix[1] @ here)
    np.testing.assert_allclose(found.mode, mode, atol=1e-6 * np.abs(mode).max())
    cost = np.linalg.slogdet(whole)[1] - 2 * seen.log_likelihood - state.volume()[0] + here @ matrix[1] @ here
    assert found.cost == pytest.approx(cost, abs=1e-3)
    cov = np.linalg.inv(whole)
    index = np.array([0, 5, size - 1])
    np.testing.assert_allclose(marginal_cov(found.root, index), cov[np.ix_(index, index)], rtol=1e-6)
    drawn = found.draws(np.random.default_rng(1), 4000)
    np.testing.assert_allclose(drawn.std(axis=1), np.sqrt(cov.diagonal()), rtol=0.06)


def test_the_prior_is_that_of_its_eigenvalues() -> None:
    _, state = stamps_and_state()
    rows, columns = state.size.shape[1:]
    matrix, eigenvalues = laplacian(rows, columns)
    np.testing.assert_allclose(np.linalg.eigvalsh((matrix.T @ matrix).toarray()), np.sort(eigenvalues), atol=1e-9)
    scale = 1 / state.size[0].ravel()
    volume, squares = float(np.log(state.precisions[-5:]) @ [8, 1, 5, 1, 11]), 0.0
    for image, (a, b) in zip(state.field.nodes[0], state.of_images[0], strict=True):
        prior = (a * np.eye(len(scale)) + b * (matrix.T @ matrix).toarray()) * np.outer(scale, scale)
        volume += np.linalg.slogdet(prior)[1]
        squares += image.ravel() @ prior @ image.ravel()
    assert state.volume()[0] == pytest.approx(volume)
    assert state.precisions @ state.squares() == pytest.approx(squares)


def test_squares_that_a_prior_expects_are_its_derivatives() -> None:
    _, state = stamps_and_state()
    for index, precision in enumerate(state.precisions):
        step = 1e-5 * precision * (np.arange(len(state.precisions)) == index)
        up, down = (replace(state, precisions=state.precisions + s * step).volume()[0] for s in (1.0, -1.0))
        assert state.volume()[1][index] == pytest.approx((up - down) / (2e-5 * precision), rel=1e-6)


def test_equations_that_are_singular_have_no_step() -> None:
    stamps, state = stamps_and_state()
    broken = replace(state, precisions=-1e9 * state.precisions)
    with jax.enable_x64(True):
        assert Evidence(stamps, _RULES).equations_at(broken).cost == np.inf
        with pytest.raises(np.linalg.LinAlgError, match="singular"):
            improve(stamps, broken, _RULES, 3)
