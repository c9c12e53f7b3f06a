"""What a session lacks for the fit of a term: a step that was skipped may leave a term without what its fit needs."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from udccal.fitting.backscatter.parameters import BackscatterRules
from udccal.fitting.noise.data import NoiseRules
from udccal.fitting.psf.data import PsfRules, group
from udccal.sessions.schema import BoardSubject, DarkSubject, FlatSubject, LedSubject, PanelSubject, TermName
from udccal.sessions.store import Session

_LEAST_DARKS = 2


def lacking(session: Session, term: TermName) -> str:
    """Return what the fit of a term cannot do without and the session does not have, in words; empty where nothing is.

    What was captured badly is not lacking: the fit says what is wrong with it.
    """
    match term:
        case "noise":
            return ", ".join(filter(None, _lacking_noise(session)))
        case "geometry":
            boards = (step.subject for step in session.steps(term))
            on_jig = any(isinstance(board, BoardSubject) and board.parallel_to_panel for board in boards)
            return "" if on_jig else "a view of the board on the jig, parallel to the display"
        case "wire":
            captured = {step.id for step in session.steps(term)}
            return ", ".join(step_id for step_id in ("wire/flat", "wire/dark") if step_id not in captured)
        case "psf":
            leds = [step.subject for step in session.steps(term)]
            aims = np.array([(led.x_px, led.y_px) for led in leds if isinstance(led, LedSubject)]).reshape(-1, 2)
            return _fewer("places of the LED", len(set(group(aims))), PsfRules().least_positions)
        case "backscatter":
            return ", ".join(filter(None, _lacking_pictures(session)))


def _lacking_noise(session: Session) -> Iterator[str]:
    levels = [step.subject for step in session.steps("noise") if not step.id.endswith("_stack")]
    flats, darks = (sum(isinstance(one, kind) for one in levels) for kind in (FlatSubject, DarkSubject))
    yield _fewer("exposures of the even light", flats, NoiseRules().levels)
    yield _fewer("exposures in the dark", darks, _LEAST_DARKS)


def _lacking_pictures(session: Session) -> Iterator[str]:
    subjects = [step.subject for step in session.steps("backscatter")]
    pictures = [subject for subject in subjects if isinstance(subject, PanelSubject)]
    white = sum(picture.role == "white" for picture in pictures)
    yield "" if white else "backscatter/white"
    yield "" if any(isinstance(subject, DarkSubject) for subject in subjects) else "backscatter/dark"
    yield _fewer("pictures beside the white one", len(pictures) - white, BackscatterRules().fewest_pictures)


def _fewer(what: str, found: int, least: int) -> str:
    return f"{least - found} more {what}" if found < least else ""
