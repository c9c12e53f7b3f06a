"""Switching off what a camera does to its samples, so that they are linear in light, each by itself.

Features that a camera does not have, or has fixed, are passed over.
"""

from __future__ import annotations

from udccal.cameras import raw_state
from udccal.cameras.pylon_sdk.nodes import Nodes


def send_raw_samples(nodes: Nodes) -> None:
    """Bring a camera into the state of ``raw_state``."""
    for choice in raw_state.CHOICES:
        nodes.choose(choice.name, choice.symbol)
    for name in raw_state.SWITCHED_OFF:
        nodes.set_flag(False, name)
    for number in raw_state.WHOLE_NUMBERS:
        nodes.set_whole(number.value, number.name)
    nodes.set_number(1.0, raw_state.GAMMA)
    for colour in raw_state.BALANCE_COLOURS:
        if nodes.choose(raw_state.BALANCE_SELECTOR, colour):
            nodes.set_number(1.0, *raw_state.BALANCE_RATIO)
    _select_gain(nodes)


def _select_gain(nodes: Nodes) -> None:
    """Select the gain that is set from now on; a digital one beside it would multiply what it sends."""
    choices = nodes.choices(raw_state.GAIN_SELECTOR)
    selected = next((gain for gain in raw_state.GAINS if gain in choices), None)
    if selected is None:
        return
    if nodes.choose(raw_state.GAIN_SELECTOR, raw_state.DIGITAL_GAIN) and (bounds := nodes.bounds("Gain")) is not None:
        nodes.set_number(min(max(0.0, bounds.low), bounds.high), "Gain")
    nodes.choose(raw_state.GAIN_SELECTOR, selected)


def send_chunks(nodes: Nodes) -> None:
    """Have each frame carry its own exposure, gain and timestamp, where the camera can."""
    if not (nodes.has("ChunkSelector") and nodes.set_flag(True, "ChunkModeActive")):
        return
    for chunk in ("ExposureTime", "Gain", "Timestamp"):
        if nodes.choose("ChunkSelector", chunk):
            nodes.set_flag(True, "ChunkEnable")
