"""Up to two hundred broken inputs for every target, made of whole ones, and every input that once was trouble."""

from __future__ import annotations

import time
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.fuzz.target import Target
from tests.fuzz.targets import TARGETS
from udccal.errors import CameraError

KEPT = Path(__file__).with_name("kept")


@st.composite
def broken(draw: st.DrawFn, seeds: tuple[bytes, ...]) -> bytes:
    """A whole example with some bytes changed, a piece taken out or doubled, or cut short."""
    data = bytearray(draw(st.sampled_from(seeds)))
    for place, value in draw(
        st.lists(st.tuples(st.integers(0, max(len(data) - 1, 0)), st.integers(0, 255)), max_size=6)
    ):
        data[place] = value
    start, end = sorted(draw(st.tuples(st.integers(0, len(data)), st.integers(0, len(data)))))
    match draw(st.sampled_from(["as it is", "without", "twice", "cut"])):
        case "without":
            del data[start:end]
        case "twice":
            data[start:start] = data[start:end]
        case "cut":
            del data[start:]
    return bytes(data)


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=pytest.mark.medium if target.one_in > 1 else ()) for name, target in TARGETS.items()],
)
def test_broken_inputs_are_refused_in_words(name: str) -> None:
    target = TARGETS[name]
    for seed in target.seeds():
        target.read(seed)  # the whole ones are taken

    # Each that restores may compile for seconds; `make fuzz` tries a hundred thousand.
    examples = max(15, 200 // target.one_in)

    @settings(max_examples=examples, suppress_health_check=list(HealthCheck))
    @given(broken(target.seeds()))
    def try_out(data: bytes) -> None:
        start = time.process_time()
        target.try_out(data[: target.max_bytes])
        # The processor's time, so that a busy machine fails nobody.
        assert time.process_time() - start < target.longest_s

    try_out()


@pytest.mark.parametrize("path", sorted(KEPT.glob("*/*")), ids=lambda path: f"{path.parent.name}-{path.name}")
def test_what_once_was_trouble_is_refused_in_words(path: Path) -> None:
    TARGETS[path.parent.name].try_out(path.read_bytes())


def test_a_reader_that_breaks_is_noticed() -> None:
    def read(data: bytes) -> None:
        if data[:1] == b"!":
            raise KeyError("no such thing")
        if data[:1] == b"?":
            raise CameraError("Nope.")

    target = Target("bad", read, lambda: (b"x",))
    target.try_out(b"x")
    with pytest.raises(KeyError):
        target.try_out(b"!")
    with pytest.raises(AssertionError, match="expected a sentence"):
        target.try_out(b"?")
