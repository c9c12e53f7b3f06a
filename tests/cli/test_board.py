"""``udccal board``, word by word as it is called."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.medium


def udccal(*words: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "udccal.cli.main", "board", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=100)


def test_a_board_is_written_and_described(tmp_path: Path) -> None:
    out = tmp_path / "new folder é" / "board.pdf"
    done = udccal("--rig", "lg55-aca2040", "--out", out)
    assert done.returncode == 0, done.stderr
    assert "12 x 9 squares of 50 mm, markers of 37.5 mm, DICT_5X5_1000" in done.stdout
    assert "in front of the display" in done.stdout
    assert out.read_bytes().startswith(b"%PDF-")
    before = out.read_bytes()
    made = json.loads(udccal("--rig", "lg55-aca2040", "--out", out, "--json").stdout)
    assert (made["pages"], made["width_mm"], made["board"]["square_mm"]) == (1, 600.0, 50.0)
    assert out.read_bytes() == before
    assert [file.name for file in out.parent.iterdir()] == ["board.pdf"]


def test_what_cannot_be_printed_is_refused_in_a_sentence(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    (tmp_path / "folder.pdf").mkdir()
    (tmp_path / "profile").mkdir()
    (tmp_path / "profile" / "profile.json").write_text("{}")
    for words, sentence in (
        (("--rig", "strange", "--out", tmp_path / "b.pdf"), "found none for 'strange'"),
        (("--rig", "lg55-reduced", "--out", tmp_path / "b.png"), "a file that ends in .pdf"),
        (("--rig", "lg55-reduced", "--out", tmp_path / "folder.pdf"), "a file that ends in .pdf"),
        (("--rig", "lg55-reduced", "--out", tmp_path / "file" / "b.pdf"), "Expected to write the results"),
        (("--rig", "lg55-reduced", "--out", tmp_path / "profile" / "b.pdf"), "inside the profile"),
    ):
        done = udccal(*words)
        assert done.returncode == 1
        assert sentence in done.stderr
    assert udccal("--rig", "lg55-reduced", "--out", tmp_path / "b.pdf", "--paper", "a9").returncode == 2
    assert {path.name for path in tmp_path.iterdir()} == {"file", "folder.pdf", "profile"}
    assert [path.name for path in (tmp_path / "profile").iterdir()] == ["profile.json"]
