"""Makes the sink that a person names."""

from __future__ import annotations

from udccal.live.sinks.protocol import Sink
from udccal.plugins import find_sink


def make_sink(text: str, rate_hz: float) -> Sink:
    """Return the sink of ``NAME:TARGET``; nothing is opened yet.

    Args:
        text: name of an installed sink, and after a colon what it writes to.
        rate_hz: rate of the frames.

    Raises:
        UdccalError: when there is no such sink, or it refuses its target.
    """
    name, _, target = text.partition(":")
    sink: Sink = find_sink(name)(target, rate_hz)
    return sink
