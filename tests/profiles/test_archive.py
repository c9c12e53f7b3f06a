from __future__ import annotations

import errno
import os
import tracemalloc
import zipfile
from pathlib import Path

import pytest

from udccal.errors import ProfileError
from udccal.profiles.archive import pack_archive, unpack_archive


def archive_with(path: Path, *names: str, content: bytes = b"{}") -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in names:
            archive.writestr(name, content)
    return path


@pytest.fixture
def target(tmp_path: Path) -> Path:
    folder = tmp_path / "inside" / "here"
    folder.mkdir(parents=True)
    return folder


def test_a_flat_archive_is_unpacked(tmp_path: Path, target: Path) -> None:
    unpack_archive(archive_with(tmp_path / "p.zip", "profile.json", "wire_map.exr"), target)
    assert sorted(item.name for item in target.iterdir()) == ["profile.json", "wire_map.exr"]


@pytest.mark.parametrize("name", ["../profile.json", "/profile.json", "a/profile.json", "run.py", "..\\profile.json"])
def test_names_that_lead_elsewhere_are_refused(tmp_path: Path, target: Path, name: str) -> None:
    with pytest.raises(ProfileError, match=r"Expected only profile\.json"):
        unpack_archive(archive_with(tmp_path / "p.zip", name), target)
    assert list(target.iterdir()) == []


def test_a_bomb_is_refused_by_what_it_claims(tmp_path: Path, target: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("udccal.profiles.archive._MAX_TOTAL_BYTES", 1000)
    with pytest.raises(ProfileError, match="unpack to at most"):
        unpack_archive(archive_with(tmp_path / "p.zip", "profile.json", content=bytes(5000)), target)


def test_a_bomb_that_lies_about_its_size_is_refused(tmp_path: Path, target: Path) -> None:
    path = archive_with(tmp_path / "p.zip", "profile.json", content=bytes(500_000))
    content = path.read_bytes().replace((500_000).to_bytes(4, "little"), (10).to_bytes(4, "little"))
    path.write_bytes(content)
    with pytest.raises(ProfileError):
        unpack_archive(path, target)
    assert sum(item.stat().st_size for item in target.iterdir()) <= 10


def test_too_many_files_are_refused(tmp_path: Path, target: Path) -> None:
    with pytest.raises(ProfileError, match="at most 256"):
        unpack_archive(archive_with(tmp_path / "p.zip", *(f"a{i}.exr" for i in range(257))), target)


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_a_name_twice_is_refused(tmp_path: Path, target: Path) -> None:
    with pytest.raises(ProfileError, match="a name twice"):
        unpack_archive(archive_with(tmp_path / "p.zip", "profile.json", "profile.json"), target)


def test_other_files_are_refused(tmp_path: Path, target: Path) -> None:
    (tmp_path / "p.zip").write_bytes(b"PK not really")
    with pytest.raises(ProfileError, match="whole zip file"):
        unpack_archive(tmp_path / "p.zip", target)


def test_damaged_content_and_names_are_refused(tmp_path: Path, target: Path) -> None:
    path = archive_with(tmp_path / "p.zip", "profile.json", content=bytes(range(256)) * 8)
    whole = path.read_bytes()
    garbled = bytearray(whole)
    garbled[60:70] = b"\xff" * 10  # of the packed content
    unnamed = bytearray(whole)
    unnamed[6:8] = (0x0800).to_bytes(2, "little")  # the name counts as UTF-8, which it then is not
    unnamed[30] = 0xBB
    for content in (garbled, unnamed):
        path.write_bytes(content)
        with pytest.raises(ProfileError, match="to be a whole zip file"):
            unpack_archive(path, target)
        for item in target.iterdir():
            item.unlink()


BOMB = 64 * 1024 * 1024


def bomb(path: Path, kind: int, claimed: int, name: str = "profile.json") -> Path:
    """An archive whose one file unpacks to 64 MiB of zeros, and claims to be of another size."""
    with zipfile.ZipFile(path, "w", kind) as archive, archive.open(name, "w") as stream:
        for _ in range(BOMB >> 20):
            stream.write(bytes(1 << 20))
    content = path.read_bytes()
    assert len(content) < 2 << 20
    path.write_bytes(content.replace(BOMB.to_bytes(4, "little"), claimed.to_bytes(4, "little")))
    return path


@pytest.mark.parametrize("kind", [zipfile.ZIP_DEFLATED, zipfile.ZIP_LZMA])
@pytest.mark.parametrize("claimed", [10, 1 << 20, (32 << 20) + 1, BOMB])
def test_a_bomb_takes_neither_memory_nor_disk(tmp_path: Path, target: Path, kind: int, claimed: int) -> None:
    path = bomb(tmp_path / "p.zip", kind, claimed)
    tracemalloc.start()
    try:
        with pytest.raises(ProfileError, match="Expected"):
            unpack_archive(path, target)
        most = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert most < 8 << 20
    assert sum(item.stat().st_size for item in target.iterdir()) <= (claimed if claimed <= 1 << 20 else 0)


def test_an_array_that_no_profile_holds_is_refused_before_it_is_unpacked(tmp_path: Path, target: Path) -> None:
    path = bomb(tmp_path / "p.zip", zipfile.ZIP_DEFLATED, (512 << 20) + 1, "wire_map.exr")
    with pytest.raises(ProfileError, match=r"'wire_map\.exr' .* at most 536870912 bytes"):
        unpack_archive(path, target)
    assert list(target.iterdir()) == []


@pytest.mark.parametrize("large", [False, True])
def test_a_long_list_of_files_is_refused_before_it_is_read(tmp_path: Path, target: Path, large: bool) -> None:
    path = archive_with(tmp_path / "p.zip", *(f"{'a' * 90}{i}.exr" for i in range(100 if large else 8000)), content=b"")
    if large:
        content = path.read_bytes()
        path.write_bytes(content[:-22] + b"PK\6\7" + bytes(16) + content[-22:])
    with pytest.raises(ProfileError, match="short list of files"):
        unpack_archive(path, target)


def test_files_from_before_1980_are_packed(tmp_path: Path, target: Path) -> None:
    (tmp_path / "p").mkdir()
    (tmp_path / "p" / "profile.json").write_text("{}")
    os.utime(tmp_path / "p" / "profile.json", (3600, 3600))
    pack_archive(tmp_path / "p", tmp_path / "p.zip")
    unpack_archive(tmp_path / "p.zip", target)
    assert (target / "profile.json").read_text() == "{}"


@pytest.mark.parametrize(
    ("reason", "advice"), [(errno.ENOSPC, "Free some space there"), (errno.EFBIG, "Allow larger files there")]
)
def test_a_full_disk_is_not_taken_for_a_damaged_file(
    tmp_path: Path, target: Path, monkeypatch: pytest.MonkeyPatch, reason: int, advice: str
) -> None:
    path = archive_with(tmp_path / "p.zip", "profile.json")

    def full(*arguments: object) -> None:
        raise OSError(reason, os.strerror(reason))

    monkeypatch.setattr("udccal.profiles.archive._unpack_entry", full)
    with pytest.raises(ProfileError, match=rf"found: {os.strerror(reason)}\. {advice}"):
        unpack_archive(path, target)
