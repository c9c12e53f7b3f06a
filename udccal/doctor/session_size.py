"""Computes how many bytes a session takes at most, from the captures of a rig's procedures (docs/session.md).

This is an upper bound. Averages are noise to the last bit and do not compress. Single frames and pictures of the panel
are counted the same way, though frames of 12 bits compress to three quarters or less of 16 bits per sample.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, final

from udccal.rig import RigDescription
from udccal.sessions.schema import Manifest, StoredCapture

_AVERAGE_BYTES: Final = 8  # mean and variance in 32-bit float, per sample
_FRAME_BYTES: Final = 2
_PICTURE_BYTES: Final = 3
_NOISE_LONG_DARKS: Final = 3
_PAIR: Final = 2
# Headers and tables of a file, its place in the manifest, and the blocks of file systems.
_PER_FILE: Final = 16 * 1024
_SLACK: Final = 1.01


@final
@dataclass(frozen=True)
class SessionFiles:
    """Files of a whole session of all five terms.

    Attributes:
        averages: number of means and variances of the whole sensor.
        frames: number of single frames of the whole sensor.
        cut_frames: number of single frames of the psf's region.
        pictures: number of pictures that the panel showed.
    """

    averages: int
    frames: int
    cut_frames: int
    pictures: int


def session_files(rig: RigDescription) -> SessionFiles:
    """Return the files that the shipped procedures write for a rig."""
    captures = rig.captures
    flats = 2 + 2  # wire and noise: a flat and a dark each
    views = captures.board_views + 1  # and the one on the jig
    shown = captures.backscatter_pictures + 1  # and white
    return SessionFiles(
        averages=flats + views + shown + 1,  # and backscatter's dark
        frames=_PAIR * (2 * captures.noise_levels + _NOISE_LONG_DARKS),
        cut_frames=captures.psf_columns * captures.psf_rows * captures.psf_shifts * captures.psf_exposures,
        pictures=shown,
    )


def session_bytes(rig: RigDescription) -> int:
    """Return an upper bound of the bytes of a whole session of a rig."""
    files, captures, camera, panel = session_files(rig), rig.captures, rig.camera, rig.panel
    samples = camera.columns * camera.rows
    cut = min(captures.psf_region_columns, camera.columns) * min(captures.psf_region_rows, camera.rows)
    return (
        files.averages * _most(samples * _AVERAGE_BYTES)
        + files.frames * _most(samples * _FRAME_BYTES)
        + files.cut_frames * _most(cut * _FRAME_BYTES)
        + files.pictures * _most(panel.columns * panel.rows * _PICTURE_BYTES)
    )


def captured_bytes(manifest: Manifest) -> int:
    """Return the bytes that a session holds, counted as in ``session_bytes``; the difference is what is missing."""
    panel = manifest.rig.panel
    pictures = sum(step.subject.kind == "panel" for step in manifest.steps)
    stored = sum(_most_of(capture) for step in manifest.steps for capture in step.captures)
    return stored + pictures * _most(panel.columns * panel.rows * _PICTURE_BYTES)


def _most_of(capture: StoredCapture) -> int:
    per_sample = _AVERAGE_BYTES if capture.kind == "average" else _FRAME_BYTES
    return _most(capture.region.columns * capture.region.rows * per_sample)


def _most(data: int) -> int:
    return round(data * _SLACK) + _PER_FILE
