"""What has become of one term: its verdict, and the evidence."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, final, get_args

from udccal.comparison.effects import Effect
from udccal.comparison.estimates import Difference, not_covered
from udccal.comparison.limits import DiffLimits
from udccal.fitting.engine.misfit import chi2_tail
from udccal.profiles.profile import Profile
from udccal.result import FitResult, FitStatus
from udccal.sessions.schema import TermName

Verdict = Literal["same", "changed, harmless", "not compared", "changed"]
# From best to worst.
VERDICTS: tuple[Verdict, ...] = get_args(Verdict)


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


def term_diff(
    a: Profile, b: Profile, term: TermName, found: Difference, effects: tuple[Effect, ...], limits: DiffLimits
) -> TermDiff:
    """Judge one term of two profiles by the ``found`` difference of its estimates and its ``effects``."""
    results = a.result(term), b.result(term)
    chi2, dof = found.chi2()
    same = same_captures(*results)
    verdict = verdict_of(chi2, dof, effects, limits)
    if same:
        # Both errors are the same frames': no probability can be told, but what the fits differ by can matter.
        verdict = "changed" if any(effect.harmful for effect in effects) else "same"
    if any(map(not_captured, results)):
        verdict = "not compared"
    columns = zip(found.names, found.units, found.a, found.b, found.values, found.sigma, strict=True)
    return TermDiff(
        term=term,
        verdict=verdict,
        chi2=chi2,
        dof=dof,
        p_value=chi2_tail(chi2, dof),
        same_captures=same,
        effects=effects,
        estimates=tuple(EstimateDiff(name, unit, *map(float, rest)) for (_, name), unit, *rest in columns),
        not_covered=not_covered(*results),
        notes=tuple(_notes(results, verdict, effects)),
    )


def not_captured(result: FitResult) -> bool:
    """Whether nobody looked: what restoration uses of such a term is the rig's description."""
    return result.status is FitStatus.NOT_CAPTURED


def same_captures(a: FitResult, b: FitResult) -> bool:
    """Whether both are known to be fits of the same files."""
    return a.captures is not None and b.captures is not None and a.captures.sha256 == b.captures.sha256


def _notes(results: tuple[FitResult, FitResult], verdict: Verdict, effects: Sequence[Effect]) -> Iterator[str]:
    without = [name for name, result in zip("AB", results, strict=True) if not_captured(result)]
    if without:
        yield f"This term was not captured for {' and '.join(without)}: whether the rig has changed in it is not known."
    silent = [name for name, result in zip("AB", results, strict=True) if not result.estimates]
    if silent:
        yield f"{' and '.join(silent)}: no number of this term was measured; what restoration uses is compared."
    if same_captures(*results):
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
