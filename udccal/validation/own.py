"""Which captures of a session a term of a profile was fitted to, as far as the profile tells."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

from udccal.result import FitResult
from udccal.sessions.evidence import captures_of, step_digest
from udccal.sessions.schema import StoredStep


@final
@dataclass(frozen=True)
class Fitted:
    """How many of a session's ``steps`` of a term the fit used; ``whole`` where it used these and no others."""

    count: int
    steps: int
    whole: bool

    @property
    def partly(self) -> bool:
        """Whether some of the captures are those of the fit, beside others or without others of the fit."""
        return self.count > 0 and not self.whole


def fitted_steps(result: FitResult, steps: Sequence[StoredStep], same_session: bool) -> Fitted:
    """Count the steps of a session that a term was fitted to.

    Where the profile names no captures, those of its very session are its own. Where it does not name single steps,
    as older ones do not, only all of the steps together can be told. A session with other terms beside them has the
    same captures.
    """
    if not steps or result.captures is None:
        own = bool(steps) and same_session
        return Fitted(len(steps) if own else 0, len(steps), own)
    if result.captures.sha256 == captures_of(steps).sha256:
        return Fitted(len(steps), len(steps), True)
    known = frozenset(result.captures.steps or ())
    return Fitted(sum(step_digest(step) in known for step in steps), len(steps), False)
