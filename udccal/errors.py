"""The errors of udccal. Each message says what was expected, what was found, and what to do."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class UdccalError(Exception):
    """Root of every error that udccal raises on purpose."""


class RigError(UdccalError):
    """A rig description is missing, unreadable or out of range."""


class SessionError(UdccalError):
    """A session on disk is missing, damaged, or does not follow docs/session.md."""


class MissingStepError(SessionError):
    """A step of a session was not captured."""


class ProfileError(UdccalError):
    """A profile on disk is missing, damaged, or does not follow docs/profile.md."""


class FileFormatError(UdccalError):
    """A picture or array file cannot be read as what it claims to be."""


class CameraError(UdccalError):
    """A camera refused a setting, timed out, or delivered something unusable."""


class CameraTimeout(CameraError):
    """A camera did not answer, or sent no frame, within the time allowed."""


class CameraLost(CameraError):
    """A camera was unplugged, lost power, or reset itself; open it again."""


class CameraBusy(CameraError):
    """A camera is held by another program, or its device node may not be opened by this user."""


class CameraProtocolError(CameraError):
    """A camera answered something that its standard does not allow."""


class DisplayError(UdccalError):
    """A picture could not be shown on the panel, pixel for pixel."""


class CaptureError(UdccalError):
    """What the camera saw is not what a procedure's step needs."""


class FitError(UdccalError):
    """A fit could not be done with the data given, or ended in a status that ``or_raise`` refuses."""


class RestorationError(UdccalError):
    """A frame cannot be restored with the profile chosen."""


class PanelPictureError(RestorationError):
    """A frame is darker than the light of the picture that the panel is said to have shown."""


class LiveError(UdccalError):
    """A live run cannot begin or go on: its sink, its hook, or a stage of it."""


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return a sentence for a message, after a blank, that asks for the most similar known name; empty without one."""
    nearest = difflib.get_close_matches(name, list(known), n=1)
    return f" Did you mean {nearest[0]}?" if nearest else ""
