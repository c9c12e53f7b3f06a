"""The steps that a rig plans, by their ids: what a session should have."""

from __future__ import annotations

from collections.abc import Set

from udccal.errors import UdccalError
from udccal.plugins import find_procedure
from udccal.rig import RigDescription
from udccal.sessions.schema import TermName

# Nothing but a step's own picture depends on the panel's size: pictures are drawn this small for counting.
_COUNTING_PX = 8
_NAMED = 6


def with_small_panel(rig: RigDescription) -> RigDescription:
    """Return a rig with a tiny panel, on which the frames and exposures of its steps do not depend."""
    panel = rig.panel.model_copy(update={"columns": _COUNTING_PX, "rows": _COUNTING_PX})
    return rig.model_copy(update={"panel": panel})


def planned_ids(term: TermName, rig: RigDescription) -> list[str]:
    """Return the ids of the steps that a term's procedure plans for a rig, in the order of their capture.

    Raises:
        UdccalError: when no procedure of the term is installed.
    """
    return [step.id for step in find_procedure(term)().steps(with_small_panel(rig))]


def skipped_note(term: TermName, rig: RigDescription, captured: Set[str]) -> str:
    """Return a sentence that counts the planned steps of a term and names the skipped ones; empty where none is.

    Args:
        term: its procedure says what is planned; nothing is where none is installed.
        rig: with the captures that were wanted.
        captured: ids of the steps that a session has.
    """
    try:
        planned = planned_ids(term, rig)
    except UdccalError:
        return ""
    skipped = [step_id for step_id in planned if step_id not in captured]
    # Steps of other names are another program's, whose plan is not known.
    if not skipped or not captured <= set(planned):
        return ""
    more = f" and {len(skipped) - _NAMED} more" if len(skipped) > _NAMED else ""
    done = len(planned) - len(skipped)
    return f"{done} of {len(planned)} planned steps captured, without {', '.join(skipped[:_NAMED])}{more}."
