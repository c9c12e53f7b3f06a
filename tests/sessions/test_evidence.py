"""The digest of a term's captures: the same for the same files, whatever the session; another for others."""

from __future__ import annotations

from dataclasses import replace

from udccal.effort import QUICK, FitEffort
from udccal.sessions.evidence import captures_of
from udccal.sessions.schema import DarkSubject, PanelSubject, StoredCapture, StoredRegion, StoredStep


def step(
    name: str,
    *sums: str,
    gain_dB: float = 0.0,
    at: str = "2026-01-01T00:00:00+00:00",
    temperature_C: float | None = None,
) -> StoredStep:
    region = StoredRegion(x=0, y=0, columns=4, rows=4)
    captures = tuple(
        StoredCapture(
            kind="average", file=f"{name}/{i}.exr", sha256=one * 64, frames=8, exposure_s=0.01, gain_dB=gain_dB,
            region=region, first_timestamp_s=0.0, last_timestamp_s=1.0, temperature_C=temperature_C,
        )
        for i, one in enumerate(sums)
    )  # fmt: skip
    return StoredStep(id=f"noise/{name}", term="noise", subject=DarkSubject(), completed_at=at, captures=captures)


def test_the_digest_is_of_the_files_and_not_of_their_order_or_names() -> None:
    one = captures_of([step("a", "1", "2"), step("b", "3")])
    assert one == replace(captures_of([step("c", "3"), step("d", "2", "1")]), sha256=one.sha256)
    assert one.sha256 == captures_of([step("c", "3"), step("d", "2", "1")]).sha256
    assert one.sha256 != captures_of([step("a", "1", "2"), step("b", "4")]).sha256
    assert one.sha256 != captures_of([step("a", "1", "2")]).sha256


def test_the_panels_picture_counts() -> None:
    shown = [
        step("a", "1").model_copy(
            update={"subject": PanelSubject(picture="p/x.png", picture_sha256=s * 64, role="white")}
        )
        for s in "56"
    ]
    assert captures_of(shown[:1]).sha256 != captures_of(shown[1:]).sha256
    assert captures_of(shown[:1]).files == 2


def test_counts_gains_and_times_are_those_of_all_steps() -> None:
    found = captures_of([step("a", "1", gain_dB=6.0, at="2026-01-02T00:00:00+00:00"), step("b", "2", "3")])
    assert (found.files, found.frames, found.gain_dB, found.temperature_C) == (3, 24, (0.0, 6.0), None)
    assert found.completed_at == ("2026-01-01T00:00:00+00:00", "2026-01-02T00:00:00+00:00")


def test_the_temperature_is_that_of_the_captures_which_have_one() -> None:
    steps = [step("a", "1", temperature_C=38.5), step("b", "2"), step("c", "3", temperature_C=36.0)]
    assert captures_of(steps).temperature_C == (36.0, 38.5)


def test_a_quick_fit_can_be_told() -> None:
    efforts = (FitEffort(), FitEffort(workers=1), QUICK, replace(QUICK, workers=1), FitEffort(wire_samples=1000))
    assert [effort.label for effort in efforts] == ["full", "full", "quick", "quick", "own"]
