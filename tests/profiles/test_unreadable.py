"""A profile of which a file may not be read: the command names that file, not the folder that it would write to."""

from __future__ import annotations

import ctypes
import errno
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import IO, Any

import pytest

from tests.profiles.test_versions import written_in_version_2
from udccal.errors import ProfileError
from udccal.profiles.copies import pack_profile
from udccal.profiles.profile import Profile
from udccal.profiles.store import write_profile

pytestmark = pytest.mark.medium
_PR_CAPBSET_DROP, _CAP_DAC_OVERRIDE, _CAP_DAC_READ_SEARCH = 24, 1, 2


def heed_permissions() -> None:
    """As root: have permissions of files hold from the next program on. For others they hold anyway."""
    for capability in (_CAP_DAC_OVERRIDE, _CAP_DAC_READ_SEARCH):
        ctypes.CDLL(None).prctl(_PR_CAPBSET_DROP, capability, 0, 0, 0)


def refused(*words: str | Path) -> str:
    """The sentence with which ``udccal profile`` ends."""
    command = [sys.executable, "-m", "udccal.cli.main", "profile", *map(str, words), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=280, preexec_fn=heed_permissions)
    assert done.returncode == 1, done.stdout + done.stderr
    assert "Traceback" not in done.stderr
    return str(json.loads(done.stdout)["error"])


@pytest.fixture
def folder(tmp_path: Path, toy_profile: Profile) -> Path:
    write_profile(tmp_path / "p", toy_profile)
    write_profile(tmp_path / "p.zip", toy_profile)
    return tmp_path


@pytest.fixture
def heeded() -> None:
    if os.name != "posix" or (os.geteuid() == 0 and ctypes.CDLL(None).prctl(23, _CAP_DAC_OVERRIDE, 0, 0, 0) != 1):
        pytest.skip("needs permissions that hold for this user, or the right to give up rights")


@pytest.mark.usefixtures("heeded")
def test_the_file_that_could_not_be_read_is_named(folder: Path) -> None:
    array = next((folder / "p").glob("*.exr"))
    for unreadable in (array, folder / "p" / "profile.json"):
        unreadable.chmod(0)
        said = refused("pack", folder / "p", folder / "new.zip")
        assert said == f"Expected to read {unreadable}, found: Permission denied. Check the disk and permissions."
    assert sorted(item.name for item in folder.iterdir()) == ["p", "p.zip"]


@pytest.mark.usefixtures("heeded")
def test_so_it_is_with_migrate_and_behind_a_folder(folder: Path, toy_profile: Profile) -> None:
    written_in_version_2(folder / "old", toy_profile)
    array = next((folder / "old").glob("*.exr"))
    array.chmod(0)
    assert refused("migrate", folder / "old", "--out", folder / "new").startswith(f"Expected to read {array}, found")
    (folder / "closed").mkdir()
    (folder / "p.zip").rename(folder / "closed" / "p.zip")
    (folder / "closed").chmod(0)
    said = refused("unpack", folder / "closed" / "p.zip", folder / "new")
    (folder / "closed").chmod(0o700)
    assert said.startswith(f"Expected to read or write {folder / 'closed' / 'p.zip'}, found: Permission denied.")


@pytest.mark.parametrize("bad", ["p.zip", "p"])
def test_a_bad_sector_is_named(folder: Path, bad: str, monkeypatch: pytest.MonkeyPatch) -> None:
    array = next((folder / "p").glob("*.exr"))
    broken, whole = {"p.zip": folder / "p.zip", "p": array}[bad], Path.open

    def opened(path: Path, mode: str = "r", *more: Any) -> IO[Any]:
        if path == broken and mode == "rb":
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        return whole(path, mode, *more)

    monkeypatch.setattr(Path, "open", opened)
    with pytest.raises(ProfileError) as caught:
        pack_profile(folder / bad, folder / "new.zip")
    assert str(caught.value).startswith(f"Expected to read {broken}, found: Input/output error.")
    assert not (folder / "new.zip").exists()


@pytest.mark.usefixtures("heeded")
def test_a_place_that_cannot_be_written_to_is_still_named_as_such(folder: Path) -> None:
    (folder / "closed").mkdir()
    (folder / "closed").chmod(0o500)
    said = refused("pack", folder / "p", folder / "closed" / "new.zip")
    assert said.startswith(f"Expected to write the results to {folder / 'closed'}, found: Permission denied.")
