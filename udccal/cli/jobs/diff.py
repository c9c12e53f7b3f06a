"""Compares two profiles, prints the differences, and writes them as JSON and as a page."""

from __future__ import annotations

import json
from pathlib import Path

from udccal.cli.jobs.apart import check_folder_apart
from udccal.cli.output import Output, plain
from udccal.comparison.diff import ProfileDiff, compare
from udccal.comparison.limits import DiffLimits
from udccal.comparison.maps import DifferenceMaps
from udccal.compilation import keep_compilations
from udccal.io.atomic import write_atomically
from udccal.io.out_folder import check_writable, storing_in
from udccal.profiles.store import load_profile
from udccal.reports.diff_tables import movement_sentence, movement_table, notes, terms_table
from udccal.reports.page import write_page


def diff_profiles(output: Output, a: Path, b: Path, out: Path | None) -> bool:
    """Print the difference of two profiles; return whether all terms are the same, or differ by less than matters.

    Args:
        output: shows the tables.
        a, b: folder or zip file of each profile, or a rig's name.
        out: folder for ``diff.json`` and ``diff.html``; None for none.

    Raises:
        ProfileError: when a profile cannot be read, or the two cannot be compared.
        UdccalError: when ``out`` cannot be written to, or is in a profile or a session; this is found before any work.
    """
    keep_compilations()
    if out is not None:
        check_folder_apart(out)
        check_writable(out)
    one, other = load_profile(a), load_profile(b)
    with output.stage("comparing"):
        found, maps = compare(one, other, DiffLimits())
    output.answer(found.advice)
    output.table(terms_table(found))
    output.table(movement_table(found.movement))
    output.answer(movement_sentence(found))
    output.answer(f"Restoring frames of the one with the other loses {found.picture_dB_lost:.2f} dB.")
    of_note: dict[str, list[str]] = {}
    for term in found.terms:
        for note in notes(term):
            of_note.setdefault(note, []).append(term.term)
    for note, terms in of_note.items():
        output.say(f"{', '.join(terms)}: {note}")
    if out is not None:
        _write(output, out, found, maps)
    output.result(found)
    return found.verdict in ("same", "changed, harmless")


def _write(output: Output, out: Path, found: ProfileDiff, maps: DifferenceMaps) -> None:
    from udccal.reports.diff_page import diff_page  # it draws, which takes a second to load

    with output.stage("report"), storing_in(out):
        write_page(out / "diff.html", diff_page(found, maps))
        write_atomically(out / "diff.json", json.dumps(plain(found), indent=2, allow_nan=False).encode() + b"\n")
    output.say(f"Written: {out / 'diff.html'} and {out / 'diff.json'}")
