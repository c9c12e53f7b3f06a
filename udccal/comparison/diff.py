"""The difference of two profiles of one rig: a verdict per term and in all, the evidence, and the camera's movement."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, final, get_args

import numpy as np

from udccal.comparison.advice import advice
from udccal.comparison.comparable import check_comparable
from udccal.comparison.effects import Effect, effects_of
from udccal.comparison.estimates import ORDER, Difference, difference, not_covered
from udccal.comparison.held import held_estimates
from udccal.comparison.limits import DiffLimits
from udccal.comparison.maps import DifferenceMaps, difference_maps
from udccal.comparison.movement import Movement, movement
from udccal.comparison.picture import picture_loss
from udccal.fitting.engine.misfit import chi2_tail
from udccal.profiles.profile import Profile
from udccal.result import FitResult, FitStatus
from udccal.sessions.schema import TermName

Verdict = Literal["same", "not compared", "changed, harmless", "changed"]
# From best to worst.
VERDICTS: tuple[Verdict, ...] = get_args(Verdict)
FORMAT, VERSION = "udccal-diff", 1


@final
@dataclass(frozen=True)
class EstimateDiff:
    """One estimate of both profiles; ``difference`` is B less A, of a place in periods within half a period."""

    name: str
    unit: str
    a: float
    b: float
    difference: float
    sigma: float


@final
@dataclass(frozen=True)
class TermDiff:
    """What has become of one term.

    Attributes:
        chi2, dof, p_value: of all its estimates jointly, by both covariances.
        same_captures: whether both were fitted to the same captures: then the rig cannot differ, only the fits.
        effects: what the difference does to what is seen.
        not_covered: estimates that chi-squared leaves out, as a profile keeps no covariance of them.
        notes: what a person should know before relying on the verdict.
    """

    term: TermName
    verdict: Verdict
    chi2: float
    dof: int
    p_value: float
    same_captures: bool
    effects: tuple[Effect, ...]
    estimates: tuple[EstimateDiff, ...]
    not_covered: tuple[str, ...]
    notes: tuple[str, ...]

    @property
    def worst(self) -> Effect:
        """The effect that is farthest beyond its limit, or closest to it."""
        return max((e for e in self.effects if e.limit), key=lambda e: e.value / (e.limit or 1.0))


@final
@dataclass(frozen=True)
class Compared:
    """One of the two profiles."""

    created_at: str
    session_sha256: str | None


@final
@dataclass(frozen=True)
class ProfileDiff:
    """Two profiles of one rig compared. docs/diff.md describes each number; ``diff.json`` holds these fields.

    Attributes:
        verdict: the worst of the terms'; a term that a profile lacks is worse than one that is the same.
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
    return compare(a, b, limits or DiffLimits())[0]


def compare(a: Profile, b: Profile, limits: DiffLimits) -> tuple[ProfileDiff, DifferenceMaps]:
    """Compare two profiles, and keep the maps for figures; see ``diff``."""
    check_comparable(a, b)
    found = difference(held_estimates(a), held_estimates(b))
    maps = difference_maps(a, b)
    loss = picture_loss(a, b, maps)
    terms = tuple(
        _term(a, b, term, found.of(term), effects_of(term, a, b, maps, loss, limits), limits) for term in ORDER
    )
    # What was fitted to the same captures tells no movement.
    told = [not _same_captures(a.result(term), b.result(term)) for term, _ in found.names]
    moved = movement(found.only(np.array(told, dtype=bool)), a.rig.panel.pitch_mm.value, limits)
    verdict = max((one.verdict for one in terms), key=VERDICTS.index)
    newer, other = ("B", b), ("A", a)
    if a.provenance.created_at > b.provenance.created_at:
        newer, other = other, newer
    lacking = [term for term in ORDER if _not_captured(newer[1].result(term)) > _not_captured(other[1].result(term))]
    answer = ProfileDiff(
        format=FORMAT,
        version=VERSION,
        rig=a.rig.name,
        verdict=verdict,
        advice=advice(terms, moved, newer[0], lacking, limits.chance),
        a=_compared(a),
        b=_compared(b),
        terms=terms,
        picture_dB_lost=loss.together,
        movement=moved,
        limits=limits,
    )
    return answer, maps


def verdict_of(chi2: float, dof: int, effects: Sequence[Effect], limits: DiffLimits) -> Verdict:
    """Return the verdict of a term.

    It has changed where chance does not explain chi-squared, or an effect is many times its own error; where no
    profile states any error, each difference is a change. A change matters where an effect is beyond its limit.
    """
    stated = [e for e in effects if e.error is not None]
    changed = chi2_tail(chi2, dof) < limits.chance or any(e.value > limits.errors * (e.error or 0.0) for e in stated)
    if dof == 0 and not stated:
        changed = any(e.value > 0 for e in effects)
    if not changed:
        return "same"
    return "changed" if any(e.harmful for e in effects) else "changed, harmless"


def _term(
    a: Profile, b: Profile, term: TermName, found: Difference, effects: tuple[Effect, ...], limits: DiffLimits
) -> TermDiff:
    results = a.result(term), b.result(term)
    chi2, dof = found.chi2()
    same_captures = _same_captures(*results)
    verdict = verdict_of(chi2, dof, effects, limits)
    if same_captures:
        # Both errors are the same frames': no probability can be told, but what the fits differ by can matter.
        verdict = "changed" if any(effect.harmful for effect in effects) else "same"
    if any(map(_not_captured, results)):
        verdict = "not compared"
    columns = zip(found.names, found.units, found.a, found.b, found.values, found.sigma, strict=True)
    return TermDiff(
        term=term,
        verdict=verdict,
        chi2=chi2,
        dof=dof,
        p_value=chi2_tail(chi2, dof),
        same_captures=same_captures,
        effects=effects,
        estimates=tuple(EstimateDiff(name, unit, *map(float, rest)) for (_, name), unit, *rest in columns),
        not_covered=not_covered(*results),
        notes=tuple(_notes(results, verdict, effects)),
    )


def _not_captured(result: FitResult) -> bool:
    """Whether nobody looked: what restoration uses of such a term is the rig's description."""
    return result.status is FitStatus.NOT_CAPTURED


def _same_captures(a: FitResult, b: FitResult) -> bool:
    """Whether both are known to be fits of the same files."""
    return a.captures is not None and b.captures is not None and a.captures.sha256 == b.captures.sha256


def _notes(results: tuple[FitResult, FitResult], verdict: Verdict, effects: Sequence[Effect]) -> Iterator[str]:
    without = [name for name, result in zip("AB", results, strict=True) if _not_captured(result)]
    if without:
        yield f"This term was not captured for {' and '.join(without)}: whether the rig has changed in it is not known."
    silent = [name for name, result in zip("AB", results, strict=True) if not result.estimates]
    if silent:
        yield f"{' and '.join(silent)}: no number of this term was measured; what restoration uses is compared."
    if _same_captures(*results):
        yield (
            "A and B were fitted to the same captures, and are not independent: sigmas are too large and χ² is too "
            "small. What differs is the fits' doing, not the rig's."
        )
    for name, result in zip("AB", results, strict=True):
        if result.effort not in ("full", None):
            yield f"{name}: The effort of its fit was {result.effort}: a full fit may be better."
        if result.warning:
            yield f"{name}: {result.warning}"
    if verdict == "same" and any(effect.harmful for effect in effects):
        yield "An effect is beyond its limit, but the error bars are too wide to tell it from chance. Capture more."


def _compared(profile: Profile) -> Compared:
    return Compared(profile.provenance.created_at, profile.provenance.session_sha256)
