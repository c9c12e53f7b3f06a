from __future__ import annotations

import zipfile
from pathlib import Path

import pytest

from udccal.errors import ProfileError
from udccal.profiles.archive import unpack_archive


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
