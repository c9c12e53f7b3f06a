"""Plans a capture and prints the plan as tables or as JSON."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import final, get_args

from udccal.cli.jobs.apart import check_apart
from udccal.cli.output import Output
from udccal.compilation import keep_compilations
from udccal.errors import RigError
from udccal.planning.design import Suggestion
from udccal.planning.plan import CapturePlan, TermPlan, make_plan, parse_targets
from udccal.planning.rig_file import check_absent, write_planned_rig
from udccal.planning.state import RigState, measured_state, nominal_state
from udccal.planning.steps import Cost
from udccal.profiles.store import RIG_PROFILE, find_profile, read_profile
from udccal.reports.tables import Table
from udccal.rig import RigDescription, load_rig
from udccal.rig_folders import find_rig
from udccal.sessions.schema import TermName


@final
@dataclass(frozen=True)
class Number:
    """One number of the planned captures block."""

    name: str
    value: float


@final
@dataclass(frozen=True)
class PlanSummary:
    """Result of ``plan``."""

    rig: str
    profile: Path | None
    reached: bool
    cost: Cost
    cost_before: Cost
    terms: tuple[TermPlan, ...]
    untouched: tuple[TermName, ...]
    per_second: Suggestion | None
    per_set_up: Suggestion | None
    captures: tuple[Number, ...]
    out: Path | None


def plan_captures(output: Output, rig_name: str, words: Sequence[str], profile: Path | None, out: Path | None) -> bool:
    """Plan, print, and write the rig with the planned captures; return whether every target is reached.

    Args:
        output: shows stages, tables and sentences.
        rig_name: name or folder of the rig.
        words: targets, each ``term=value`` with its unit, such as ``wire=0.05%``.
        profile: profile whose measured values to use; None for that in the rig's folder, if there is one.
        out: ``rig.toml`` to write; None to write none.

    Raises:
        UdccalError: when a target cannot be read, or a procedure is missing.
        RigError: when the rig is not known, or ``out`` exists.
        ProfileError, SessionError: when ``out`` is in a profile or a session.
        ProfileError: when the profile cannot be read.
    """
    targets = parse_targets(words)
    rig = load_rig(rig_name)
    if out is not None:
        check_absent(out)
        check_apart(out)
    keep_compilations()
    path = _profile_path(rig_name, profile)
    state = nominal_state(rig) if path is None else _measured(rig, path)
    with output.stage("planning") as stage:

        def progress(term: TermName) -> None:
            stage.update(list(targets).index(term), len(targets), f"planning {term}")

        made = make_plan(state, targets, progress)
    _show(output, made)
    if out is not None:
        write_planned_rig(rig_name, made.captures, out)
        output.say(f"Rig with these captures: {out}")
    numbers = tuple(Number(name, value) for name, value in made.captures.model_dump().items())
    output.result(
        PlanSummary(
            rig=rig.name,
            profile=path,
            reached=made.reached,
            cost=made.cost,
            cost_before=made.cost_before,
            terms=made.terms,
            untouched=made.untouched,
            per_second=made.per_second,
            per_set_up=made.per_set_up,
            captures=numbers,
            out=out,
        )
    )
    return made.reached


def _profile_path(rig_name: str, profile: Path | None) -> Path | None:
    """Return the requested profile, or the one in the rig's folder."""
    if profile is not None:
        return find_profile(profile)
    beside = find_rig(rig_name) / RIG_PROFILE
    return beside if beside.exists() else None


def _measured(rig: RigDescription, path: Path) -> RigState:
    profile = read_profile(path)
    if profile.rig.name != rig.name or profile.rig.camera != rig.camera or profile.rig.panel != rig.panel:
        raise RigError(
            f"Expected a profile of the rig '{rig.name}' at {path}, found one of '{profile.rig.name}'"
            f"{' with another camera or panel' if profile.rig.name == rig.name else ''}. Give that rig's profile."
        )
    return measured_state(rig, profile)


def _show(output: Output, made: CapturePlan) -> None:
    rows = tuple(
        (
            term.term,
            _amount(term.target, term.unit),
            _amount(term.sigma, term.unit),
            _amount(term.floor, term.unit) if term.floor > 0 else "–",
            "; ".join(
                f"{s.name} {s.planned}" + (f" (now {s.before})" if s.planned != s.before else "") for s in term.settings
            ),
            str(term.cost.frames),
            _duration(term.cost.seconds),
            str(term.cost.set_ups),
        )
        for term in made.terms
    )
    head = ("term", "target", "sigma", "floor", "captures", "frames", "camera", "set-ups")
    output.table(Table("Planned captures", head, rows, frozenset({1, 2, 3, 5, 6, 7})))
    additions = tuple(
        (
            term.term,
            what,
            _addition(one),
            f"{one.gain_percent:.2g} %",
            _duration(one.cost.seconds),
            str(one.cost.set_ups),
        )
        for term in made.terms
        for what, one in (("second", term.per_second), ("set-up", term.per_set_up))
        if one is not None
    )
    if additions:
        columns = ("term", "most per", "addition", "sigma falls by", "camera", "set-ups")
        output.table(Table("Effect of one further addition", columns, additions, frozenset({3, 4, 5})))
    for sentence in _sentences(made):
        output.say(sentence)


def _sentences(made: CapturePlan) -> list[str]:
    said = [_out_of_reach(term) for term in made.terms if not term.reached]
    if made.untouched:
        said.append(f"Terms without a target keep the rig's captures: {', '.join(made.untouched)}.")
    before, after = made.cost_before, made.cost
    said.append(
        f"All {len(get_args(TermName))} terms: {after.frames} frames in {_duration(after.seconds)} of the camera's "
        f"time, {after.set_ups} set-ups (now {before.frames} frames, {_duration(before.seconds)}, "
        f"{before.set_ups})."
    )
    for what, one in (("second of capture", made.per_second), ("set-up", made.per_set_up)):
        if one is not None:
            said.append(
                f"Largest gain per {what}: {_addition(one)} lowers the sigma of {one.term} by {one.gain_percent:.2g} %."
            )
    return said


def _out_of_reach(term: TermPlan) -> str:
    target = _amount(term.target, term.unit)
    if term.floor >= term.target:
        return (
            f"{term.term}: no number of captures reaches {target}; the floor is {_amount(term.floor, term.unit)}. "
            f"{term.lowered_by}"
        )
    left = "" if not term.lowered_by else f" {term.lowered_by}"
    return (
        f"{term.term}: {target} is so near the floor ({_amount(term.floor, term.unit)}) that no "
        f"capture of a reasonable length reaches it.{left}"
    )


def _addition(one: Suggestion) -> str:
    return f"{one.setting.name} {one.setting.before} to {one.setting.planned}"


def _amount(value: float, unit: str) -> str:
    return f"{value:.3g} {unit}" if math.isfinite(value) else "not known"


def _duration(seconds: float) -> str:
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s"
