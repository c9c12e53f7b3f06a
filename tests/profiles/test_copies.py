"""Packing, unpacking and migrating: byte for byte, whole or not at all, and over nothing but a profile."""

from __future__ import annotations

import json
import os
import shutil
import zipfile
from pathlib import Path

import numpy as np
import pytest

from tests.profiles.test_versions import written_in_version_2
from udccal.errors import ProfileError
from udccal.profiles.copies import migrate_profile, pack_profile, unpack_profile
from udccal.profiles.exchange.exports import EXPORTS, export_profile
from udccal.profiles.history import identity
from udccal.profiles.profile import Profile
from udccal.profiles.provenance import PROFILE_NAME
from udccal.profiles.schema import VERSION
from udccal.profiles.store import read_profile, write_profile


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory, toy_profile: Profile) -> Path:
    path = tmp_path_factory.mktemp("original") / "p"
    write_profile(path, toy_profile)
    return path


@pytest.fixture
def folder(tmp_path: Path, original: Path) -> Path:
    """A profile in a folder of its own, whose name has a space and letters beyond ASCII."""
    return Path(shutil.copytree(original, tmp_path / "mit Leerzeichen, µ" / "p"))


def contents(folder: Path) -> dict[str, bytes]:
    return {file.name: file.read_bytes() for file in folder.iterdir()}


def test_packed_and_unpacked_it_is_the_same_to_the_byte(folder: Path) -> None:
    packed, unpacked = folder.with_name("p.zip"), folder.with_name("q")
    pack_profile(folder, packed)
    assert identity(packed) == identity(folder)
    unpack_profile(packed, unpacked)
    assert contents(unpacked) == contents(folder)
    pack_profile(packed, folder.with_name("again.zip"))
    assert sorted(item.name for item in folder.parent.iterdir()) == ["again.zip", "p", "p.zip", "q"]


def test_nothing_is_written_into_a_profile(folder: Path, toy_profile: Profile) -> None:
    """Its folder would hold more than its files then, and could not be replaced."""
    before = contents(folder)
    for target in (folder / "z.zip", folder / "deep" / "z.zip", folder / ".." / "p" / "z.zip"):
        with pytest.raises(ProfileError, match="outside of any profile"):
            pack_profile(folder, target)
    with pytest.raises(ProfileError, match="outside of any profile"):
        export_profile(toy_profile, EXPORTS["npz"], folder / "deep" / "x.npz")
    assert contents(folder) == before
    pack_profile(folder, folder / ".." / "z.zip")


def damaged_zip(packed: Path, name: str) -> Path:
    """A zip file of a profile with other content in the file of that name."""
    with zipfile.ZipFile(packed) as archive:
        files = {file: archive.read(file) for file in archive.namelist()}
    with zipfile.ZipFile(packed, "w") as archive:
        for file, content in files.items():
            archive.writestr(file, b'{"format": "another"}' if file == name else content)
    return packed


@pytest.mark.parametrize("name", [PROFILE_NAME, "wire_map.exr"])
def test_a_refused_zip_file_is_named_by_its_path(folder: Path, name: str) -> None:
    packed = folder.with_name("p.zip")
    pack_profile(folder, packed)
    damaged_zip(packed, name)
    uses = (
        read_profile,
        lambda path: unpack_profile(path, path.with_name("q")),
        lambda path: pack_profile(path, path.with_name("r.zip")),
    )
    for use in uses:
        with pytest.raises(ProfileError) as refused:
            use(packed)
        assert f"Expected {packed / name} to have" in str(refused.value)


def test_a_copy_takes_the_place_of_a_profile_and_of_nothing_else(folder: Path) -> None:
    packed, taken, mine = folder.with_name("p.zip"), folder.with_name("q"), folder.with_name("mine.zip")
    pack_profile(folder, packed)
    pack_profile(folder, packed)
    mine.write_bytes(b"a letter")
    with pytest.raises(ProfileError, match="Choose another path"):
        pack_profile(folder, mine)
    assert mine.read_bytes() == b"a letter"
    taken.mkdir()
    (taken / "photo.png").write_bytes(b"mine")
    with pytest.raises(ProfileError, match="Choose another path"):
        unpack_profile(packed, taken)
    assert contents(taken) == {"photo.png": b"mine"}


