from __future__ import annotations

import hashlib
from pathlib import Path

import pytest

from udccal.io.atomic import atomic_path, write_atomically
from udccal.io.hashing import sha256_file


def test_content_replaces_what_was_there(tmp_path: Path) -> None:
    file = tmp_path / "a.json"
    write_atomically(file, b"one")
    write_atomically(file, b"two")
    assert file.read_bytes() == b"two"
    assert list(tmp_path.iterdir()) == [file]


def test_an_error_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    file = tmp_path / "a.json"
    write_atomically(file, b"one")

    def fail_half_way() -> None:
        with atomic_path(file) as temporary:
            temporary.write_bytes(b"half")
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail_half_way()
    assert file.read_bytes() == b"one"
    assert list(tmp_path.iterdir()) == [file]


def test_sha256_is_the_standard_one(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"abc" * 100_000)
    assert sha256_file(tmp_path / "a") == hashlib.sha256(b"abc" * 100_000).hexdigest()


def test_a_link_is_replaced_and_what_it_leads_to_stays(tmp_path: Path) -> None:
    file, other = tmp_path / "a.json", tmp_path / "other"
    other.write_bytes(b"mine")
    file.symlink_to(other)
    write_atomically(file, b"one")
    assert (file.read_bytes(), other.read_bytes(), file.is_symlink()) == (b"one", b"mine", False)


def test_a_temporary_name_that_is_taken_is_not_written_to(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("udccal.io.atomic.secrets.token_hex", lambda count: "0" * 12)
    other = tmp_path / "other"
    other.write_bytes(b"mine")
    (tmp_path / ".a-000000000000.partial.json").symlink_to(other)
    with pytest.raises(FileExistsError):
        write_atomically(tmp_path / "a.json", b"one")
    assert other.read_bytes() == b"mine"
