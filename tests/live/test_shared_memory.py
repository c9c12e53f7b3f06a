from __future__ import annotations

import os
import secrets
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from examples.read_live import frames
from tests.live.conftest import COLUMNS, ROWS, restored_frame
from udccal.errors import LiveError
from udccal.live.sinks.shared_memory import SharedMemorySink

ROOT = Path(__file__).resolve().parents[2]
FOLDER = Path("/dev/shm")
pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="shared memory of Linux")

WRITER = """
import sys, time
from tests.live.conftest import restored_frame
from udccal.live.sinks.shared_memory import SharedMemorySink
sink = SharedMemorySink(sys.argv[1], 30.0)
sink.open((36, 64))
sink.write(restored_frame(7))
print("written", flush=True)
time.sleep(600)
"""


@pytest.fixture
def name() -> Iterator[str]:
    name = f"udccal-test-{secrets.token_hex(6)}"
    yield name
    (FOLDER / name).unlink(missing_ok=True)


def started(name: str) -> subprocess.Popen[str]:
    """A writer in a process group of its own, which has written a frame."""
    command = [sys.executable, "-c", WRITER, name]
    writer = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT, start_new_session=True)
    assert writer.stdout is not None
    assert writer.stdout.readline() == "written\n"
    return writer


def open_sink(name: str) -> SharedMemorySink:
    sink = SharedMemorySink(name, 30.0)
    sink.open((ROWS, COLUMNS))
    return sink


def test_a_segment_goes_with_its_writer(name: str) -> None:
    sink = open_sink(name)
    assert (FOLDER / name).stat().st_mode & 0o777 == 0o600
    reader = frames(name)
    sink.write(restored_frame(3))
    frame_id, picture = next(reader)
    assert (frame_id, picture is not None and int(picture.max())) == (3, 3)
    sink.close()
    assert not (FOLDER / name).exists()
    assert list(reader) == []
    sink.close()


def test_a_living_writer_is_left_alone_and_a_dead_ones_segment_is_replaced(name: str) -> None:
    writer = started(name)
    try:
        with pytest.raises(LiveError, match="a run that still writes to it"):
            SharedMemorySink(name, 30.0)
        reader = frames(name)
        assert next(reader)[0] == 7
    finally:
        os.killpg(writer.pid, signal.SIGKILL)  # with what would remove the name
        writer.wait(30)
    start = time.monotonic()
    with pytest.raises(SystemExit, match=f"writer of {name} to live, found that it was killed"):
        next(reader)
    assert time.monotonic() - start < 5.0
    assert (FOLDER / name).exists()
    sink = open_sink(name)
    sink.write(restored_frame(1))
    assert next(frames(name))[0] == 1
    sink.close()
    assert not (FOLDER / name).exists()


def test_a_writer_that_is_killed_leaves_nothing_behind(name: str) -> None:
    writer = started(name)
    assert (FOLDER / name).exists()
    writer.kill()
    writer.wait(30)
    deadline = time.monotonic() + 30
    while (FOLDER / name).exists() and time.monotonic() < deadline:
        time.sleep(0.01)
    assert not (FOLDER / name).exists()


def test_a_name_that_others_took_meanwhile_is_theirs(name: str) -> None:
    code = WRITER.replace("time.sleep(600)", "sys.stdin.readline(); sink.close()")
    command = [sys.executable, "-c", code, name]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=ROOT) as writer:
        assert writer.stdout is not None
        assert writer.stdout.readline() == "written\n"
        (FOLDER / name).unlink()
        (FOLDER / name).write_bytes(b"another program's data")
        writer.communicate("end\n", timeout=30)
    time.sleep(0.5)  # for what removes names
    assert (FOLDER / name).read_bytes() == b"another program's data"


