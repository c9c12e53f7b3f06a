"""Prints the doctor's findings as a table or as JSON."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

from udccal.cli.output import Output
from udccal.doctor.examine import Wanted, examine
from udccal.doctor.finding import Finding, Status
from udccal.reports.tables import Table

_EXAMPLE = "udccal doctor --rig NAME --session FOLDER --camera u3v --display window"


@final
@dataclass(frozen=True)
class DoctorSummary:
    """Result of ``doctor``; ``ready`` is false when something that the user asked for cannot work."""

    ready: bool
    findings: tuple[Finding, ...]


def report(output: Output, wanted: Wanted) -> bool:
    """Examine this computer, print the findings to ``output``, and return whether everything in ``wanted`` can work."""
    with output.stage("looking"):
        findings = examine(wanted)
    rows = tuple((finding.topic, finding.status.value, finding.found) for finding in findings)
    output.table(Table("This computer", ("topic", "status", "found"), rows))
    problems = [finding for finding in findings if finding.status is Status.PROBLEM]
    for finding in findings:
        if finding.advice:
            output.say(f"\n{finding.topic} ({finding.status.value}):\n{finding.advice}")
    output.say(f"\n{_verdict(wanted, problems)}")
    output.result(DoctorSummary(not problems, findings))
    return not problems


def _verdict(wanted: Wanted, problems: list[Finding]) -> str:
    if problems:
        topics = ", ".join(finding.topic for finding in problems)
        return f"Not ready: {topics}. Follow the advice above, then run this again."
    if wanted == Wanted():
        return f"No problem found. Before a capture, ask for what it needs, for example: {_EXAMPLE}"
    return "Ready for what you asked for."
