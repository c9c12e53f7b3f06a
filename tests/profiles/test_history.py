"""A profile's past: its lineage as far as it is beside it, and which terms changed on the way."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path

import pytest

from udccal.cli.jobs.log import log_profile
from udccal.cli.output import Output
from udccal.errors import ProfileError
from udccal.profiles.history import history, identity
from udccal.profiles.profile import Profile
from udccal.profiles.provenance import PROFILE_NAME
from udccal.profiles.store import write_profile

MISSING = "ab" * 32


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory, toy_profile: Profile) -> Path:
    """Three profiles, each derived from the one before; the first one's parent is not there."""
    tmp_path = tmp_path_factory.mktemp("lineage")
    write_profile(tmp_path / "first.zip", dataclasses.replace(toy_profile, parent=MISSING))
    noted = dataclasses.replace(toy_profile.psf, notes=("Fitted with an earlier noise term.",))
    other = dataclasses.replace(toy_profile.noise.term, sigma_d_e=4.8)
    second = dataclasses.replace(
        toy_profile,
        parent=identity(tmp_path / "first.zip").sha256,
        noise=dataclasses.replace(toy_profile.noise, term=other),
        psf=noted,
    )
    write_profile(tmp_path / "second", second)
    write_profile(tmp_path / "third", dataclasses.replace(second, parent=identity(tmp_path / "second").sha256))
    # What else may lie in such a folder.
    (tmp_path / "broken.zip").write_bytes(b"PK")
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / "not mine").mkdir()
    (tmp_path / "not mine" / PROFILE_NAME).symlink_to("/dev/zero")
    return tmp_path


@pytest.fixture
def lineage(tmp_path: Path, original: Path) -> Path:
    return Path(shutil.copytree(original, tmp_path / "lineage", symlinks=True))


def test_a_lineage_is_told_from_the_newest_to_the_oldest_at_hand(lineage: Path) -> None:
    third, second, first = history(lineage / "third")
    assert [p.path.name for p in (third, second, first)] == ["third", "second", "first.zip"]
    assert third.changed == ()
    assert second.changed == ("noise",)
    assert first.changed is None
    assert first.parent == MISSING
    assert [t.status for t in first.terms] == ["CONVERGED"] * 4 + ["ABSENT"]
    assert "Fitted with an earlier noise term." in second.terms[3].notes


def test_without_its_parent_nothing_is_said_of_changes(lineage: Path) -> None:
    (lineage / "second" / PROFILE_NAME).unlink()
    (alone,) = history(lineage / "third")
    assert alone.changed is None
    assert alone.parent is not None


def test_what_is_no_profile_has_no_past(lineage: Path) -> None:
    for name in ("broken.zip", "notes.txt", "nothing"):
        with pytest.raises(ProfileError, match="Expected"):
            history(lineage / name)


def test_an_altered_ancestor_is_none(lineage: Path) -> None:
    file = lineage / "second" / PROFILE_NAME
    file.write_text(json.dumps(json.loads(file.read_text())))
    assert len(history(lineage / "third")) == 1


def test_the_log_prints_every_note_whole_below_the_table(original: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log_profile(Output(), original / "third")
    printed = capsys.readouterr().out
    assert printed.count("\npsf: Fitted with an earlier noise term.\n") == 2
