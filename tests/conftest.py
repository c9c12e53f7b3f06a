"""Shared by all tests: where the shared pictures are, and the strictest numerics."""

from __future__ import annotations

from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of the shared photographs; tests that need it skip with this reason when it is absent."""
    folder = REPOSITORY.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("needs the shared photographs in ../shared/data, which this checkout lacks")
    return folder
