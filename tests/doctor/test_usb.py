from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.doctor.trees import BASLER, CONTROL, DISK, STREAM, add_device, set_usb_memory, write_values
from udccal.doctor.finding import Finding, Status
from udccal.doctor.machine import Machine, may_open
from udccal.doctor.usb import usb_findings
from udccal.doctor.usb_bus import BusCamera, bus_cameras

OTHER_MAKER = BASLER | {"idVendor": "1ab2", "manufacturer": "Other", "product": "U3", "serial": "5", "devnum": "8"}


def machine(root: Path, allowed: bool = True, system: str = "linux") -> Machine:
    return Machine(root, system, lambda path: allowed and path.exists())


def findings(root: Path, allowed: bool = True) -> dict[str, Finding]:
    return {finding.topic: finding for finding in usb_findings(machine(root, allowed))}


def test_a_camera_on_a_usb_3_port_that_may_be_opened_is_fine(tmp_path: Path) -> None:
    node = add_device(tmp_path, "2-1", BASLER, CONTROL, STREAM)
    set_usb_memory(tmp_path, "1000")
    assert bus_cameras(machine(tmp_path)) == (BusCamera("Basler acA2040-120uc 23456789", 0x2676, 5000.0, node),)
    found = findings(tmp_path)
    assert {finding.status for finding in found.values()} == {Status.OK}
    assert found["USB speed"].found == "Basler acA2040-120uc 23456789: 5000 Mbit/s, SuperSpeed"
    assert "may open Basler acA2040-120uc 23456789" in found["USB permission"].found
    assert found["USB memory"].found == "1000 MB"


def test_only_devices_with_a_control_interface_are_cameras(tmp_path: Path) -> None:
    add_device(tmp_path, "usb2", BASLER | {"devnum": "1"})
    add_device(tmp_path, "2-1", BASLER | {"devnum": "2"}, DISK)
    add_device(tmp_path, "2-2", BASLER | {"devnum": "3"}, STREAM)  # a stream alone controls nothing
    add_device(tmp_path, "2-3.4", OTHER_MAKER, DISK, CONTROL)
    assert [camera.name for camera in bus_cameras(machine(tmp_path))] == ["Other U3 5"]


@pytest.mark.parametrize("speed", ["480", "12", "1.5"])
def test_a_slow_port_is_said_with_advice(tmp_path: Path, speed: str) -> None:
    add_device(tmp_path, "2-1", BASLER | {"speed": speed, "version": " 2.10"}, CONTROL, STREAM)
    finding = findings(tmp_path)["USB speed"]
    assert finding.status is Status.NOTE
    assert f"{speed} Mbit/s, USB 2 speed" in finding.found
    assert "USB 3 port" in finding.advice


def test_no_permission_is_a_problem_with_the_rule_to_install(tmp_path: Path) -> None:
    add_device(tmp_path, "2-1", BASLER, CONTROL, STREAM)
    add_device(tmp_path, "2-2", OTHER_MAKER, CONTROL, STREAM)
    finding = findings(tmp_path, allowed=False)["USB permission"]
    assert finding.status is Status.PROBLEM
    assert "may not open Basler acA2040-120uc 23456789, Other U3 5" in finding.found
    for line in (
        "sudo tee /etc/udev/rules.d/70-udccal-cameras.rules <<'END'",
        'ENV{ID_USB_INTERFACES}=="*:ef0500:*", MODE="0666", TAG+="uaccess"',
        'ATTR{idVendor}=="2676"',
        'ATTR{idVendor}=="1ab2"',
        "sudo udevadm control --reload-rules",
        "sudo udevadm trigger --subsystem-match=usb",
    ):
        assert line in finding.advice


def test_a_camera_without_a_device_file_is_a_problem_of_its_own(tmp_path: Path) -> None:
    add_device(tmp_path, "2-1", BASLER, CONTROL, STREAM).unlink()
    finding = findings(tmp_path)["USB permission"]
    assert finding.status is Status.PROBLEM
    assert "no device file" in finding.found
    assert "/dev/bus/usb" in finding.advice


