"""Finds the cameras that each backend sees, and compares the one to use with the rig."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version

from udccal.doctor.answers import Failure, OpenedCamera, SeenCamera
from udccal.doctor.finding import Finding, Status
from udccal.rig import RigDescription

ASK_S = 30.0
# Cameras round their rates.
_SAME_RATE = 0.98
_PLUG_IN = "Plug the camera in, power it, and run this again."
_BROKEN = "Unplug the camera and run this again. If that does not help, install the backend's software again."
_SLOW = " (at a port or cable that is slower than the camera)"


def camera_finding(
    backend: str, answer: tuple[SeenCamera, ...] | Failure, asked: bool, serial: str | None = None
) -> Finding:
    """Return a backend's answer; it is a problem when that backend is wanted and has not the one camera to open.

    ``serial`` is the wanted camera's serial number; None for the only camera.
    """
    topic = f"cameras by {backend}"
    if isinstance(answer, Failure):
        found = "it cannot look for any" if answer.refused else answer.reason
        return Finding(topic, Status.NOTE, found, answer.reason if answer.refused else _BROKEN).needed(asked)
    if not answer:
        return Finding(topic, Status.NOTE, "none seen", _PLUG_IN if asked else "").needed(asked)
    found = "; ".join(f"{camera.name}{_SLOW if camera.too_slow else ''}" for camera in answer)
    troubles = "\n".join(f"{camera.name}: {camera.trouble}" for camera in answer if camera.trouble)
    if all(camera.trouble for camera in answer):
        return Finding(topic, Status.NOTE, f"{found}; cannot be opened", troubles).needed(asked)
    wrong = _not_the_one(answer, serial) if asked else ""
    if wrong:
        return Finding(topic, Status.PROBLEM, found, wrong)
    return Finding(topic, Status.OK, found, troubles)


def _not_the_one(answer: tuple[SeenCamera, ...], serial: str | None) -> str:
    """Say why none of the cameras can be opened as the one that is wanted; empty where one can."""
    if serial is None:
        several = f"Expected one camera, found {len(answer)}. Choose one with --serial."
        return several if len(answer) > 1 else ""
    wanted = [camera for camera in answer if camera.serial == serial]
    # A serial number that this user may not read may be the wanted one.
    hidden = [camera for camera in answer if camera.trouble and not camera.serial]
    if not wanted and not hidden:
        found = ", ".join(camera.serial or "one without a number" for camera in answer)
        return f"Expected a camera of the serial number {serial}, found {found}. Plug it in, or correct --serial."
    return next((f"{camera.name}: {camera.trouble}" for camera in wanted or hidden if camera.trouble), "")


def rig_finding(rig: RigDescription, answer: OpenedCamera | Failure) -> Finding:
    """Compare an opened camera with a rig: size, pattern and bits, exposures, and frame rate."""
    topic, camera = "camera against rig", rig.camera
    if isinstance(answer, Failure):
        found = "it cannot be opened" if answer.refused else answer.reason
        return Finding(topic, Status.PROBLEM, found, answer.reason if answer.refused else _BROKEN)
    exposures = f"{answer.shortest_s:g} to {answer.longest_s:g} s"
    found = f"{answer.columns} x {answer.rows}, at most {answer.rate_hz:.4g} Hz, exposures of {exposures}"
    wrong = [answer.refusal] if answer.refusal else []
    if (answer.columns, answer.rows) != (camera.columns, camera.rows):
        wrong.append(
            f"Expected a camera of {camera.columns} x {camera.rows} as in the rig '{rig.name}', found "
            f"{answer.columns} x {answer.rows}. Connect the right camera, or correct rig.toml."
        )
    if answer.shortest_s > camera.min_exposure_s or answer.longest_s < camera.max_exposure_s:
        wrong.append(
            f"Expected exposures of {camera.min_exposure_s:g} to {camera.max_exposure_s:g} s as in the rig "
            f"'{rig.name}', found {exposures}. Correct min_exposure_s and max_exposure_s in rig.toml."
        )
    if wrong:
        return Finding(topic, Status.PROBLEM, found, "\n".join(wrong))
    if answer.rate_hz < _SAME_RATE * camera.frame_rate_hz:
        slow = f"The rig says {camera.frame_rate_hz:g} Hz: a capture takes longer than udccal plan says."
        return Finding(topic, Status.NOTE, found, f"{slow} Correct frame_rate_hz in rig.toml.")
    return Finding(topic, Status.OK, found)


def pylon_sdk_finding(asked: bool) -> Finding:
    """Check whether Basler's SDK is installed, without loading it."""
    topic = "pylon SDK"
    try:
        return Finding(topic, Status.OK, f"pypylon {version('pypylon')}")
    except PackageNotFoundError:
        advice = "Needed only for Basler cameras through Basler's SDK, not for u3v:\npip install 'udccal[pylon]'"
        return Finding(topic, Status.NOTE, "not installed", advice).needed(asked)