@pytest.mark.parametrize("content", [b"", b"another program's data"])
def test_other_programs_memory_is_not_touched(name: str, content: bytes) -> None:
    sink = SharedMemorySink(name, 30.0)
    (FOLDER / name).write_bytes(content)
    with pytest.raises(LiveError, match="another program's memory"):
        SharedMemorySink(name, 30.0)
    with pytest.raises(LiveError, match="another program's memory"):
        sink.open((ROWS, COLUMNS))
    sink.close()
    assert (FOLDER / name).read_bytes() == content


def test_a_link_is_not_followed(name: str, tmp_path: Path) -> None:
    (FOLDER / name).symlink_to(tmp_path / "elsewhere")
    with pytest.raises(LiveError, match="to be free"):
        open_sink(name)
    assert not (tmp_path / "elsewhere").exists()


@pytest.mark.parametrize("wrong", ["", "a/b", "../x", ".hidden", "x" * 101])
def test_names_that_are_none_are_refused(wrong: str) -> None:
    with pytest.raises(LiveError, match="shm:NAME"):
        SharedMemorySink(wrong, 30.0)


def test_memory_that_is_not_there_is_refused_and_nothing_is_left(name: str) -> None:
    sink = SharedMemorySink(name, 30.0)
    with pytest.raises(LiveError, match="bytes of shared memory"):
        sink.open((1 << 22, 1 << 22))
    sink.close()
    assert not (FOLDER / name).exists()


def test_a_stalled_reader_slows_nobody(name: str) -> None:
    sink = open_sink(name)
    sink.write(restored_frame(0))
    reader = frames(name)
    next(reader)  # and never again, until the end
    slowest = 0.0
    for number in range(1, 200):
        start = time.perf_counter()
        sink.write(restored_frame(number))
        slowest = max(slowest, time.perf_counter() - start)
    assert slowest < 1.0
    assert next(reader)[0] == 199
    sink.close()


def test_a_reader_waits_for_a_writer_that_lives(name: str) -> None:
    sink = open_sink(name)
    later = threading.Timer(0.6, sink.write, [restored_frame(4)])
    later.start()
    assert next(frames(name))[0] == 4
    later.join()
    sink.close()


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if shutil.which("cc") is None:
        pytest.skip("needs a C compiler")
    program = tmp_path_factory.mktemp("c") / "read_live"
    compiler = ["cc", "-O2", "-Wall", "-Wextra", "-Werror", "-o", program, ROOT / "examples" / "read_live.c"]
    subprocess.run(compiler, check=True, timeout=120)
    return program


@pytest.mark.medium
def test_the_reader_in_c_ends_when_its_writer_was_killed(name: str, program: Path) -> None:
    with subprocess.Popen([sys.executable, "-c", WRITER, name], stdout=subprocess.PIPE, text=True, cwd=ROOT) as writer:
        assert writer.stdout is not None
        assert writer.stdout.readline() == "written\n"
        with subprocess.Popen([program, name], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as reader:
            assert reader.stdout is not None
            assert reader.stdout.readline() == "frame 7: mean 7.00\n"
            writer.send_signal(signal.SIGKILL)
            assert "found that it was killed" in reader.communicate(timeout=30)[1]
            assert reader.returncode == 1


def test_the_reader_in_c(name: str, program: Path) -> None:
    sink = open_sink(name)
    sink.write(restored_frame(5))
    with subprocess.Popen([program, name], stdout=subprocess.PIPE, text=True) as reader:
        assert reader.stdout is not None
        assert reader.stdout.readline() == "frame 5: mean 5.00\n"
        # As if the third slot's frame had been written while a later one was begun in it.
        slot_bytes = (-(-ROWS * COLUMNS * 3 // 64) + 2) * 64
        tear = os.open(FOLDER / name, os.O_RDWR)
        for place, value in ((128 + 3 * slot_bytes - 64, 3), (128 + 2 * slot_bytes, 7), (56, 3)):
            os.pwrite(tear, value.to_bytes(8, "little"), place)
        assert reader.stdout.readline() == "frame 0: torn\n"
        os.close(tear)
        sink.close()
        assert reader.wait(30) == 0
    assert subprocess.run([program, name], capture_output=True, timeout=30).returncode == 1
