"""Finds the cameras that each backend sees."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version

from udccal.doctor.answers import Failure, SeenCamera
from udccal.doctor.finding import Finding, Status

ASK_S = 30.0
_PLUG_IN = "Plug the camera in, power it, and run this again."
_BROKEN = "Unplug the camera and run this again. If that does not help, install the backend's software again."
_SLOW = " (at a port or cable that is slower than the camera)"


def camera_finding(backend: str, answer: tuple[SeenCamera, ...] | Failure, asked: bool) -> Finding:
    """Return a backend's answer; it is a problem when that backend is wanted and has no camera to open."""
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
    return Finding(topic, Status.OK, found, troubles)


def pylon_sdk_finding(asked: bool) -> Finding:
    """Check whether Basler's SDK is installed, without loading it."""
    topic = "pylon SDK"
    try:
        return Finding(topic, Status.OK, f"pypylon {version('pypylon')}")
    except PackageNotFoundError:
        advice = "Needed only for Basler cameras through Basler's SDK, not for u3v:\npip install 'udccal[pylon]'"
        return Finding(topic, Status.NOTE, "not installed", advice).needed(asked)
