"""Runs all checks; those that wait for other programs run in parallel."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import final

from udccal.displays.protocol import PanelSize
from udccal.doctor import accelerators, cameras
from udccal.doctor.answers import Failure, read_cameras, read_devices, read_opened
from udccal.doctor.ask import ask
from udccal.doctor.disk import disk_finding
from udccal.doctor.displays import monitor_finding
from udccal.doctor.finding import Finding, Status
from udccal.doctor.machine import Machine
from udccal.doctor.packages import packages_finding, python_finding
from udccal.doctor.questions import Question
from udccal.doctor.usb import usb_findings
from udccal.rig import RigDescription

# The cameras that can be opened to look at them: a simulated one fits its rig, and files are not there yet.
_OPENING = {"u3v": Question.OPEN_U3V, "pylon": Question.OPEN_PYLON}


@final
@dataclass(frozen=True)
class Wanted:
    """What the user wants to do.

    Attributes:
        camera: backend to use, ``u3v`` or ``pylon``; None when not given.
        serial: serial number of the camera; None for the only one.
        monitor: number of the monitor for a window; None for no window.
        rig: rig to calibrate.
        session: folder of the session.
    """

    camera: str | None = None
    serial: str | None = None
    monitor: int | None = None
    rig: RigDescription | None = None
    session: Path | None = None
    machine: Machine = field(default_factory=Machine)


def examine(wanted: Wanted) -> tuple[Finding, ...]:
    """Return every finding about this computer for what is ``wanted``, in the order of the table."""
    with ThreadPoolExecutor() as pool:
        u3v = pool.submit(ask, Question.U3V, read_cameras, cameras.ASK_S)
        jax = pool.submit(ask, Question.JAX, read_devices, accelerators.ASK_JAX_S)
        pylon = pool.submit(_pylon, wanted.camera == Question.PYLON, wanted.serial)
        monitors = pool.submit(monitor_finding, _panel_size(wanted.rig), wanted.monitor)
        gpu = accelerators.gpu_finding()
        seen = (
            cameras.camera_finding(Question.U3V, u3v.result(), wanted.camera == Question.U3V, wanted.serial),
            *pylon.result(),
        )
        return (
            python_finding(),
            packages_finding(),
            *seen,
            *_against_rig(wanted, seen),
            *usb_findings(wanted.machine),
            monitors.result(),
            gpu,
            accelerators.jax_finding(jax.result(), gpu),
            disk_finding(wanted.session, wanted.rig),
        )


def _pylon(asked: bool, serial: str | None) -> tuple[Finding, ...]:
    sdk = cameras.pylon_sdk_finding(asked)
    if sdk.status is not Status.OK:
        return (sdk,)
    answer = ask(Question.PYLON, read_cameras, cameras.ASK_S)
    return sdk, cameras.camera_finding(Question.PYLON, answer, asked, serial)


def _against_rig(wanted: Wanted, seen: tuple[Finding, ...]) -> tuple[Finding, ...]:
    """Open the camera and compare it with the rig; not before all backends have looked, which need it free."""
    question = _OPENING.get(wanted.camera or "")
    if wanted.rig is None or question is None or any(finding.status is Status.PROBLEM for finding in seen):
        return ()
    words = (wanted.serial or "", wanted.rig.camera.cfa, str(wanted.rig.camera.bits))
    answer = ask(question, read_opened, cameras.ASK_S, words)
    return (cameras.rig_finding(wanted.rig, answer if isinstance(answer, Failure) else answer[0]),)


def _panel_size(rig: RigDescription | None) -> PanelSize | None:
    return None if rig is None else PanelSize(rig.panel.columns, rig.panel.rows)
