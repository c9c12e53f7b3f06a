"""Lists, begins and checks rig descriptions."""

from __future__ import annotations

import contextlib
import math
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import final

from udccal.cfa import cfa_named
from udccal.cli.output import Output
from udccal.errors import RigError
from udccal.io.atomic import write_atomically
from udccal.io.out_folder import storing_in
from udccal.reports.tables import Table
from udccal.rig import RIG_NAME, RigDescription, load_rig
from udccal.rig_folders import RIG_FILE, find_rig, rig_folders, rig_names, shipped_rig_folder, user_rig_folder

_NAME_LINE = re.compile(r"""^[ \t]*(name|"name"|'name')[ \t]*=.*$""", re.MULTILINE)


@final
@dataclass(frozen=True)
class KnownRig:
    """One rig of ``rig list``; ``problem`` is why its description cannot be used, or empty."""

    name: str
    own: bool
    folder: Path
    camera: str
    panel: str
    problem: str


@final
@dataclass(frozen=True)
class KnownRigs:
    """Result of ``rig list``; ``own_folder`` is where a person's own rigs go, None without a home folder."""

    own_folder: Path | None
    rigs: tuple[KnownRig, ...]


@final
@dataclass(frozen=True)
class NewRig:
    """Result of ``rig new``."""

    name: str
    like: str
    file: Path


@final
@dataclass(frozen=True)
class Consequence:
    """A number that follows from a description."""

    what: str
    value: float
    unit: str


@final
@dataclass(frozen=True)
class CheckedRig:
    """Result of ``rig check``."""

    rig: str
    file: Path
    consequences: tuple[Consequence, ...]


def list_rigs(output: Output) -> None:
    """List the rigs that can be named: a person's own, then the shipped ones."""
    own = user_rig_folder()
    rigs = tuple(_known(folder / name, folder == own) for folder in rig_folders() for name in rig_names(folder))
    rows = tuple((r.name, "yours" if r.own else "shipped", r.problem or f"{r.panel}; {r.camera}") for r in rigs)
    output.table(Table("Rigs", ("name", "whose", "panel and camera"), rows))
    where = "Name a folder for your own rigs with UDCCAL_RIGS." if own is None else f"Your own rigs are in {own}."
    output.say(f"{where} Begin one with: udccal rig new NAME")
    output.result(KnownRigs(own, rigs))


def new_rig(output: Output, name: str, like: str) -> None:
    """Copy the description of the rig ``like`` to the person's own folder under another name.

    Raises:
        RigError: when the name cannot be one, is taken, or ``like`` is not known.
        UdccalError: when the folder cannot be written to.
    """
    if not re.fullmatch(RIG_NAME, name):
        raise RigError(
            f"Expected a name of at most 64 lower-case letters, digits, dots, dashes and underscores, found '{name}'. "
            "Choose another name."
        )
    own = user_rig_folder()
    if own is None:
        raise RigError("Expected a folder for your own rigs, found no home folder. Name one with UDCCAL_RIGS.")
    folder = own / name
    # A folder without a description is no rig: every other verb says that there is none of its name.
    if os.path.lexists(folder / RIG_FILE) or name in rig_names(shipped_rig_folder()):
        raise RigError(f"Expected a name that is free, found that there is a rig '{name}'. Choose another name.")
    load_rig(like)
    text = (find_rig(like) / RIG_FILE).read_text(encoding="utf-8")
    with storing_in(folder):
        _write_new(folder, _NAME_LINE.sub(f'name = "{name}"', text, count=1))
    output.say(f"Edit {folder / RIG_FILE}: its numbers are those of {like}. Then: udccal rig check {name}")
    output.result(NewRig(name, like, folder / RIG_FILE))


def check_rig(output: Output, name: str) -> None:
    """Check a description and show what follows from it.

    Raises:
        RigError: when it is not known, a value is missing, unknown or out of range, or no capture can have the camera's
            size.
    """
    rig = load_rig(name)
    camera, cfa = rig.camera, cfa_named(rig.camera.cfa)
    if camera.columns % cfa.columns or camera.rows % cfa.rows:
        raise RigError(
            f"Expected a camera of whole cells of its {camera.cfa} pattern, found {camera.columns} x {camera.rows} "
            f"pixels. Give {camera.columns // cfa.columns * cfa.columns} x {camera.rows // cfa.rows * cfa.rows}, and "
            "set the camera to that part of its sensor."
        )
    follows = consequences(rig)
    rows = tuple((c.what, f"{c.value:.4g}", c.unit) for c in follows)
    output.table(Table(f"What follows from {rig.name}", ("quantity", "value", "unit"), rows, frozenset({1})))
    output.say("Every value is present and in its range. Compare the table with the rig: a wrong unit shows there.")
    output.result(CheckedRig(rig.name, find_rig(name) / RIG_FILE, follows))


def consequences(rig: RigDescription) -> tuple[Consequence, ...]:
    """Return numbers that a person can compare with the rig; the field of view is that of a lens without distortion."""
    camera, panel = rig.camera, rig.panel
    across, down = (2 * math.degrees(math.atan(side / 2 / rig.focal_px)) for side in (camera.columns, camera.rows))
    brightest_DN = camera.black_DN.value + camera.K_DN_per_e.value * camera.full_well_e.value
    return (
        Consequence("sensor, width", camera.columns * camera.pitch_um / 1000, "mm"),
        Consequence("sensor, height", camera.rows * camera.pitch_um / 1000, "mm"),
        Consequence("field of view, across", across, "deg"),
        Consequence("field of view, down", down, "deg"),
        Consequence("diameter of the entrance pupil", rig.pupil_diameter_mm, "mm"),
        Consequence("panel, width", panel.columns * panel.pitch_mm.value, "mm"),
        Consequence("panel, height", panel.rows * panel.pitch_mm.value, "mm"),
        Consequence("panel's rows across the pupil", rig.pupil_diameter_mm / panel.pitch_mm.value, "1"),
        Consequence("level of a full pixel", brightest_DN, "DN"),
        Consequence("end of the converter", float(rig.saturation_DN), "DN"),
    )


def _write_new(folder: Path, text: str) -> None:
    """Write a description to a folder; one that was made for it does not stay without it."""
    there = folder.exists()
    folder.mkdir(parents=True, exist_ok=True)
    try:
        write_atomically(folder / RIG_FILE, text.encode("utf-8"))
    except BaseException:
        if not there:
            with contextlib.suppress(OSError):
                folder.rmdir()
        raise


def _known(folder: Path, own: bool) -> KnownRig:
    try:
        rig = load_rig(folder)
    except RigError as error:
        return KnownRig(folder.name, own, folder, "", "", str(error))
    return KnownRig(folder.name, own, folder, rig.camera.model, rig.panel.model, "")
