"""Select the frames of a steady scene that may be averaged.

Such frames are complete, of one setting, not clipped, dark where they must be dark, as bright as the others, and show
the same scene.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import final

import cv2
import numpy as np
from jaxtyping import Float32

from udccal.cameras.protocol import Frame, Settings
from udccal.sessions.patches import brightest_patch_DN, patch_means
from udccal.sessions.schema import Rejection

_MEMORY = 31  # means kept as the reference
_WARM_UP = 8  # frames held back until there is a reference
_FEWEST = 4  # fewer means give no useful median
_SIGMAS = 8.0
_FLOOR_RELATIVE = 2e-3
_FLOOR_DN = 0.3
# Motion is found in patches of the frame: 3072 at full size, where the largest change by noise alone is 4 sigma.
_FEWEST_PATCHES = 12
_PATCH_SIGMAS = 10.0
_PATCH_FLOOR_RELATIVE = 3e-3
_PATCH_FLOOR_DN = 1.0
# A camera may report rounded settings with a frame.
_EXPOSURE_RELATIVE, _GAIN_DB = 0.01, 0.05


@dataclass(frozen=True)
class FrameLimits:
    """Limits of a good frame.

    Attributes:
        black_DN: black level.
        saturation_DN: level from which a sample counts as clipped.
        max_saturated_fraction: largest fraction of clipped samples; 1 where clipping is intended.
        dark_DN: largest median of a patch of a dark frame; None where light is intended.
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
    """Checks the frames of one capture and counts the reasons for which frames are left out.

    Flicker: a frame is left out when its mean differs from the median of recent means by more than 8 robust sigma
    (1.4826 MAD), 0.2 % of the signal and 0.3 DN. Fast flicker that all frames have in common stays in the variance.

    Motion: a frame is left out when a patch of 32 x 32 px, divided by the frame's brightness, differs from the median
    of the frames before by more than 10 times the usual spread of patches, and by more than 0.3 % of the signal plus
    1 DN. Then something moved, passed by, or changed in one place. Frames with fewer than 12 patches are not checked.
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
        """Return the reasons with their counts, the most common first."""
        found = [Rejection(reason=reason, frames=frames) for reason, frames in self._reasons.most_common()]
        if self._dropped:
            found.append(Rejection(reason="dropped on the way from the camera", frames=self._dropped))
        return tuple(found)

    def summary(self) -> str:
        """Return the rejections in words, for a sentence; empty when no frame was left out."""
        return ", ".join(f"{item.frames} {item.reason}" for item in self.rejections())

    def accepted(self, frames: Iterable[Frame], expected: int) -> Iterator[Frame]:
        """Yield the usable frames of one delivery of ``expected`` frames; at most eight are held at a time."""
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
        """Yield the frames of one delivery that have no fault of their own, without comparing them with others."""
        last_id: int | None = None
        for frame in map(_in_own_order, frames):
            reason = self._fault(frame, last_id)
            last_id = frame.frame_id if last_id is None else max(last_id, frame.frame_id)
            if reason is None:
                yield frame
            else:
                self._reasons[reason] += 1

    def reject(self, reason: str) -> None:
        """Count a frame that the caller leaves out for another reason."""
        self._reasons[reason] += 1

    def _fault(self, frame: Frame, last_id: int | None) -> str | None:
        # Ids may restart with each delivery, but the same id at the same time is always the same frame.
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
        """Yield frames that agree with earlier ones; the candidates themselves are part of the reference."""
        means = np.array([*self._recent, *(seen.mean for seen in candidates)])
        if means.size == 0:
            return
        middle = float(np.median(means))
        spread = 1.4826 * float(np.median(np.abs(means - middle)))
        limit = max(_SIGMAS * spread, _FLOOR_RELATIVE * (middle - self._limits.black_DN), _FLOOR_DN)
        comparable = means.size >= _FEWEST
        moved = self._moved(candidates, middle) if comparable else [False] * len(candidates)
        for seen, has_moved in zip(candidates, moved, strict=True):
            if comparable and abs(seen.mean - middle) > limit:
                self._reasons["flicker"] += 1
            elif has_moved:
                self._reasons["motion"] += 1
            else:
                self._recent.append(seen.mean)
                self._patches.append(seen.patches)
                yield seen.frame

    def _moved(self, candidates: list[_Seen], mean_DN: float) -> list[bool]:
        """Return whether a patch of each candidate changed by more than patches usually do."""
        reference = np.median([*self._patches, *(seen.patches for seen in candidates)], axis=0)
        if reference.size < _FEWEST_PATCHES:
            return [False] * len(candidates)
        black = self._limits.black_DN
        light = np.maximum(reference - black, 1.0)
        brightness = [max(seen.mean - black, 1.0) / max(mean_DN - black, 1.0) for seen in candidates]
        # Shot noise grows with the root of the light; its scale is taken from most frames.
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
    """Return whether the mean signals of frames of one scene and setting agree.

    Args:
        frames: the frames; at least one.
        black_DN: black level.
        tolerance: largest difference relative to the brightest frame; 0.5 DN is always accepted.
    """
    means = [cv2.mean(frame.data)[0] - black_DN for frame in frames]
    return max(means) - min(means) <= max(tolerance * max(means), 0.5)


def _in_own_order(frame: Frame) -> Frame:
    """The frame with samples in the processor's order of bytes, which OpenCV takes for granted."""
    own = frame.data.dtype.newbyteorder("=")
    return frame if frame.data.dtype == own else replace(frame, data=frame.data.astype(own))


def _same(found: Settings, expected: Settings) -> bool:
    exposure = abs(found.exposure_s - expected.exposure_s) <= _EXPOSURE_RELATIVE * expected.exposure_s
    return exposure and abs(found.gain_dB - expected.gain_dB) <= _GAIN_DB and found.region == expected.region
