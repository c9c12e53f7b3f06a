"""Switches off a camera's processing, so that samples are linear in light and independent of each other.

Features that a camera does not have, or has fixed, are skipped.
"""

from __future__ import annotations

from udccal.cameras import raw_state
from udccal.cameras.pylon_sdk.nodes import Nodes


def send_raw_samples(nodes: Nodes) -> None:
    """Bring the camera with the features ``nodes`` into the state of ``raw_state``."""
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
    """Select the gain that is set from now on; set an additional digital gain to 0 dB."""
    choices = nodes.choices(raw_state.GAIN_SELECTOR)
    selected = next((gain for gain in raw_state.GAINS if gain in choices), None)
    if selected is None:
        return
    if nodes.choose(raw_state.GAIN_SELECTOR, raw_state.DIGITAL_GAIN) and (bounds := nodes.bounds("Gain")) is not None:
        nodes.set_number(min(max(0.0, bounds.low), bounds.high), "Gain")
    nodes.choose(raw_state.GAIN_SELECTOR, selected)


def send_chunks(nodes: Nodes) -> None:
    """Make the camera with the features ``nodes`` send exposure, gain and timestamp with each frame, where it can."""
    if not (nodes.has("ChunkSelector") and nodes.set_flag(True, "ChunkModeActive")):
        return
    for chunk in ("ExposureTime", "Gain", "Timestamp"):
        if nodes.choose("ChunkSelector", chunk):
            nodes.set_flag(True, "ChunkEnable")
