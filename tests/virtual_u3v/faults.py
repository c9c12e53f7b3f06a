"""Faults on demand: what a virtual camera does wrong, and when."""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import final

from tests.virtual_u3v.memory import Status

FOREVER = 1 << 30
_COUNTED = (
    "pending_acks",
    "stale_acks",
    "lost_acks",
    "late_acks",
    "wrong_ack_ids",
    "wrong_ack_commands",
    "garbled_acks",
    "short_acks",
    "bad_statuses",
    "control_halts",
)


class DescriptionFault(enum.StrEnum):
    """What is wrong with the GenICam file or the manifest that points to it."""

    NONE = "none"
    MALFORMED_XML = "malformed-xml"  # a sound zip of text that is no XML
    DAMAGED_ZIP = "damaged-zip"  # bytes flipped, the manifest's SHA-1 made to fit
    WRONG_SHA1 = "wrong-sha1"
    ZIP_BOMB = "zip-bomb"  # a small zip that unpacks to 128 MiB
    HUGE_SIZE = "huge-size"  # a manifest that says the file has 2**40 bytes
    ENDLESS_MANIFEST = "endless-manifest"  # a manifest that says it has 2**63 entries
    NO_ENTRIES = "no-entries"  # a manifest of none
    UNCOMPRESSED = "uncompressed"  # no fault: plain XML is allowed too


@dataclass(frozen=True)
class Faults:
    """What goes wrong from ``VirtualCamera.inject`` on; numbers of frames and commands count from there, from 0.

    Attributes:
        pending_acks: PENDING_ACKs before the next command's acknowledge, which takes almost ``pending_ms`` for each.
        stale_acks: next commands before whose acknowledge the previous one comes once more.
        lost_acks: next commands that are carried out but never acknowledged.
        late_acks: next commands whose acknowledge comes ``late_ms`` later.
        wrong_ack_ids, wrong_ack_commands, garbled_acks, short_acks: next acknowledges with another request id, another
            command id, another prefix, or cut off in the middle of the header.
        bad_statuses: next commands that are refused with ``status``, and not carried out.
        control_halts: next commands at which the control IN endpoint halts instead of acknowledging.
        response_ms: time to every acknowledge.
        unplug_at_command: the command at which the camera goes away.
        missing_leaders, missing_trailers: frames without them.
        wrong_block_ids: frames whose trailer has another block id than their leader.
        dropped_frames: frames that are exposed, counted and never sent.
        duplicated_frames: frames that are sent twice.
        short_frames: frames of which half the payload comes, as the trailer says.
        lying_frames: frames of which half the payload comes while the trailer says all.
        long_frames: frames with 4 KiB more payload than announced.
        babble_frames: frames at whose payload the device sends more than the transfer has room for.
        stream_halts: frames at whose payload the stream endpoint halts; the rest of the frame is lost.
        hang_at_frame: the frame in the middle of which the camera falls silent for good.
        unplug_at_frame: the frame in the middle of which the camera goes away.
        access_denied: the device node may not be opened.
        interface_busy: another program holds the interfaces.
        unconfigured: the host's system leaves the device without a configuration.
        description: what is wrong with the GenICam file; looked at when the camera gets power.
    """

    pending_acks: int = 0
    pending_ms: int = 1000
    stale_acks: int = 0
    lost_acks: int = 0
    late_acks: int = 0
    late_ms: int = 2000
    wrong_ack_ids: int = 0
    wrong_ack_commands: int = 0
    garbled_acks: int = 0
    short_acks: int = 0
    bad_statuses: int = 0
    status: int = Status.BUSY
    control_halts: int = 0
    response_ms: int = 0
    unplug_at_command: int | None = None
    missing_leaders: tuple[int, ...] = ()
    missing_trailers: tuple[int, ...] = ()
    wrong_block_ids: tuple[int, ...] = ()
    dropped_frames: tuple[int, ...] = ()
    duplicated_frames: tuple[int, ...] = ()
    short_frames: tuple[int, ...] = ()
    lying_frames: tuple[int, ...] = ()
    long_frames: tuple[int, ...] = ()
    babble_frames: tuple[int, ...] = ()
    stream_halts: tuple[int, ...] = ()
    hang_at_frame: int | None = None
    unplug_at_frame: int | None = None
    access_denied: bool = False
    interface_busy: bool = False
    unconfigured: bool = False
    description: DescriptionFault = DescriptionFault.NONE


@final
class FaultInjector:
    """Faults being used up: how many of each are left, and how many commands and frames there were."""

    def __init__(self, faults: Faults) -> None:
        self.faults = faults
        self._left = {name: getattr(faults, name) for name in _COUNTED}
        self._commands = 0
        self._frames = 0

    def take(self, name: str) -> bool:
        """Whether one of the faults of this name is left; it then is one less."""
        if self._left[name] <= 0:
            return False
        self._left[name] -= 1
        return True

    def take_all(self, name: str) -> int:
        """How many of the faults of this name are left; then none is."""
        left, self._left[name] = self._left[name], 0
        return left

    def next_command(self) -> int:
        """Number of the command that has just come."""
        self._commands += 1
        return self._commands - 1

    def next_frame(self) -> int:
        """Number of the frame that has just been exposed."""
        self._frames += 1
        return self._frames - 1
