"""Switches off a camera's processing of its samples through GenApi."""

from __future__ import annotations

from typing import Final

from udccal.cameras import raw_state
from udccal.cameras.u3v.nodes import NodeMap

_CHOICE: Final = "IEnumeration"
_FLAG: Final = "IBoolean"
_WHOLE: Final = "IInteger"
_FLOAT: Final = "IFloat"


def send_raw_samples(nodes: NodeMap) -> None:
    """Bring a camera into the state of ``raw_state``; skip features that it lacks or has fixed.

    Pixel formats and bounds of the region depend on that state, so read them afterwards.

    Raises:
        CameraError: when it refuses.
    """
    for choice in raw_state.CHOICES:
        _choose(nodes, choice.name, choice.symbol)
    for name in raw_state.SWITCHED_OFF:
        if nodes.writable(name, _FLAG):
            nodes.set_flag(name, False)
    for number in raw_state.WHOLE_NUMBERS:
        if nodes.writable(number.name, _WHOLE):
            nodes.set_number(number.name, number.value)
    nodes.refresh()
    _set_unity(nodes, raw_state.GAMMA)
    for colour in raw_state.BALANCE_COLOURS:
        if _choose(nodes, raw_state.BALANCE_SELECTOR, colour):
            nodes.refresh()
            for name in raw_state.BALANCE_RATIO:
                _set_unity(nodes, name)
    _select_gain(nodes)
    nodes.refresh()


def _choose(nodes: NodeMap, name: str, symbol: str) -> bool:
    """Set an enumeration that has such an entry; return False for all others."""
    if not (nodes.writable(name, _CHOICE) and symbol in nodes.choices(name)):
        return False
    nodes.choose(name, symbol)
    return True


def _set_unity(nodes: NodeMap, name: str) -> None:
    # An integer counts in the camera's own steps, so 1 is seldom a factor of 1.
    if nodes.writable(name, _FLOAT):
        nodes.set_number(name, 1.0)


def _select_gain(nodes: NodeMap) -> None:
    """Select the gain that is set from now on; set an additional digital gain to 0 dB."""
    choices = nodes.choices(raw_state.GAIN_SELECTOR) if nodes.writable(raw_state.GAIN_SELECTOR, _CHOICE) else ()
    selected = next((gain for gain in raw_state.GAINS if gain in choices), None)
    if selected is None:
        return
    if _choose(nodes, raw_state.GAIN_SELECTOR, raw_state.DIGITAL_GAIN):
        nodes.refresh()
        if nodes.writable("Gain", _FLOAT):
            bounds = nodes.bounds("Gain")
            nodes.set_number("Gain", min(max(0.0, bounds.low), bounds.high))
    nodes.choose(raw_state.GAIN_SELECTOR, selected)
