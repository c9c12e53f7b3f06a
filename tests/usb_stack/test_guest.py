"""The harness around the guest: its files, its machine, and how it ends. No guest is booted here."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.usb_stack import __main__ as command
from tests.usb_stack import host
from tests.usb_stack.errors import CannotRun, GuestFailed
from tests.usb_stack.initramfs import BOOTED, EXIT, initramfs
from tests.usb_stack.kernel import Kernel, kernel_in
from tests.usb_stack.machine import run_guest
from tests.usb_stack.needs import PROMISED
from tests.usb_stack.serial_line import SerialLine


def kernel_files(folder: Path) -> Kernel:
    """A kernel of which only the names and dependencies are real."""
    files = folder / "kernel"
    files.mkdir()
    (files / "vmlinuz").write_bytes(b"kernel")
    needs = {"vhci_hcd": "usbcore,usbip-core", "usbcore": "usb_common", "usbip_core": "", "usb_common": "", "9p": ""}
    for name, depends in needs.items():
        (files / f"{name}.ko").write_bytes(b"\x7fELF\0license=GPL\0depends=" + depends.encode() + b"\0name=x\0")
    return kernel_in(folder)


def program(folder: Path, name: str, text: str) -> None:
    path = folder / name
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(0o755)


@pytest.fixture
def programs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of programs that are found before the machine's own."""
    folder = tmp_path / "programs"
    folder.mkdir()
    monkeypatch.setenv("PATH", f"{folder}{os.pathsep}{os.environ['PATH']}")
    return folder


@pytest.fixture
def no_programs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))


def test_modules_are_loaded_after_what_they_need(tmp_path: Path) -> None:
    names = [path.stem for path in kernel_files(tmp_path).modules]
    assert sorted(names) == ["9p", "usb_common", "usbcore", "usbip_core", "vhci_hcd"]
    assert names.index("usb_common") < names.index("usbcore") < names.index("vhci_hcd")
    assert names.index("usbip_core") < names.index("vhci_hcd")


@pytest.mark.usefixtures("no_programs")
def test_without_apt_a_sentence_says_so(tmp_path: Path) -> None:
    with pytest.raises(CannotRun, match=r"Expected .*apt-get.* found no .*\. Run this on Debian"):
        kernel_in(tmp_path / "cache")


def test_apt_that_fails_is_quoted(tmp_path: Path, programs: Path) -> None:
    program(programs, "apt-cache", "echo '  Depends: linux-image-9.9.9-amd64'")
    program(programs, "apt-get", "echo 'E: no network' >&2; exit 100")
    program(programs, "dpkg-deb", "exit 1")
    with pytest.raises(CannotRun, match=r"apt-get download -q linux-image-9.9.9-amd64.* found: E: no network"):
        kernel_in(tmp_path / "cache")
    assert not (tmp_path / "cache" / "kernel").exists()


def test_apt_that_knows_no_kernel_is_told_of(tmp_path: Path, programs: Path) -> None:
    program(programs, "apt-cache", "echo 'something else'")
    program(programs, "apt-get", "exit 0")
    program(programs, "dpkg-deb", "exit 1")
    with pytest.raises(CannotRun, match="Expected apt to know linux-image-amd64"):
        kernel_in(tmp_path / "cache")


def test_guests_first_files_can_be_unpacked(tmp_path: Path) -> None:
    if shutil.which("busybox") is None:
        pytest.skip("needs busybox: apt-get install busybox-static")
    kernel = kernel_files(tmp_path)
    archive = initramfs(kernel, host.busybox(), "echo 'a quoted' word")
    unpack = ("busybox", "cpio")
    listing = subprocess.run((*unpack, "-t"), input=archive, capture_output=True, check=True, timeout=60)
    names = listing.stdout.decode().split()
    assert {"init", "bin/busybox", "dev/console", "modules/vhci_hcd.ko"} <= set(names)
    subprocess.run((*unpack, "-i", "init"), input=archive, cwd=tmp_path, capture_output=True, check=True, timeout=60)
    script = (tmp_path / "init").read_text()
    assert "chroot /root /bin/sh -c 'echo '\"'\"'a quoted'\"'\"' word'" in script
    assert f"for module in {' '.join(path.name for path in kernel.modules)};" in script
    assert subprocess.run(("sh", "-n", str(tmp_path / "init")), timeout=60).returncode == 0


@pytest.mark.usefixtures("no_programs")
def test_without_its_programs_a_sentence_names_them_and_their_packages() -> None:
    found = r"Expected qemu-system-x86_64, busybox, arv-tool-0.8, found none\. Install them: apt-get install "
    with pytest.raises(CannotRun, match=found + "qemu-system-x86 busybox-static aravis-tools-cli"):
        host.check_host()


@pytest.mark.parametrize("content", [Path(sys.executable).read_bytes(), b"#!/bin/sh\n"], ids=["libraries", "script"])
def test_a_busybox_that_needs_more_than_itself_is_refused(programs: Path, content: bytes) -> None:
    for name in ("qemu-system-x86_64", "busybox", "arv-tool-0.8"):
        program(programs, name, "exit 0")
    (programs / "busybox").write_bytes(content)
    with pytest.raises(CannotRun, match="Expected a static busybox, found one that needs libraries"):
        host.check_host()


def test_a_machine_of_another_kind_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("platform.machine", lambda: "aarch64")
    with pytest.raises(CannotRun, match=r"Expected an x86_64 machine, .* found aarch64"):
        host.check_host()


