"""Which frames of a steady scene are fit to be averaged: complete, of one setting, unclipped, dark where they must be
dark, as bright as the others, and showing the same thing."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import final

import cv2
import numpy as np
from jaxtyping import Float32

from udccal.cameras.protocol import Frame, Settings
from udccal.sessions.patches import brightest_patch_DN, patch_means
from udccal.sessions.schema import Rejection

_MEMORY = 31  # means remembered as the yardstick
_WARM_UP = 8  # frames held back until there is a yardstick
_FEWEST = 4  # below this a median says nothing
_SIGMAS = 8.0
_FLOOR_RELATIVE = 2e-3
_FLOOR_DN = 0.3
# Motion, in patches of the frame: 3072 of them at full size, of which the largest of pure noise lies at 4 sigmas.
_FEWEST_PATCHES = 12
_PATCH_SIGMAS = 10.0
_PATCH_FLOOR_RELATIVE = 3e-3
_PATCH_FLOOR_DN = 1.0
# A camera may state for a frame what it rounded the settings to.
_EXPOSURE_RELATIVE, _GAIN_DB = 0.01, 0.05


@dataclass(frozen=True)
class FrameLimits:
    """What a good frame stays within, in DN.

    Attributes:
        max_saturated_fraction: of samples at ``saturation_DN`` or above; 1 where clipping is meant.
        dark_DN: what no patch of a dark frame may exceed; None where light is meant.
    """

    black_DN: float
    saturation_DN: float
    max_saturated_fraction: float = 1e-3
    dark_DN: float | None = None


@dataclass(frozen=True)
class _Seen:
    frame: Frame
    mean: float
    patches: Float32[np.ndarray, "down across"]


@final
class FrameChecks:
    """Judges the frames of one capture and remembers why any was left out.

    Flicker: a frame whose mean differs from the median of recent means by more than 8 robust sigmas (1.4826 MAD, not
    taken below 0.2 % of the signal or 0.3 DN) is left out. Fast flicker that all frames share stays in the variance.

    Motion: a frame some patch of which (32 x 32 px), brightness divided out, differs from the mean of the frames before
    by more than 10 times the usual spread of patches, 0.3 % of the signal and 1 DN is left out: something moved, passed
    by, or changed in one place. Fewer than 12 patches are not judged.
    """

    def __init__(self, limits: FrameLimits, settings: Settings) -> None:
        """Start a capture with the settings that the camera accepted."""
        self._limits = limits
        self._settings = settings
        self._latest: tuple[int, float] | None = None
        self._recent: deque[float] = deque(maxlen=_MEMORY)
        self._patches: deque[Float32[np.ndarray, "down across"]] = deque(maxlen=_WARM_UP)
        self._spreads: deque[float] = deque(maxlen=_MEMORY)
        self._reasons: Counter[str] = Counter()
        self._dropped = 0

    def rejections(self) -> tuple[Rejection, ...]:
        """Reasons with their counts, the commonest first."""
        found = [Rejection(reason=reason, frames=frames) for reason, frames in self._reasons.most_common()]
        if self._dropped:
            found.append(Rejection(reason="dropped on the way from the camera", frames=self._dropped))
        return tuple(found)

    def summary(self) -> str:
        """The same in words, for a sentence; empty when nothing was left out."""
        return ", ".join(f"{item.frames} {item.reason}" for item in self.rejections())

    def accepted(self, frames: Iterable[Frame], expected: int) -> Iterator[Frame]:
        """The usable ones among frames of one delivery of ``expected``; at most eight are held at a time."""
        held: list[_Seen] = []
        warm_up = min(_WARM_UP, expected)
        for frame in self.sound(frames):
            seen = _Seen(frame, cv2.mean(frame.data)[0], patch_means(frame.data))
            if len(self._recent) + len(held) + 1 < warm_up:
                held.append(seen)
                continue
            yield from self._steady([*held, seen])
            held = []
        yield from self._steady(held)

    def sound(self, frames: Iterable[Frame]) -> Iterator[Frame]:
        """The frames of one delivery in which nothing is wrong by itself, whatever the others show."""
        last_id: int | None = None
        for frame in frames:
            reason = self._fault(frame, last_id)
            last_id = frame.frame_id if last_id is None else max(last_id, frame.frame_id)
            if reason is None:
                yield frame
            else:
                self._reasons[reason] += 1

    def reject(self, reason: str) -> None:
        """Count a frame that the caller leaves out for a reason of its own."""
        self._reasons[reason] += 1

    def _fault(self, frame: Frame, last_id: int | None) -> str | None:
        # Ids may begin anew with each delivery; the same id at the same time is the same frame even so.
        repeated = (frame.frame_id, frame.timestamp_s) == self._latest
        self._latest = (frame.frame_id, frame.timestamp_s)
        if repeated or (last_id is not None and frame.frame_id <= last_id):
            return "delivered twice"
        if last_id is not None:
            self._dropped += frame.frame_id - last_id - 1
        if not frame.complete:
            return "incomplete"
        region = self._settings.region
        if not _same(frame.settings, self._settings) or frame.data.shape != (region.rows, region.columns):
            return "settings changed"
        clipped = np.count_nonzero(frame.data >= self._limits.saturation_DN)
        if clipped > self._limits.max_saturated_fraction * frame.data.size:
            return "saturated"
        if self._limits.dark_DN is not None and brightest_patch_DN(frame.data) > self._limits.dark_DN:
            return "light leak"
        return None

    def _steady(self, candidates: list[_Seen]) -> Iterator[Frame]:
        """Frames in line with those before; the candidates themselves count towards the yardstick."""
        means = np.array([*self._recent, *(seen.mean for seen in candidates)])
        if means.size == 0:
            return
        middle = float(np.median(means))
        spread = 1.4826 * float(np.median(np.abs(means - middle)))
        limit = max(_SIGMAS * spread, _FLOOR_RELATIVE * (middle - self._limits.black_DN), _FLOOR_DN)
        judged = means.size >= _FEWEST
        moved = self._moved(candidates, middle) if judged else [False] * len(candidates)
        for seen, has_moved in zip(candidates, moved, strict=True):
            if judged and abs(seen.mean - middle) > limit:
                self._reasons["flicker"] += 1
            elif has_moved:
                self._reasons["motion"] += 1
            else:
                self._recent.append(seen.mean)
                self._patches.append(seen.patches)
                yield seen.frame

    def _moved(self, candidates: list[_Seen], mean_DN: float) -> list[bool]:
        """Whether some patch of each candidate changed against the frames before by more than patches usually do."""
        reference = np.median([*self._patches, *(seen.patches for seen in candidates)], axis=0)
        if reference.size < _FEWEST_PATCHES:
            return [False] * len(candidates)
        black = self._limits.black_DN
        light = np.maximum(reference - black, 1.0)
        brightness = [max(seen.mean - black, 1.0) / max(mean_DN - black, 1.0) for seen in candidates]
        # Shot noise grows with the root of the light; its scale is what most frames show.
        changes = [
            (seen.patches - black - ratio * (reference - black)) / np.sqrt(light)
            for seen, ratio in zip(candidates, brightness, strict=True)
        ]
        self._spreads.extend(1.4826 * float(np.median(np.abs(change))) for change in changes)
        usual = float(np.median(self._spreads))
        floor = (_PATCH_FLOOR_RELATIVE * light + _PATCH_FLOOR_DN) / np.sqrt(light)
        limit = np.maximum(_PATCH_SIGMAS * usual, floor)
        return [bool((np.abs(change) > limit).any()) for change in changes]


def frames_agree(frames: Iterable[Frame], black_DN: float, tolerance: float) -> bool:
    """Whether the mean light of frames of one scene and setting agrees within ``tolerance`` (relative), or 0.5 DN."""
    means = [cv2.mean(frame.data)[0] - black_DN for frame in frames]
    return max(means) - min(means) <= max(tolerance * max(means), 0.5)


def _same(found: Settings, expected: Settings) -> bool:
    exposure = abs(found.exposure_s - expected.exposure_s) <= _EXPOSURE_RELATIVE * expected.exposure_s
    return exposure and abs(found.gain_dB - expected.gain_dB) <= _GAIN_DB and found.region == expected.region
