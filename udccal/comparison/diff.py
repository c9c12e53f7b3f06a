"""The difference of two profiles of one rig: a verdict per term and in all, the evidence, and the camera's movement."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np

from udccal.arguments import check_optional
from udccal.comparison.advice import advice, better_fits
from udccal.comparison.comparable import check_comparable
from udccal.comparison.effects import effects_of
from udccal.comparison.estimates import ORDER, difference
from udccal.comparison.held import held_estimates
from udccal.comparison.limits import DiffLimits
from udccal.comparison.maps import DifferenceMaps, difference_maps
from udccal.comparison.movement import Movement, movement
from udccal.comparison.picture import picture_loss
from udccal.comparison.term_diff import VERDICTS, TermDiff, Verdict, not_captured, same_captures, term_diff
from udccal.errors import ProfileError
from udccal.profiles.profile import Profile

FORMAT, VERSION = "udccal-diff", 1


@final
@dataclass(frozen=True)
class Compared:
    """One of the two profiles."""

    created_at: str
    session_sha256: str | None


@final
@dataclass(frozen=True, eq=False)
class ProfileDiff:
    """Two profiles of one rig compared. docs/diff.md describes each number; ``diff.json`` holds these fields.

    Attributes:
        verdict: the worst of the terms'; a term that a profile lacks is worse than one whose change is harmless.
        advice: one sentence that says what to do.
        picture_dB_lost: by restoring frames of the one with the other; wire, psf and backscatter together.
        movement: of the camera against the panel, from A to B.
        limits: beyond which a difference is significant, and beyond which it matters.
    """

    format: str
    version: int
    rig: str
    verdict: Verdict
    advice: str
    a: Compared
    b: Compared
    terms: tuple[TermDiff, ...]
    picture_dB_lost: float
    movement: Movement
    limits: DiffLimits


def diff(a: Profile, b: Profile, limits: DiffLimits | None = None) -> ProfileDiff:
    """Compare two profiles of one rig.

    Args:
        a, b: profiles, in either order: all but the signs is the same for B and A.
        limits: thresholds of the verdicts; None for those of docs/diff.md.

    Returns:
        a verdict per term and of the whole, with the numbers behind it. The first comparison compiles for some
        seconds.

    Raises:
        ProfileError: when they are of different rigs or cameras, hold a covariance that cannot be one, or terms that
            give no finite numbers.
    """
    check_optional(limits, DiffLimits, ProfileError)
    return compare(a, b, limits or DiffLimits())[0]


def compare(a: Profile, b: Profile, limits: DiffLimits) -> tuple[ProfileDiff, DifferenceMaps]:
    """Compare two profiles, and keep the maps for figures; see ``diff``."""
    check_comparable(a, b)
    found = difference(held_estimates(a), held_estimates(b))
    maps = difference_maps(a, b)
    loss = picture_loss(a, b, maps)
    terms = tuple(
        term_diff(a, b, term, found.of(term), effects_of(term, a, b, maps, loss, limits), limits) for term in ORDER
    )
    # What was fitted to the same captures tells no movement.
    told = [not same_captures(a.result(term), b.result(term)) for term, _ in found.names]
    moved = movement(found.only(np.array(told, dtype=bool)), a.rig.panel.pitch_mm.value, limits)
    verdict = max((one.verdict for one in terms), key=VERDICTS.index)
    newer, other = ("B", b), ("A", a)
    if a.provenance.created_at > b.provenance.created_at:
        newer, other = other, newer
    lacking = [term for term in ORDER if not_captured(newer[1].result(term)) > not_captured(other[1].result(term))]
    refitted = [one.term for one in terms if one.verdict == "changed" and one.same_captures]
    better = better_fits({name: [each.result(term) for term in refitted] for name, each in (("A", a), ("B", b))})
    answer = ProfileDiff(
        format=FORMAT,
        version=VERSION,
        rig=a.rig.name,
        verdict=verdict,
        advice=advice(terms, moved, newer[0], lacking, better, limits.chance),
        a=_compared(a),
        b=_compared(b),
        terms=terms,
        picture_dB_lost=loss.together,
        movement=moved,
        limits=limits,
    )
    return answer, maps


def _compared(profile: Profile) -> Compared:
    return Compared(profile.provenance.created_at, profile.provenance.session_sha256)
