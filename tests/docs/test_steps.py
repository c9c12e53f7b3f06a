"""The steps that docs/cli.md lists are those that a person is led through."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from udccal.guide.capture import guided_steps
from udccal.guide.steps import GuidedStep
from udccal.rig import load_rig

PAGE = Path(__file__).resolve().parents[2] / "docs" / "cli.md"
STEPS = guided_steps(load_rig("lg55-aca2040"))


def steps_table(steps: Iterable[GuidedStep]) -> str:
    """A line per step; of the LED's cells, the first stands for all."""
    lines = ["| step | what to set up | why | frames | goes on |", "| --- | --- | --- | ---: | --- |"]
    for step in steps:
        if step.term == "psf" and step.id != "psf/p00":
            continue
        goes_on = "by itself" if step.by_itself else "by Enter"
        lines.append(f"| {step.title} | {step.instruction} | {step.why} | {step.frames} | {goes_on} |")
    return "\n".join(lines)


def test_the_steps_are_those_of_the_guide() -> None:
    page = PAGE.read_text(encoding="utf-8")
    assert steps_table(STEPS) in page
    cells = sum(step.term == "psf" for step in STEPS)
    waiting = sum(not step.by_itself for step in STEPS)
    assert f"has {len(STEPS)} steps, of which {waiting} wait for Enter; the {cells} cells" in " ".join(page.split())


def test_another_step_would_be_missed() -> None:
    assert steps_table(STEPS[1:]) not in PAGE.read_text(encoding="utf-8")
