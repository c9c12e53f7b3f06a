"""The equations of a psf field in stamps: sums over samples and factors, against dense matrices."""

from __future__ import annotations

from dataclasses import replace

import jax
import numpy as np
import pytest

from tests.fitting.psf_stamps.test_psf_stamps import make
from udccal.fitting.psf_stamps.banded import AHEAD, Band, band_of, factor, node_sums
from udccal.fitting.psf_stamps.data import Scene, StampsRules, split
from udccal.fitting.psf_stamps.equations import factors, marginal_cov, normal_equations, shared_by
from udccal.fitting.psf_stamps.field import TAPS, polynomials
from udccal.fitting.psf_stamps.orders import start, with_degrees
from udccal.fitting.psf_stamps.probability import State, Weighted, expectation
from udccal.fitting.psf_stamps.solve import Evidence, improve

_ROWS, _N = 6, 5


def dense(band: Band) -> np.ndarray:
    """All of a symmetric matrix whose upper half is a band's."""
    rows, n = band.diagonal.shape[:2]
    out = np.zeros(((rows + AHEAD) * n, (rows + AHEAD) * n))
    for i in range(rows):
        out[i * n : (i + 1) * n, i * n : (i + 1) * n] = np.triu(band.diagonal[i])
        out[i * n : (i + 1) * n, (i + 1) * n : (i + 1 + AHEAD) * n] = band.beyond[i]
    out = out[: rows * n, : rows * n]
    return out + np.triu(out, 1).T


def band(seed: int) -> Band:
    """Positive definite."""
    rng = np.random.default_rng(seed)
    beyond = rng.standard_normal((_ROWS, _N, AHEAD * _N))
    for i in range(1, AHEAD + 1):
        beyond[-i, :, (i - 1) * _N :] = 0
    return Band(np.tile(40.0 * np.eye(_N), (_ROWS, 1, 1)) + rng.uniform(0, 0.1), beyond)


def scene_and_state() -> tuple[Scene, State]:
    stamps, _ = make(1, count=12, size=9)
    unit = 2 * stamps.position_px / np.array([1000, 800]) - 1
    scene = Scene(split(stamps), unit, (9, 9), stamps.read_e, stamps.clip_e)
    return scene, with_degrees(start(scene, StampsRules()), 1, 1, StampsRules())


@pytest.fixture
def weighted() -> tuple[Scene, State, Weighted]:
    scene, state = scene_and_state()
    with jax.enable_x64(True):
        return scene, state, expectation(scene, state, 0)[0]


def design(seen: Weighted, basis: np.ndarray, nodes: tuple[int, int]) -> np.ndarray:
    """Of every sample: weights of all nodes' images, node by node."""
    stars, samples = seen.mean.shape
    out = np.zeros((stars, samples, nodes[0] * nodes[1], basis.shape[1]))
    for i in range(TAPS):
        for j in range(TAPS):
            weight = (seen.down[..., i] * seen.across[..., j])[..., None] * basis[:, None, :]
            np.put_along_axis(out, (seen.first + i * nodes[1] + j)[..., None, None], weight[:, :, None, :], axis=2)
    return out.reshape(stars * samples, -1)


def test_factor_solutions_and_determinant_are_those_of_the_dense_matrix() -> None:
    matrix = dense(band(3))
    found = factor(band(3))
    upper = np.triu(dense(found))
    np.testing.assert_allclose(upper.T @ upper, matrix, atol=1e-10)
    right = np.random.default_rng(4).standard_normal((_ROWS * _N, 3))
    solution = found.backward(found.forward(right.copy()))
    np.testing.assert_allclose(matrix @ solution, right, atol=1e-10)
    assert found.log_det == pytest.approx(np.linalg.slogdet(matrix)[1])


def test_a_matrix_that_is_not_positive_is_refused() -> None:
    broken = band(3)
    broken.diagonal[4] -= 200 * np.eye(_N)
    with pytest.raises(np.linalg.LinAlgError, match="row 4 of nodes"):
        factor(broken)


def test_sums_over_samples_are_those_of_the_design(weighted: tuple[Scene, State, Weighted]) -> None:
    scene, state, seen = weighted
    grid = state.fields[0].nodes.shape[1:]
    basis = polynomials(scene.unit, 1)
    seen.weight[2, 5] = 0.0
    taps = design(seen, basis, grid)
    expected = taps.T @ (seen.weight.ravel()[:, None] * taps)
    np.testing.assert_allclose(
        dense(band_of(node_sums(basis, seen, grid))), expected, atol=1e-10 * np.abs(expected).max()
    )


