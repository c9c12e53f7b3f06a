"""What a report begins with: whether the calibration can be used, and what to do next."""

from __future__ import annotations

from udccal.calibration import ORDER
from udccal.reports.page import Advice
from udccal.result import FitStatus, TermResults

_MOST_SENTENCES = 3
# What more captures of a term are.
_MORE = {
    "noise": "flats and darks at more exposures",
    "geometry": "more views of the board, each leaning another way, out to the corners of the picture",
    "wire": "more flats",
    "psf": "the LED at more places and shifts",
    "backscatter": "more pictures on the panel",
}
# Terms whose fits contain the geometry.
_ON_GEOMETRY = ("wire", "psf", "backscatter")
# Terms that a restoration takes off the picture.
_RESTORED = frozenset({"psf", "wire", "backscatter"})
_IN_THE_MEANTIME = "Until then restore with this profile: its error bars include what is wrong."
_UNTIL = (
    "Restore with this profile until the lens is refocused or exchanged, the camera or the panel moves, or the panel's "
    "brightness is changed; then calibrate again."
)


def advice(results: TermResults) -> Advice:
    """Return the headline and at most three sentences: what cannot be used first, then what is doubtful or missing.

    Nobody is told to restore while a term that restoration takes off the picture is missing.

    Args:
        results: of a calibration, or of a profile.
    """
    failed = [one.name for one in results.results if not one.usable]
    doubtful = [one.name for one in results.results if one.warning]
    missing = [one.name for one in results.results if one.status is FitStatus.NOT_CAPTURED]
    noted = [one.name for one in results.results if one.notes and one.usable and not one.unfitted]
    restores = not failed and not _RESTORED.intersection(missing)
    to_do = [_mend(term, results.result(term).status, "geometry" in missing) for term in (*failed, *doubtful)]
    if missing:
        again = " ".join(f"--term {term}" for term in missing)
        to_do.append(f"Capture {_listed(missing)}, where nobody looked yet: udccal calibrate with {again}.")
    to_know = [_IN_THE_MEANTIME if doubtful else _UNTIL] if restores else []
    headline = _headline(failed, doubtful, missing)
    if noted and not failed:
        headline += f" Read the notes of {_listed(noted)}."
    mood = "bad" if failed else "careful" if doubtful else "absent" if missing else "good"
    return Advice(headline, mood, _first(to_do, to_know))


def _headline(failed: list[str], doubtful: list[str], missing: list[str]) -> str:
    """Say which of the captured terms can be used, and which were not captured."""
    captured = [term for term in ORDER if term not in missing]
    if failed:
        said = f"Not usable: {', '.join(failed)}."
    elif doubtful:
        said = f"Usable with care: {', '.join(doubtful)}."
    elif not missing:
        said = "All five terms can be used."
    else:
        said = f"{len(captured)} of {len(ORDER)} terms measured, and can be used: {', '.join(captured) or 'none'}."
    return f"{said} Not captured: {', '.join(missing)}." if missing else said


def _mend(term: str, status: FitStatus, lens_unknown: bool) -> str:
    """Say how a fit that did not end well is mended; ``lens_unknown``: the geometry was not captured."""
    match status:
        case FitStatus.TOO_FEW_DATA:
            return f"For {term}, capture {_MORE[term]}: there are too few data."
        case FitStatus.SATURATED:
            return f"Capture {term} again with less light or a shorter exposure: too much of it is clipped."
        case FitStatus.TOO_DARK:
            return f"Capture {term} again with more light or a longer exposure: noise hides it."
        case FitStatus.NOT_CONVERGED:
            return f"Look at the residuals of {term} before you rely on it: its fit stopped early."
        case _ if lens_unknown and term in _ON_GEOMETRY:
            return (
                f"Capture geometry, then fit {term} again: its model does not describe the data with the lens and the "
                "tilt of rig.toml."
            )
        case _:
            return (
                f"For {term}, compare rig.toml with the rig, and capture it again if something moved or stood in the "
                "way: its model does not describe the data."
            )


def _first(to_do: list[str], to_know: list[str]) -> tuple[str, ...]:
    if len(to_do) > _MOST_SENTENCES:
        return (*to_do[: _MOST_SENTENCES - 1], "The sections of the other terms say what else to do.")
    return tuple([*to_do, *to_know][:_MOST_SENTENCES])


def _listed(terms: list[str]) -> str:
    return terms[0] if len(terms) == 1 else f"{', '.join(terms[:-1])} and {terms[-1]}"