def test_names_that_say_something_else_are_refused(folder: Path) -> None:
    with pytest.raises(ProfileError, match=r"ends in \.zip"):
        pack_profile(folder, folder.with_name("p.tar"))
    pack_profile(folder, folder.with_name("p.zip"))
    with pytest.raises(ProfileError, match="name of a folder"):
        unpack_profile(folder.with_name("p.zip"), folder.with_name("q.zip"))
    for missing in (folder, folder.with_name("none.zip")):
        with pytest.raises(ProfileError, match=r"zip file at .* found none"):
            unpack_profile(missing, folder.with_name("q"))


@pytest.mark.parametrize("name", ["../out.exr", "/out.exr", "a/out.exr", "out.sh"])
def test_no_path_leaves_the_folder(folder: Path, name: str) -> None:
    packed = folder.with_name("p.zip")
    pack_profile(folder, packed)
    with zipfile.ZipFile(packed, "a") as archive:
        archive.writestr(name, b"out")
    before = sorted(folder.parent.rglob("*"))
    with pytest.raises(ProfileError, match=r"only profile\.json and EXR files"):
        unpack_profile(packed, folder.with_name("q"))
    assert sorted(folder.parent.rglob("*")) == before


def test_files_that_the_profile_does_not_list_stay_behind(folder: Path) -> None:
    (folder / "notes.txt").write_text("of another")
    pack_profile(folder, folder.with_name("p.zip"))
    with zipfile.ZipFile(folder.with_name("p.zip")) as archive:
        assert "notes.txt" not in archive.namelist()


@pytest.mark.parametrize("fault", ["missing", "altered", "link", "device", "directory"])
def test_half_a_profile_is_not_packed(folder: Path, fault: str) -> None:
    file = folder / "wire_map.exr"
    content = file.read_bytes()
    file.unlink()
    match fault:
        case "altered":
            file.write_bytes(content[:-1] + b"!")
        case "link":
            (folder.parent / "elsewhere").write_bytes(content)
            file.symlink_to(folder.parent / "elsewhere")
        case "device":
            os.mkfifo(file)
        case "directory":
            file.mkdir()
    before = sorted(folder.parent.iterdir())
    with pytest.raises(ProfileError, match=r"wire_map\.exr"):
        pack_profile(folder, folder.with_name("p.zip"))
    assert sorted(folder.parent.iterdir()) == before


def test_an_old_version_is_written_anew_with_the_old_one_as_its_parent(tmp_path: Path, toy_profile: Profile) -> None:
    old, new = written_in_version_2(tmp_path / "old", toy_profile), tmp_path / "new.zip"
    migrate_profile(old, new)
    assert (identity(old).version, identity(new).version) == (2, VERSION)
    before, after = read_profile(old), read_profile(new)
    assert after.parent == identity(old).sha256
    assert after.provenance == before.provenance == toy_profile.provenance
    assert after.noise.estimates == before.noise.estimates
    np.testing.assert_array_equal(after.wire_map, before.wire_map)


def test_what_is_not_old_is_not_migrated(folder: Path) -> None:
    with pytest.raises(ProfileError, match="nothing to migrate"):
        migrate_profile(folder, folder.with_name("q"))
    document = json.loads((folder / PROFILE_NAME).read_text())
    newer = Path(shutil.copytree(folder, folder.with_name("newer")))
    (newer / PROFILE_NAME).write_text(json.dumps({**document, "version": VERSION + 1}))
    with pytest.raises(ProfileError, match="newer version"):
        migrate_profile(newer, folder.with_name("q"))
    assert not folder.with_name("q").exists()