def test_without_a_camera_the_rule_may_be_installed_beforehand(tmp_path: Path) -> None:
    (tmp_path / "sys/bus/usb/devices").mkdir(parents=True)
    before = findings(tmp_path)
    assert before["USB speed"].status is Status.NOTE
    assert before["USB permission"].status is Status.NOTE
    assert "udev" in before["USB permission"].advice
    write_values(tmp_path / "etc/udev/rules.d", {"70-udccal-cameras.rules": "# ours"})
    assert findings(tmp_path)["USB permission"] == Finding(
        "USB permission", Status.OK, "udccal's udev rule is installed"
    )


@pytest.mark.parametrize(
    ("text", "status", "said"),
    [
        ("16", Status.NOTE, "16 MB"),
        ("999", Status.NOTE, "999 MB"),
        ("0", Status.OK, "without limit"),
        ("2000", Status.OK, "2000 MB"),
        ("-1", Status.NOTE, "holds '-1'"),
        ("lots", Status.NOTE, "holds 'lots'"),
        ("9" * 5000, Status.NOTE, "holds '999"),
        ("", Status.NOTE, "shows no"),
    ],
    ids=lambda value: str(value)[:8],
)
def test_usb_memory(tmp_path: Path, text: str, status: Status, said: str) -> None:
    add_device(tmp_path, "2-1", BASLER, CONTROL)
    set_usb_memory(tmp_path, text)
    finding = findings(tmp_path)["USB memory"]
    assert finding.status is status
    assert said in finding.found
    assert len(finding.found) < 100
    assert ("echo 1000 | sudo tee /sys/module/usbcore/parameters/usbfs_memory_mb" in finding.advice) == (
        said in ("16 MB", "999 MB")
    )


def test_a_computer_without_usb_says_so_and_other_systems_say_nothing(tmp_path: Path) -> None:
    (finding,) = usb_findings(machine(tmp_path))
    assert finding.topic == "USB"
    assert finding.status is Status.NOTE
    assert usb_findings(machine(tmp_path, system="win32")) == ()


@pytest.mark.parametrize("name", sorted(BASLER))
@pytest.mark.parametrize("text", ["", "x", "-1", "99999999999", "\0\x1b[31m\n\n", "ä" * 3000])
def test_values_that_make_no_sense_never_end_the_doctor(tmp_path: Path, name: str, text: str) -> None:
    add_device(tmp_path, "2-1", BASLER, CONTROL)
    file = tmp_path / "sys/bus/usb/devices/2-1" / name
    file.write_text(text, encoding="utf-8")
    for finding in usb_findings(machine(tmp_path)):
        assert finding.found.isprintable()
        assert len(finding.found) < 400
    file.unlink()
    file.mkdir()
    usb_findings(machine(tmp_path))
    if name in ("idVendor", "busnum", "devnum"):
        assert bus_cameras(machine(tmp_path)) == ()


def test_random_bytes_for_every_value_never_end_the_doctor(tmp_path: Path) -> None:
    rng = np.random.default_rng(11)
    add_device(tmp_path, "2-1", BASLER, CONTROL, STREAM)
    set_usb_memory(tmp_path, "16")
    files = [file for file in tmp_path.rglob("*") if file.is_file() and "sys" in file.parts]
    for _ in range(100):
        for file in files:
            if rng.random() < 0.3:
                file.write_bytes(rng.bytes(int(rng.integers(0, 40))))
        for finding in usb_findings(machine(tmp_path)):
            assert finding.found.isprintable()


def test_the_system_is_asked_whether_a_file_may_be_opened(tmp_path: Path) -> None:
    file = tmp_path / "node"
    assert not may_open(file)
    file.write_bytes(b"")
    assert may_open(file)
