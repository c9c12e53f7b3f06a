"""The rules of the camera's features: what it accepts, what it rounds, what it refuses."""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import final

from tests.virtual_u3v import registers as at
from tests.virtual_u3v.chunks import CHUNKS, Chunk, overhead
from tests.virtual_u3v.memory import Memory, Refused, Status
from tests.virtual_u3v.model import CameraModel
from tests.virtual_u3v.pixel_formats import PixelFormat, formats_of
from tests.virtual_u3v.registers import Register

Rule = Callable[[int], int]
_OFF, _ONCE, _CONTINUOUS = 0, 1, 2
_AUTO_EXPOSURE_US, _AUTO_GAIN_STEPS = 7000, 30
_TEMPERATURE_RAW = round(38.5 * 16)


@final
class Features:
    """What stands in the feature registers, and what may be written there.

    Args:
        locked: says whether frames are being acquired; format, region and chunks may not change then.
    """

    def __init__(self, model: CameraModel, memory: Memory, locked: Callable[[], bool]) -> None:
        self._model = model
        self._memory = memory
        self._locked = locked
        self._formats = {pixel_format.code: pixel_format for pixel_format in formats_of(model)}
        self._power_on()

    @property
    def pixel_format(self) -> PixelFormat:
        """The present pixel format."""
        return self._formats[self._memory.uint(at.PIXEL_FORMAT)]

    @property
    def region(self) -> tuple[int, int, int, int]:
        """The present region: x, y, columns, rows."""
        x, y, columns, rows = (self._memory.uint(r) for r in (at.OFFSET_X, at.OFFSET_Y, at.WIDTH, at.HEIGHT))
        return x, y, columns, rows

    @property
    def chunks(self) -> tuple[Chunk, ...] | None:
        """The chunks that a frame carries; None outside chunk mode."""
        if not self._memory.uint(at.CHUNK_MODE_ACTIVE):
            return None
        enabled = zip(CHUNKS, at.CHUNK_ENABLE, strict=True)
        return tuple(chunk for chunk, register in enabled if self._memory.uint(register))

    @property
    def payload_size(self) -> int:
        """Bytes of the payload of one frame."""
        _, _, columns, rows = self.region
        image = columns * rows * self.pixel_format.bits_per_pixel // 8
        return image if self.chunks is None else image + overhead(image, self.chunks)

    @property
    def frame_rate_hz(self) -> float:
        """Frames per second that a free-running camera makes with the present settings."""
        asked = struct.unpack("<d", self._memory.read(at.ACQUISITION_FRAME_RATE.address, 8))[0]
        enabled = self._memory.uint(at.ACQUISITION_FRAME_RATE_ENABLE)
        limit = min(self._model.frame_rate_hz[1], 1e7 / self._memory.uint(at.EXPOSURE_TIME_RAW))
        return min(asked, limit) if enabled else limit

    def exposure_us(self, number: int) -> float:
        """Exposure of the camera's ``number``-th frame; the automatic wanders, as it does over a real scene."""
        if self._memory.uint(at.EXPOSURE_AUTO) != _OFF:
            self._memory.put_uint(at.EXPOSURE_TIME_RAW, 10 * (_AUTO_EXPOSURE_US + 50 * (number % 7)))
        return self._memory.uint(at.EXPOSURE_TIME_RAW) / 10

    def gain_steps(self, number: int) -> int:
        """Gain of the camera's ``number``-th frame, in steps of 0.1 dB."""
        if self._memory.uint(at.GAIN_AUTO) != _OFF:
            self._memory.put_uint(at.GAIN_RAW, _AUTO_GAIN_STEPS + number % 5)
        return self._memory.uint(at.GAIN_RAW)

    def rules(self) -> dict[Register, Rule]:
        """What happens when a feature register is written: the value that then stands in it, or Refused."""
        model = self._model
        rules: dict[Register, Rule] = {
            at.PIXEL_FORMAT: self._when_idle(self._one_of(*self._formats)),
            at.ACQUISITION_MODE: self._when_idle(self._one_of(0, 1, 2)),
            at.ACQUISITION_FRAME_COUNT: self._in_steps(lambda: (1, 65535), 1),
            at.EXPOSURE_AUTO: self._automatic(at.EXPOSURE_TIME_RAW, 10 * _AUTO_EXPOSURE_US),
            at.EXPOSURE_TIME_RAW: self._exposure,
            at.GAIN_AUTO: self._automatic(at.GAIN_RAW, _AUTO_GAIN_STEPS),
            at.GAIN_RAW: self._manual(at.GAIN_AUTO, self._in_steps(lambda: (0, model.gain_steps), 1)),
            at.ACQUISITION_FRAME_RATE_ENABLE: self._one_of(0, 1),
            at.ACQUISITION_FRAME_RATE: self._frame_rate,
            at.TRIGGER_MODE: self._one_of(0, 1),
            at.TRIGGER_SOURCE: self._one_of(0, 1),
            at.CHUNK_MODE_ACTIVE: self._when_idle(self._one_of(0, 1) if model.chunks else self._one_of(0)),
        }
        rules |= {register: self._when_idle(self._one_of(0, 1)) for register in at.CHUNK_ENABLE[1:]}
        rules[at.CHUNK_ENABLE[0]] = self._one_of(1)  # the image is always there
        return rules | self._region_rules()

    def _region_rules(self) -> dict[Register, Rule]:
        model = self._model
        axes = (
            (at.OFFSET_X, at.WIDTH, model.columns, model.offset_step[0], model.size_step[0]),
            (at.OFFSET_Y, at.HEIGHT, model.rows, model.offset_step[1], model.size_step[1]),
        )
        rules: dict[Register, Rule] = {}
        for offset, size, length, offset_step, size_step in axes:
            rules[offset] = self._when_idle(self._in_steps(self._beside(length, size, 0), offset_step))
            rules[size] = self._when_idle(self._in_steps(self._beside(length, offset, size_step), size_step))
        return rules

    def _power_on(self) -> None:
        model, put = self._model, self._memory.put_uint
        put(at.SENSOR_WIDTH, model.columns)
        put(at.SENSOR_HEIGHT, model.rows)
        put(at.WIDTH, model.columns)
        put(at.HEIGHT, model.rows)
        put(at.PIXEL_FORMAT, next(iter(self._formats)))
        put(at.EXPOSURE_TIME_RAW, 10 * _AUTO_EXPOSURE_US)
        put(at.EXPOSURE_AUTO, _CONTINUOUS)
        put(at.GAIN_AUTO, _CONTINUOUS)
        put(at.ACQUISITION_FRAME_COUNT, 1)
        self._memory.put(at.ACQUISITION_FRAME_RATE, struct.pack("<d", min(30.0, model.frame_rate_hz[1])))
        put(at.TEMPERATURE_RAW, _TEMPERATURE_RAW)
        put(at.CHUNK_ENABLE[0], 1)

    def _beside(self, length: int, other: Register, low: int) -> Callable[[], tuple[int, int]]:
        return lambda: (low, length - self._memory.uint(other))

    def _in_steps(self, limits: Callable[[], tuple[int, int]], step: int) -> Rule:
        def rule(value: int) -> int:
            low, high = limits()
            if not low <= value <= high or (value - low) % step:
                raise Refused(Status.INVALID_PARAMETER)
            return value

        return rule

    def _one_of(self, *allowed: int) -> Rule:
        def rule(value: int) -> int:
            if value not in allowed:
                raise Refused(Status.INVALID_PARAMETER)
            return value

        return rule

    def _when_idle(self, rule: Rule) -> Rule:
        def guarded(value: int) -> int:
            if self._locked():
                raise Refused(Status.ACCESS_DENIED)
            return rule(value)

        return guarded

    def _manual(self, automatic: Register, rule: Rule) -> Rule:
        def guarded(value: int) -> int:
            if self._memory.uint(automatic) != _OFF:
                raise Refused(Status.ACCESS_DENIED)
            return rule(value)

        return guarded

    def _automatic(self, governed: Register, found: int) -> Rule:
        """``Once`` finds its value at once and is off again."""

        def rule(value: int) -> int:
            if value == _ONCE:
                self._memory.put_uint(governed, found)
                return _OFF
            return self._one_of(_OFF, _CONTINUOUS)(value)

        return rule

    def _exposure(self, value: int) -> int:
        low, high = (round(10 * limit) for limit in self._model.exposure_us)
        checked = self._manual(at.EXPOSURE_AUTO, self._in_steps(lambda: (low, high), 1))(value)
        step = round(10 * self._model.exposure_step_us)
        return max(low, checked // step * step)

    def _frame_rate(self, value: int) -> int:
        rate = struct.unpack("<d", value.to_bytes(8, "little"))[0]
        low, high = self._model.frame_rate_hz
        if not low <= rate <= high:
            raise Refused(Status.INVALID_PARAMETER)
        return value