def test_serial_line_is_cleaned_and_cut_into_lines() -> None:
    reader, writer = os.pipe()
    os.write(writer, b"\x1bc\x1b[?7l\x1b[2Jone\r\ntwo\nthr\xffee")
    os.close(writer)
    assert list(SerialLine(reader, time.monotonic() + 10).lines()) == ["one", "two", "thr\ufffdee"]
    os.close(reader)


def test_silent_serial_line_ends_at_its_deadline() -> None:
    reader, writer = os.pipe()
    os.write(writer, b"one\n")
    begun = time.monotonic()
    assert list(SerialLine(reader, begun + 0.2).lines()) == ["one"]
    assert 0.1 < time.monotonic() - begun < 5
    os.close(reader)
    os.close(writer)


def guest(programs: Path, text: str, limit_s: float = 5.0) -> int:
    """Run a stand-in for qemu that says this."""
    program(programs, "qemu-system-x86_64", text)
    return run_guest(programs, programs, limit_s)


@pytest.mark.parametrize("status", [0, 1, 5])
def test_guests_exit_status_comes_back(programs: Path, status: int, capsys: pytest.CaptureFixture[str]) -> None:
    said = f"echo noise; echo '{BOOTED} 3.21 s'; echo '12 passed in 3.4s'; echo '{EXIT} {status}'"
    assert guest(programs, said) == status
    assert "12 passed in 3.4s" in capsys.readouterr().out


def test_guest_that_does_not_boot_is_an_error(programs: Path) -> None:
    with pytest.raises(GuestFailed, match="Expected the guest to boot"):
        guest(programs, "echo 'Kernel panic'; exit 1")


def test_guest_that_never_ends_is_ended(programs: Path) -> None:
    begun = time.monotonic()
    with pytest.raises(GuestFailed, match="Expected the guest to end in 0 s"):
        guest(programs, f"echo '{BOOTED} 3.21 s'; exec sleep 60", limit_s=0.3)
    assert time.monotonic() - begun < 10


def test_guest_that_dies_before_it_says_how_it_went_is_an_error(programs: Path) -> None:
    with pytest.raises(GuestFailed, match="Expected the guest to end"):
        guest(programs, f"echo '{BOOTED} 3.21 s'; echo '12 passed in 3.4s'")


@pytest.mark.parametrize("said", ["no tests ran in 0.1s", "3 skipped in 0.1s", "0 passed in 0.1s"])
def test_guest_that_is_content_without_a_test_is_an_error(programs: Path, said: str) -> None:
    with pytest.raises(GuestFailed, match="Expected tests to pass in the guest, found none"):
        guest(programs, f"echo '{BOOTED} 3.21 s'; echo '{said}'; echo '{EXIT} 0'")


@pytest.mark.usefixtures("no_programs")
@pytest.mark.parametrize(("arguments", "status"), [([], 2), (["--if-possible"], 0)])
def test_command_says_that_it_cannot_run_before_it_fetches_a_kernel(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], arguments: list[str], status: int
) -> None:
    monkeypatch.setattr(command, "kernel_in", lambda cache: pytest.fail("a kernel was fetched"))
    monkeypatch.setattr(sys, "argv", ["usb_stack", *arguments])
    assert command.main() == status
    assert "The USB tests were not run. Expected qemu-system-x86_64, " in capsys.readouterr().err


def test_a_guest_that_fails_is_a_failure_also_where_it_need_not_be_had(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, programs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    program(programs, "qemu-system-x86_64", "exit 1")
    kernel = kernel_files(tmp_path)
    monkeypatch.setattr(command, "check_host", lambda: None)
    monkeypatch.setattr(command, "busybox", lambda: kernel.image)
    monkeypatch.setattr(command, "kernel_in", lambda cache: kernel)
    monkeypatch.setattr(sys, "argv", ["usb_stack", "--if-possible"])
    assert command.main() == 2
    assert "Expected the guest to boot, found it did not" in capsys.readouterr().err


@pytest.mark.parametrize(("promised", "status", "said"), [("", 0, "1 passed"), ("1", 5, "1 deselected")])
@pytest.mark.medium
def test_the_guests_command_runs_tests_and_there_those_that_need_its_kernel(
    promised: str, status: int, said: str
) -> None:
    run = (sys.executable, *command._PYTEST, "tests/usb_stack/test_needs.py")
    environment = os.environ | {PROMISED: promised}
    done = subprocess.run(
        run, cwd=command._REPOSITORY, env=environment, capture_output=True, text=True, timeout=120, check=False
    )
    assert (done.returncode, said in done.stdout) == (status, True), done.stdout + done.stderr


@pytest.mark.parametrize(
    ("asked", "run"),
    [
        ([], ["tests/usb_stack"]),
        (["-x", "-k", "halt"], ["-x", "-k", "halt", "tests/usb_stack"]),
        (["tests/usb_stack/test_aravis.py::test_x", "-x"], ["tests/usb_stack/test_aravis.py::test_x", "-x"]),
    ],
)
def test_tests_run_in_the_guest_are_those_named_or_these(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, asked: list[str], run: list[str]
) -> None:
    archives: list[bytes] = []

    def run_guest(image: Path, archive: Path, limit_s: float) -> int:
        archives.append(archive.read_bytes())
        return 7

    monkeypatch.setattr(command, "check_host", lambda: None)
    monkeypatch.setattr(command, "busybox", lambda: tmp_path)
    monkeypatch.setattr(command, "kernel_in", lambda cache: kernel_files(tmp_path))
    monkeypatch.setattr(command, "initramfs", lambda kernel, busybox, inside: inside.encode())
    monkeypatch.setattr(command, "run_guest", run_guest)
    monkeypatch.setattr(sys, "argv", ["usb_stack", *asked])
    assert command.main() == 7
    assert archives[0].decode().endswith(f" {' '.join(run)} 2>&1")
