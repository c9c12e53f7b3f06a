"""Finds the monitors that can show a picture."""

from __future__ import annotations

from collections.abc import Callable

from udccal.displays.protocol import PanelSize
from udccal.displays.window import list_monitors
from udccal.displays.window_messages import Monitor
from udccal.doctor.finding import Finding, Status
from udccal.errors import DisplayError

_TOPIC = "monitors"


def monitor_finding(
    size: PanelSize | None, monitor: int | None, look: Callable[[], tuple[Monitor, ...]] = list_monitors
) -> Finding:
    """List the monitors that a window can fill, and compare them with the panel's size where that is known.

    Args:
        size: resolution of the panel; None without a rig.
        monitor: number of the requested one; None for none.
        look: returns the monitors.
    """
    try:
        monitors = look()
    except DisplayError as error:
        why = "" if monitor is not None else " This is needed only to show pictures in a window (--display window)."
        return Finding(_TOPIC, Status.NOTE, "none that can show a window", f"{error}{why}").needed(monitor is not None)
    found = "; ".join(_phrase(each) for each in monitors)
    if monitor is not None and monitor not in range(len(monitors)):
        return Finding(_TOPIC, Status.PROBLEM, found, f"There is no monitor {monitor}. Choose one with --monitor.")
    candidates = monitors if monitor is None else monitors[monitor : monitor + 1]
    if size is not None and not any((each.columns, each.rows) == (size.columns, size.rows) for each in candidates):
        which = "No monitor" if monitor is None else f"Monitor {monitor} does not run"
        which += " runs" if monitor is None else ""
        advice = (
            f"{which} at the panel's {size.columns} x {size.rows} pixels. Set that resolution, with the desktop's "
            "scaling at 100 %."
        )
        return Finding(_TOPIC, Status.NOTE, found, advice).needed(monitor is not None)
    return Finding(_TOPIC, Status.OK, found)


def _phrase(monitor: Monitor) -> str:
    rate = f", {monitor.refresh_hz} Hz" if monitor.refresh_hz else ""
    return f"{monitor.index}: {monitor.columns} x {monitor.rows} at ({monitor.x}, {monitor.y}){rate}"
