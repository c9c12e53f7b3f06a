"""Which frames of a steady scene are fit to be averaged: complete, of one setting, unclipped, and not flickering."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable, Iterator
from typing import final

import numpy as np

from udccal.cameras.protocol import Frame, Settings
from udccal.sessions.schema import Rejection

_MEMORY = 31  # means remembered as the yardstick
_WARM_UP = 8  # frames held back until there is a yardstick
_FEWEST = 4  # below this a median says nothing
_SIGMAS = 8.0
_FLOOR_RELATIVE = 2e-3
_FLOOR_DN = 0.3


@final
class FrameChecks:
    """Judges the frames of one capture and remembers why any was left out.

    Flicker: a frame whose mean differs from the median of recent means by more than 8 robust sigmas (1.4826 MAD, not
    taken below 0.2 % of the signal or 0.3 DN) is left out. Fast flicker that all frames share stays in the variance.
    """

    def __init__(self, black_DN: float, saturation_DN: float, max_saturated_fraction: float = 1e-3) -> None:
        """Start a capture; more than ``max_saturated_fraction`` of samples at ``saturation_DN`` rejects a frame."""
        self._black = black_DN
        self._saturation = saturation_DN
        self._max_saturated = max_saturated_fraction
        self._means: deque[float] = deque(maxlen=_MEMORY)
        self._settings: Settings | None = None
        self._reasons: Counter[str] = Counter()
        self._dropped = 0

    @property
    def rejected_frames(self) -> int:
        """How many frames were delivered and left out; frames the camera never delivered are not among them."""
        return sum(self._reasons.values())

    def rejections(self) -> tuple[Rejection, ...]:
        """Reasons with their counts, the commonest first."""
        found = [Rejection(reason=reason, frames=frames) for reason, frames in self._reasons.most_common()]
        if self._dropped:
            found.append(Rejection(reason="dropped on the way from the camera", frames=self._dropped))
        return tuple(found)

    def accepted(self, frames: Iterable[Frame], expected: int) -> Iterator[Frame]:
        """The usable ones among frames of one delivery of ``expected``; at most eight are held at a time."""
        held: list[tuple[float, Frame]] = []
        warm_up = min(_WARM_UP, expected)
        last_id: int | None = None
        for frame in frames:
            if last_id is not None and frame.frame_id > last_id + 1:
                self._dropped += frame.frame_id - last_id - 1
            last_id = frame.frame_id
            reason = self._fault(frame)
            if reason is not None:
                self._reasons[reason] += 1
                continue
            mean = float(frame.data.mean())
            if len(self._means) + len(held) + 1 < warm_up:
                held.append((mean, frame))
                continue
            yield from self._steady([*held, (mean, frame)])
            held = []
        yield from self._steady(held)

    def _fault(self, frame: Frame) -> str | None:
        if not frame.complete:
            return "incomplete"
        if self._settings is None:
            self._settings = frame.settings
        region = frame.settings.region
        if frame.settings != self._settings or frame.data.shape != (region.rows, region.columns):
            return "settings changed"
        if float(np.mean(frame.data >= self._saturation)) > self._max_saturated:
            return "saturated"
        return None

    def _steady(self, candidates: list[tuple[float, Frame]]) -> Iterator[Frame]:
        """Frames in line with the recent means; the candidates themselves count towards the yardstick."""
        means = np.array([*self._means, *(mean for mean, _ in candidates)])
        if means.size == 0:
            return
        middle = float(np.median(means))
        spread = 1.4826 * float(np.median(np.abs(means - middle)))
        limit = max(_SIGMAS * spread, _FLOOR_RELATIVE * (middle - self._black), _FLOOR_DN)
        for mean, frame in candidates:
            if means.size >= _FEWEST and abs(mean - middle) > limit:
                self._reasons["flicker"] += 1
                continue
            self._means.append(mean)
            yield frame
