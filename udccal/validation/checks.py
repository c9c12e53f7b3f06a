"""One check of a prediction, and what a term's checks and map are."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float
from scipy.special import chdtri

from udccal.sessions.schema import TermName
from udccal.validation.limits import ValidationLimits


@final
@dataclass(frozen=True)
class Check:
    """One number of a prediction against its limit.

    Attributes:
        name: what is checked; NOT_CAPTURED where there is nothing to check.
        value, limit: in ``unit``; None where there is none.
        ok: whether the value is at most the limit; None where the check does not count.
        what: one plain sentence.
    """

    term: TermName
    name: str
    value: float | None
    limit: float | None
    unit: str
    ok: bool | None
    what: str


@final
@dataclass(frozen=True)
class ZMap:
    """Errors of a prediction in units of their sigma, NaN where nothing was seen; ``across`` and ``down`` name axes."""

    z: Float[np.ndarray, "rows columns"]
    across: str
    down: str
    caption: str


@final
@dataclass(frozen=True)
class Judged:
    """A term's checks, and its map where there is one."""

    checks: tuple[Check, ...]
    z_map: ZMap | None = None


def at_most(term: TermName, name: str, value: float, limit: float, unit: str, what: str) -> Check:
    """Return the check that a value is finite and at most its limit."""
    return Check(term, name, float(value), float(limit), unit, bool(np.isfinite(value) and value <= limit), what)


def chi2_check(
    term: TermName, value: float, dof: int, own: float, factor: float, limits: ValidationLimits, data: str
) -> Check:
    """Return the check of a reduced chi-squared.

    Args:
        value: reduced chi-squared of ``dof`` degrees of freedom, by the errors that the profile states.
        own: that of the profile's fit: what the model does not describe there it does not describe here.
        factor: chi-squared may be this many times ``own``.
        data: what was predicted, for the sentence.
    """
    chance = float(chdtri(dof, limits.chance)) / dof if dof > 0 else 1.0
    limit = max(chance, factor) * max(own, 1.0)
    what = f"{data} differ from the prediction by {value**0.5:.2f} times what noise and the profile's errors explain."
    return at_most(term, "chi-squared", value, limit, "1", what)


def unusable(term: TermName, why: str) -> Judged:
    """Return the failed check of captures that cannot be predicted."""
    return Judged((Check(term, "captures", None, None, "", False, why),))
