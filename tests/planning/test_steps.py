"""Counted frames against those that a capture on a simulated rig takes."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest

from procedures.plans import Bracket, Fixed, Metered, Singles, Stack, TimesThatOf
from tests.procedures.benches import new_writer, simulated_bench, small_rig
from udccal.benches.capture import TERMS
from udccal.errors import UdccalError
from udccal.guide.capture import guided_steps
from udccal.planning import steps
from udccal.planning.state import nominal_state
from udccal.plugins import find_procedure
from udccal.rig import load_rig
from udccal.sessions.schema import TermName


@pytest.mark.parametrize("term", ["noise", "wire", "psf"])
def test_frames_are_those_of_a_session(term: TermName, tmp_path: Path) -> None:
    rig = small_rig()
    with simulated_bench(rig) as bench, new_writer(tmp_path / "session", rig, bench) as writer:
        find_procedure(term)().run(bench.camera, bench.display, bench.stage, writer)
        kept = sum(capture.frames for step in writer.manifest.steps for capture in step.captures)
        taken = bench.camera.counts.delivered
    cost = nominal_state(rig).cost(term)
    tested = sum(step.test_frames for step in nominal_state(rig).steps(term))
    assert cost.frames - tested == kept
    # Metering takes a frame more or less.
    assert cost.frames == pytest.approx(taken, rel=0.25)


@pytest.mark.parametrize("term", TERMS)
def test_set_ups_are_those_that_a_person_is_led_through(term: TermName) -> None:
    rig = small_rig()
    assert nominal_state(rig).cost(term).set_ups == len(guided_steps(rig, [term]))


def test_further_shifts_and_views_ask_for_no_further_set_up() -> None:
    state = nominal_state(load_rig("lg55-aca2040"))
    assert sum(state.cost(term).set_ups for term in TERMS) == 42
    captures = state.rig.captures
    more = state.with_captures(
        captures.model_copy(update={"psf_shifts": captures.psf_shifts + 1, "board_views": captures.board_views + 1})
    )
    for term in TERMS:
        assert more.cost(term).set_ups == state.cost(term).set_ups


def test_no_frame_is_quicker_than_its_exposure_or_the_camera() -> None:
    state = nominal_state(small_rig())
    rate = state.rig.camera.frame_rate_hz
    cost = state.cost("noise")
    assert cost.seconds > cost.frames / rate
    # The long dark frames: 0.25 s, 1 s and 4 s, two each and one to look at.
    assert cost.seconds > 3 * 5.25


def test_more_flats_take_as_much_longer() -> None:
    state = nominal_state(small_rig())
    more = state.with_captures(state.rig.captures.model_copy(update={"flats": 112}))
    change = more.cost("wire") - state.cost("wire")
    assert change.frames == 100
    assert change.set_ups == 0
    assert change.seconds == pytest.approx(100 / state.rig.camera.frame_rate_hz)


def test_plans_count_their_frames() -> None:
    assert Stack(7).exposures_s(0.1, 1.0) == 7 * (0.1,)
    assert Singles(2).exposures_s(0.1, 1.0) == (0.1, 0.1)
    assert Bracket(4).exposures_s(0.1, 10.0) == pytest.approx((0.1, 0.4, 1.6, 6.4))
    # The last is the longest that the camera has; there are no further.
    assert Bracket(6).exposures_s(0.1, 1.0) == pytest.approx((0.1, 0.4, 1.0))


def test_exposures_follow_the_steps_before() -> None:
    first = Metered(0.5).planned(0.02, {})
    twice = TimesThatOf("a", 2.0).planned(0.02, {"a": first})
    assert (twice.exposure_s, twice.level, twice.test_frames) == (0.04, 1.0, 1)
    assert Fixed(4.0).planned(0.02, {}).level is None
    assert TimesThatOf("a", 2.0).planned(0.02, {"a": Fixed(4.0).planned(0.0, {})}).level is None


@pytest.mark.parametrize("missing", ["plan", "exposure"])
def test_a_procedure_that_does_not_tell_is_named(missing: str, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = next(iter(find_procedure("wire")().steps(small_rig())))
    parts = {name: getattr(whole, name) for name in ("id", "arrangement", "instruction", "region", "exposure", "plan")}
    step = SimpleNamespace(**(parts | {missing: object()}))
    monkeypatch.setattr(steps, "find_procedure", lambda term: lambda: SimpleNamespace(steps=lambda rig: [step]))
    with pytest.raises(UdccalError, match="Expected the step 'wire/flat' to tell"):
        list(nominal_state(small_rig()).steps("wire"))