def test_right_sides_and_blocks_are_those_of_the_jacobian(weighted: tuple[Scene, State, Weighted]) -> None:
    scene, state, seen = weighted
    field, shared = state.fields[0], shared_by(state.fields, scene.unit)[0]
    taps = design(seen, polynomials(scene.unit, 1), field.nodes.shape[1:])
    stars, samples, own = seen.slopes.shape
    spread = np.zeros((stars, samples, stars, own))
    spread[np.arange(stars), :, np.arange(stars)] = seen.slopes
    jacobian = spread.reshape(stars * samples, -1) @ shared.matrix.toarray()
    normal, weight = normal_equations(field, scene.unit, seen, shared.matrix), seen.weight.ravel()[:, None]
    for found, expected in (
        (normal.cross, taps.T @ (weight * jacobian)),
        (normal.dense, jacobian.T @ (weight * jacobian)),
        (normal.right_nodes, taps.T @ (weight[:, 0] * seen.residual.ravel())),
        (normal.right_dense, jacobian.T @ (weight[:, 0] * seen.residual.ravel())),
    ):
        np.testing.assert_allclose(found, expected, atol=1e-9 * np.abs(expected).max())


def test_the_jacobian_of_the_dense_block_is_that_of_the_expectation() -> None:
    scene, state = scene_and_state()
    shared = shared_by(state.fields, scene.unit)[0]
    change = 1e-5 * np.random.default_rng(2).standard_normal(shared.size)
    with jax.enable_x64(True):
        seen, _ = expectation(scene, state, 0)
        whole = np.concatenate([change, np.zeros(np.size(state.fields[0].nodes))])
        ends = [expectation(scene, state.shifted(s * whole), 0)[0].mean for s in (1.0, -1.0)]
    own = (shared.matrix @ change[shared.index]).reshape(len(scene.unit), -1)
    expected = np.einsum("kso,ko->ks", seen.slopes, own)
    np.testing.assert_allclose((ends[0] - ends[1]) / 2, expected, atol=1e-4 * np.abs(expected).max())


def test_a_star_that_is_left_out_brings_nothing() -> None:
    scene, state = scene_and_state()
    keep = state.keep[0].copy()
    keep[4] = False
    with jax.enable_x64(True):
        seen, likelihood = expectation(scene, replace(state, keep=(keep,)), 0)
    assert not seen.weight[4].any()
    assert not likelihood[4].any()
    assert seen.weight[3].any()


def test_the_mode_and_its_covariance_are_those_of_equations_written_out() -> None:
    scene, state = scene_and_state()
    with jax.enable_x64(True):
        found, (seen, _) = factors(scene, state), expectation(scene, state, 0)
        shared = shared_by(state.fields, scene.unit)[0]
        normal = normal_equations(state.fields[0], scene.unit, seen, shared.matrix)
    size, nodes = shared.size, len(normal.right_nodes)
    matrix, pull = np.zeros((2, size + nodes, size + nodes)), np.zeros(size + nodes)
    matrix[0, :size, :size], matrix[0, size:, size:] = normal.dense, dense(band_of(normal.sums))
    matrix[0, size:, :size], matrix[0, :size, size:] = normal.cross, normal.cross.T
    env, own = state.envelopes[0], state.precisions[0]
    matrix[1, size - 8 : size, size - 8 : size] = np.diag(own.of_maps)
    for term, (a, b) in enumerate(own.image[[0, 1, 1]]):
        image = np.s_[size + term :: 3]
        matrix[1, image, image] = np.diag(a / env.size.ravel() ** 2) + b * env.roughness.toarray()
    here = np.concatenate([np.zeros(size), np.reshape(state.fields[0].nodes, (3, -1)).T.ravel()])
    pull[: len(normal.right_dense)], pull[size:] = normal.right_dense, normal.right_nodes
    held = np.zeros((3, size + nodes))
    for j in range(3):
        own = np.arange(j, 36, 3)
        held[j, own] = np.sqrt(normal.dense.diagonal()[own].mean())
    whole = matrix.sum(axis=0) + held.T @ held
    mode = np.linalg.solve(whole, pull - matrix[1] @ here)
    np.testing.assert_allclose(found.mode, mode, atol=1e-6 * np.abs(mode).max())
    assert found.log_det == pytest.approx(np.linalg.slogdet(whole)[1], rel=1e-9)
    cov = np.linalg.inv(whole)
    index = np.array([0, 5, size - 1])
    np.testing.assert_allclose(marginal_cov(found.root, index), cov[np.ix_(index, index)], rtol=1e-6)
    drawn = found.draws(np.random.default_rng(1), 4000)
    np.testing.assert_allclose(drawn.std(axis=1), np.sqrt(cov.diagonal()), rtol=0.06)


def test_equations_that_are_singular_have_no_step() -> None:
    scene, state = scene_and_state()
    broken = replace(state, precisions=tuple(own.times(np.full(len(own.flat), -1e9)) for own in state.precisions))
    with jax.enable_x64(True):
        assert Evidence(scene, StampsRules()).equations_at(broken).cost == np.inf
        with pytest.raises(np.linalg.LinAlgError, match="singular"):
            improve(scene, broken, StampsRules(), 3)
