"""The errors of udccal. Each message says what was expected, what was found, and what to do."""


class UdccalError(Exception):
    """Root of every error that udccal raises on purpose."""


class RigError(UdccalError):
    """A rig description is missing, unreadable or out of range."""


class SessionError(UdccalError):
    """A session on disk is missing, damaged, or does not follow docs/session.md."""


class ProfileError(UdccalError):
    """A profile on disk is missing, damaged, or does not follow docs/profile.md."""


class FileFormatError(UdccalError):
    """A picture or array file cannot be read as what it claims to be."""


class CameraError(UdccalError):
    """A camera refused a setting, timed out, or delivered something unusable."""


class CaptureError(UdccalError):
    """What the camera saw is not what a procedure's step needs."""


class FitError(UdccalError):
    """A fit could not be done with the data given, or ended in a bad status with ``throw=True``."""


class RestorationError(UdccalError):
    """A frame cannot be restored with the profile chosen."""
