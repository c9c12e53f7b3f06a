"""What can happen to a USB transfer instead of data; the hosts' errors are made from these."""

from __future__ import annotations

from typing import final


@final
class Stalled(Exception):
    """The endpoint answered STALL, or is halted since it did."""


@final
class Overflowed(Exception):
    """The device sent more than the transfer had room for (babble)."""


@final
class Unplugged(Exception):
    """The device is not there."""
