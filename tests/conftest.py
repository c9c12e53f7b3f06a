"""Shared by all tests: where the shared pictures are, and the compilations that every process of a run reads."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parent.parent
# What takes four minutes on an idle machine takes four times as long on a busy one.
SLOW_TEST_TIMEOUT_S = 1200


@pytest.hookimpl(trylast=True)
def pytest_configure(config: pytest.Config) -> None:
    """What one worker, or one program under test, has compiled, the others read; so does the next run."""
    cache = getattr(config, "cache", None)  # absent where pytest runs without its cache
    if cache is not None:
        # Not before jaxtyping's plugin has put its checks where modules are imported.
        from udccal.compilation import FOLDER_VARIABLE, keep_compilations

        os.environ.setdefault(FOLDER_VARIABLE, str(cache.mkdir("compilations")))
        keep_compilations()
    if config.pluginmanager.hasplugin("hypothesispytest"):
        from hypothesis import settings

        # The same examples in every run, and none that fails because the machine is busy.
        settings.register_profile("udccal", deadline=None, derandomize=True)
        settings.load_profile("udccal")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Slow tests may take longer than others before they count as hung."""
    for item in items:
        if item.get_closest_marker("slow") and not item.get_closest_marker("timeout"):
            item.add_marker(pytest.mark.timeout(SLOW_TEST_TIMEOUT_S))


@pytest.fixture
def as_other_programs_call(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the checks of types that tests alone have."""
    import jaxtyping

    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)


@pytest.fixture
def emulated_camera(monkeypatch: pytest.MonkeyPatch) -> None:
    """Programs that the test starts see the camera that Basler's SDK emulates: 4096 x 4096 pixels."""
    from udccal.cameras.pylon_sdk.loading import load_sdk
    from udccal.errors import CameraError

    try:
        load_sdk()
    except CameraError as error:
        pytest.skip(str(error))
    monkeypatch.setenv("PYLON_CAMEMU", "1")


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of the shared photographs; tests that need it skip with this reason when it is absent."""
    folder = REPOSITORY.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("needs the shared photographs in ../shared/data, which this checkout lacks")
    return folder


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Callable[[str], Path]]:
    """Mounts a small disk, where the machine lets a test do so; options say how."""
    folder = tmp_path / "disk µ"
    folder.mkdir()

    def mount(options: str) -> Path:
        command = ["mount", "-t", "tmpfs", "-o", options, "udccal-test", str(folder)]
        if shutil.which("mount") is None or subprocess.run(command, capture_output=True).returncode != 0:
            pytest.skip("needs the right to mount a small file system")
        return folder

    yield mount
    if os.path.ismount(folder):
        subprocess.run(["umount", str(folder)], check=True)


@pytest.fixture
def nearly_full(disk: Callable[[str], Path]) -> Path:
    """A disk with room for a page of memory, and one file."""
    folder = disk("size=256k")
    (folder / "other").write_bytes(b"x" * (252 * 1024))
    return folder
