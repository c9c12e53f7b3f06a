"""The solver on problems with known minima, and the blocks against the same equations written out in full."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from jaxtyping import Float

from udccal.fitting.engine.gaussian import Prior
from udccal.fitting.engine.least_squares import LOG, Blocks, SolverRules, Step, minimise, solve

Errors = Callable[[Float[np.ndarray, " p"]], Float[np.ndarray, " m"]]


@dataclass(frozen=True)
class Curve:
    """Errors as a function of the parameters, with slopes by differences."""

    errors: Errors
    prior: Prior | None = None
    name: str = "curve"

    def equations_at(self, place: Float[np.ndarray, " p"]) -> Blocks:
        step, here = 1e-6, self.errors(place)
        if not np.isfinite(here).all():
            return Blocks.dense(np.inf, len(here), np.eye(len(place)), np.zeros(len(place)))
        slopes = [(self.errors(place + d) - self.errors(place - d)) / (2 * step) for d in step * np.eye(len(place))]
        blocks = Blocks.of_errors(here, np.stack(slopes, axis=1))
        return blocks.with_prior(self.prior, place) if self.prior else blocks

    def moved(self, place: Float[np.ndarray, " p"], step: Step) -> Float[np.ndarray, " p"]:
        return place + step.shared


def rosenbrock(x: Float[np.ndarray, "2"]) -> Float[np.ndarray, "2"]:
    """More, Garbow and Hillstrom (ACM TOMS 7, 1981), problem 1."""
    return np.array([10 * (x[1] - x[0] ** 2), 1 - x[0]])


def powell(x: Float[np.ndarray, "4"]) -> Float[np.ndarray, "4"]:
    """The same, problem 13: singular at its minimum."""
    return np.array([x[0] + 10 * x[1], 5**0.5 * (x[2] - x[3]), (x[1] - 2 * x[2]) ** 2, 10**0.5 * (x[0] - x[3]) ** 2])


@pytest.mark.parametrize(
    ("errors", "start", "minimum", "within"),
    [
        (rosenbrock, [-1.2, 1.0], [1.0, 1.0], 1e-5),
        (powell, [3.0, -1.0, 0.0, 1.0], [0.0] * 4, 0.1),
        (lambda x: np.array([1e6 * (x[0] - 2), 1e-6 * (x[1] - 5e6)]), [0.0, 0.0], [2.0, 5e6], 1.0),
    ],
)
def test_known_minima_are_found(errors: Errors, start: list[float], minimum: list[float], within: float) -> None:
    found = minimise(Curve(errors), np.array(start), SolverRules(least_gain=1e-12))
    assert found.converged
    assert found.place == pytest.approx(minimum, abs=within)
    assert all(later < earlier for earlier, later in zip(found.history, found.history[1:], strict=False))


def test_a_cap_of_iterations_is_told_as_not_converged() -> None:
    found = minimise(Curve(rosenbrock), np.array([-1.2, 1.0]), SolverRules(iterations=2))
    assert not found.converged
    assert found.iterations == 2


def test_errors_that_are_not_finite_end_where_they_began() -> None:
    found = minimise(Curve(lambda x: np.array([np.nan * x[0]])), np.array([1.0]))
    assert not found.converged
    assert found.place == pytest.approx([1.0])


def test_steps_into_what_is_not_finite_are_taken_back() -> None:
    found = minimise(Curve(lambda x: np.array([np.log(x[0]) if x[0] > 0 else np.inf])), np.array([20.0]))
    assert found.converged
    assert found.place == pytest.approx([1.0], abs=0.01)


def test_a_prior_counts_as_further_data() -> None:
    prior = Prior.independent(np.array([0.0]), np.array([1.0]))
    found = minimise(Curve(lambda x: x - 3.0, prior), np.array([10.0]), SolverRules(least_gain=1e-14))
    assert found.place == pytest.approx([1.5])
    assert found.equations.cov() == pytest.approx(np.array([[0.5]]))


def test_slopes_that_mislead_are_told_as_not_converged() -> None:
    @dataclass(frozen=True)
    class Misled:
        name: str = "misled"

        def equations_at(self, place: Float[np.ndarray, " p"]) -> Blocks:
            return Blocks.of_errors(1e3 * (place - 3.0), np.array([[-1e3]]))

        def moved(self, place: Float[np.ndarray, " p"], step: Step) -> Float[np.ndarray, " p"]:
            return place + step.shared

    found = minimise(Misled(), np.zeros(1))
    assert not found.converged
    assert found.place[0] == 0.0


def test_every_iteration_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.DEBUG, logger=LOG.name):
        found = minimise(Curve(rosenbrock), np.array([-1.2, 1.0]))
    assert sum("iteration" in line for line in caplog.messages) == len(found.history)


def test_the_covariance_is_that_of_many_fits() -> None:
    rng, times = np.random.default_rng(0), np.linspace(0.0, 3.0, 50)

    def fitted() -> tuple[np.ndarray, np.ndarray]:
        y = 100 * np.exp(-1.3 * times) + rng.normal(size=50)
        found = minimise(Curve(lambda x: y - x[0] * np.exp(-x[1] * times)), np.array([90.0, 1.0]))
        return found.place, found.equations.cov()

    found = [fitted() for _ in range(60)]
    spread = np.cov(np.array([place for place, _ in found]).T)
    np.testing.assert_allclose(found[0][1], spread, rtol=0.4)


def _blocks(rng: np.random.Generator, groups: int = 5, shared: int = 3, own: int = 2) -> tuple[Blocks, np.ndarray]:
    """Blocks of a linear problem with the same equations in full; the last group is empty."""
    size = shared + groups * own
    slopes = np.zeros((40, size))
    slopes[:, :shared] = rng.standard_normal((40, shared)) * [1.0, 1e3, 1e-3]
    for row in range(40):
        group = row % (groups - 1)
        slopes[row, shared + group * own : shared + (group + 1) * own] = rng.standard_normal(own)
    errors = rng.standard_normal(40)
    full, right = slopes.T @ slopes, -slopes.T @ errors
    mine = [slice(shared + k * own, shared + (k + 1) * own) for k in range(groups)]
    blocks = Blocks(
        float(errors @ errors),
        40,
        full[:shared, :shared],
        right[:shared],
        np.stack([full[m, m] for m in mine]),
        np.stack([right[m] for m in mine]),
        np.stack([full[:shared, m] for m in mine]),
    )
    return blocks, np.block([[full, right[:, None]]])


def test_elimination_gives_the_step_and_covariance_of_the_full_equations() -> None:
    blocks, whole = _blocks(np.random.default_rng(1))
    used = slice(0, -2)
    full, right = whole[used, used][:, : whole.shape[0] - 2], whole[used, -1]
    expected = np.linalg.solve(full, right)
    step = blocks.step(0.0)
    assert np.concatenate([step.shared, step.own.ravel()])[used] == pytest.approx(expected, rel=1e-8)
    assert step.own[-1] == pytest.approx([0.0, 0.0])
    assert step.gain == pytest.approx(right @ expected, rel=1e-9)
    assert blocks.cov() == pytest.approx(np.linalg.inv(full)[:3, :3], rel=1e-8)
    assert blocks.joint_cov()[used, used] == pytest.approx(np.linalg.inv(full), rel=1e-7, abs=1e-12)


def test_damping_shortens_the_step() -> None:
    blocks, _ = _blocks(np.random.default_rng(2))
    free, damped = blocks.step(0.0), blocks.step(10.0)
    assert np.abs(damped.shared[0]) < np.abs(free.shared[0])
    assert damped.gain < free.gain


def test_held_parameters_stay_and_the_others_step_as_if_they_were_known() -> None:
    blocks, whole = _blocks(np.random.default_rng(3))
    step = replace(blocks, held=np.array([False, True, False])).step(0.0)
    used = [0, 2, *range(3, whole.shape[0] - 2)]
    expected = np.linalg.solve(whole[np.ix_(used, used)], whole[used, -1])
    assert step.shared[1] == 0.0
    assert np.concatenate([step.shared[[0, 2]], step.own.ravel()[:-2]]) == pytest.approx(expected, rel=1e-8)
    assert step.gain == pytest.approx(whole[used, -1] @ expected, rel=1e-9)
    assert step.gain < blocks.step(0.0).gain


def test_equations_that_are_not_finite_are_taken_back_like_costs() -> None:
    @dataclass(frozen=True)
    class Broken:
        name: str = "broken"

        def equations_at(self, place: Float[np.ndarray, " p"]) -> Blocks:
            slope = np.nan if 2.5 < place[0] < 10 else -10.0
            return Blocks.of_errors(10 * (3.0 - place), np.array([[slope]]))

        def moved(self, place: Float[np.ndarray, " p"], step: Step) -> Float[np.ndarray, " p"]:
            return place + step.shared

    found = minimise(Broken(), np.zeros(1))
    assert not found.converged
    assert np.isfinite(found.gain)
    assert 2.0 < found.place[0] <= 2.5
    lost = minimise(Broken(), np.array([5.0]))
    assert not lost.converged
    assert lost.gain == np.inf


@pytest.mark.parametrize("steps", [1, 3, 8])
def test_a_descent_that_was_stopped_has_the_way_left_in_its_error_bars(steps: int) -> None:
    stopped = minimise(Curve(rosenbrock), np.array([-1.2, 1.0]), SolverRules(iterations=steps))
    assert not stopped.converged
    known = 1e-6 * np.eye(2)
    cov = stopped.with_rest(known)
    off = stopped.place - 1.0
    assert off @ np.linalg.solve(known, off) > 4.5**2
    assert np.all(np.abs(off) < 4.5 * np.sqrt(np.diag(cov)))
    ended = minimise(Curve(rosenbrock), np.array([-1.2, 1.0]), SolverRules(least_gain=1e-12))
    assert ended.with_rest(known) == pytest.approx(known, abs=1e-6)


@pytest.mark.filterwarnings("error")
def test_parameters_without_information_of_their_own_stay() -> None:
    matrix = np.array([[1e20, 0.0, 0.0], [0.0, 0.0, 1e10], [0.0, 1e10, 0.0]])
    assert solve(matrix, np.array([2e20, 0.0, 0.0])) == pytest.approx([2.0, 0.0, 0.0])
