"""Exports profiles for other programs, and imports lenses from them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import final

from udccal.cli.jobs.apart import check_apart, check_profile_place
from udccal.cli.output import Output
from udccal.comparison.place import place_of
from udccal.io.out_folder import storing_in
from udccal.profiles.exchange.exports import EXPORTS, covariance_file, export_profile
from udccal.profiles.exchange.imports import IMPORTS, profile_of, read_lens
from udccal.profiles.store import load_profile, write_profile
from udccal.result import FitStatus
from udccal.rig import load_rig


@final
@dataclass(frozen=True)
class ExportSummary:
    """Result of ``profile export``; ``not_held`` are sentences that say what the file cannot hold.

    ``place`` says who tells the camera's place in the file; null where the file has none.
    """

    profile: Path
    file: Path
    covariance: Path
    not_held: tuple[str, ...]
    place: str | None


@final
@dataclass(frozen=True)
class ImportSummary:
    """Result of ``profile import``; ``notes`` are those of the geometry."""

    file: Path
    rig: str
    profile: Path
    notes: tuple[str, ...]


def export(output: Output, path: Path, to: str, out: Path) -> None:
    """Write a profile for another program, with the covariance beside it.

    Args:
        output: says what was written, and what the format cannot hold.
        path: folder or zip file of the profile, or a rig's name.
        to: name of the format.
        out: the new file.

    Raises:
        ProfileError: when the profile cannot be read, or the file exists.
        UdccalError: when the file cannot be written.
    """
    check_apart(out)
    profile, into = load_profile(path), EXPORTS[to]
    place = place_of(profile)
    with storing_in(out.parent):
        export_profile(profile, into, out, place)
    beside = covariance_file(out)
    output.say(f"{path} -> {out}, its covariance {beside}")
    for term in into.terms:
        status = profile.result(term).status
        if status is not FitStatus.CONVERGED:
            output.say(f"{term}: {status.value}")
    for sentence in into.not_held:
        output.say(sentence)
    if into.posed:
        output.say(place.what)
    output.result(ExportSummary(path, out, beside, into.not_held, place.what if into.posed else None))


def import_(output: Output, of: str, file: Path, rig: str, out: Path) -> None:
    """Write a profile whose geometry is the lens in another program's file.

    Args:
        output: says what was written, and what the file does not tell.
        of: name of the format.
        file: the other program's file.
        rig: name of the rig, or its folder.
        out: folder of the profile, or a zip file.

    Raises:
        RigError: when the rig is not known.
        ProfileError: when the file cannot be read, does not fit the rig, or something else is at ``out``.
        UdccalError: when the profile cannot be written.
    """
    check_profile_place(out)
    description = load_rig(rig)
    profile = profile_of(read_lens(file, IMPORTS[of]), description, f"{file.name} ({of})")
    with storing_in(out.parent):
        write_profile(out, profile)
    output.say(f"{file} -> {out}")
    for sentence in (
        *profile.geometry.notes,
        "No other term is in the file: all are as in a session without captures.",
    ):
        output.say(sentence)
    output.result(ImportSummary(file, profile.rig.name, out, profile.geometry.notes))
