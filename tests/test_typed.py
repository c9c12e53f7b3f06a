"""Type checkers see the types of the public names in a program of others: the package says that it has them."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.medium
def test_a_wrong_argument_in_a_program_of_others_is_found(tmp_path: Path) -> None:
    program = tmp_path / "program.py"
    program.write_text("import udccal\nudccal.load_rig(7)\n")
    words = [sys.executable, "-m", "mypy", "--follow-imports=silent", "--cache-dir", str(tmp_path), str(program)]
    said = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, timeout=280)
    assert 'Argument 1 to "load_rig" has incompatible type "int"' in said.stdout, said.stdout
