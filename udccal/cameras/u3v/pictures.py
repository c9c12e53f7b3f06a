"""Turns a block of the stream into a frame: unpacks samples, reads its chunks, and sets missing samples to 0."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, final

from udccal.cameras.pixel_formats import PixelFormat, payload_bytes, pixel_format_of, unpack
from udccal.cameras.protocol import Frame, Settings
from udccal.cameras.u3v.chunk_values import ChunkValues, read_chunks
from udccal.cameras.u3v.chunks import behind_picture
from udccal.cameras.u3v.nodes import NodeMap
from udccal.cameras.u3v.receiver import Block
from udccal.cameras.u3v.stream import ImageInfo, PayloadType
from udccal.errors import CameraProtocolError

_NS_PER_S: Final = 1e9
# Whole samples of every packing fill this many bytes: least common multiple of 1, 2, 3 and 5.
_WHOLE_SAMPLES_BYTES: Final = 30
_NO_CHUNKS: Final = ChunkValues(None, None, None)


@final
@dataclass(frozen=True)
class PictureReader:
    """Makes frames of blocks taken with settings that the camera accepted.

    Attributes:
        tick_s: unit of the time in chunks.
        temperature_C: of the camera before its frames; None where it says none.
    """

    nodes: NodeMap
    settings: Settings
    format: PixelFormat
    tick_s: float
    temperature_C: float | None = None

    def frame(self, payload: memoryview, block: Block, frame_id: int) -> Frame:
        """Return the frame in a block; its payload may be reused afterwards.

        Raises:
            CameraProtocolError: when the picture does not fit the settings.
        """
        image = self._image(block)
        rows, columns = self.settings.region.rows, self.settings.region.columns
        needed = payload_bytes(self.format, rows, columns, image.padding_x)
        if needed > len(payload):
            raise CameraProtocolError(
                f"Expected a picture of up to {len(payload)} bytes, found {needed} with {image.padding_x} bytes after "
                "each line. Update the camera's firmware."
            )
        trailer = block.trailer
        complete = (
            block.whole and block.valid >= needed and (trailer is None or trailer.rows is None or trailer.rows == rows)
        )
        values = _NO_CHUNKS
        if complete and block.leader.payload_type is PayloadType.IMAGE_EXTENDED_CHUNK:
            try:
                values = read_chunks(self.nodes, behind_picture(payload[: block.valid], needed), self.tick_s)
            except CameraProtocolError:
                complete = False
        if block.valid < needed:
            # Samples begin at multiples of these bytes, counted from the start of a line or of the picture.
            unit = needed // rows if image.padding_x else _WHOLE_SAMPLES_BYTES
            start = block.valid // unit * unit
            payload[start:needed] = bytes(needed - start)
        data = unpack(payload[:needed], self.format, rows, columns, image.padding_x)
        timestamp_s = block.leader.timestamp_ns / _NS_PER_S
        if not block.leader.timestamp_ns and values.timestamp_s is not None:
            timestamp_s = values.timestamp_s
        return Frame(data, self._taken_with(values), timestamp_s, frame_id, complete, self.temperature_C)

    def _image(self, block: Block) -> ImageInfo:
        """Return the picture that the leader announces, if it fits the settings."""
        image = block.leader.image
        if image is None:
            raise CameraProtocolError("Expected a picture, found chunks alone. Switch ChunkEnable of Image on.")
        region, format = self.settings.region, pixel_format_of(image.pixel_format)
        if (image.columns, image.rows, format) != (region.columns, region.rows, self.format):
            raise CameraProtocolError(
                f"Expected {region.columns} x {region.rows} pixels in {self.format.name}, found {image.columns} x "
                f"{image.rows} in {format.name}. Configure the camera again."
            )
        return image

    def _taken_with(self, values: ChunkValues) -> Settings:
        settings = self.settings
        if values.exposure_s is not None:
            settings = replace(settings, exposure_s=values.exposure_s)
        if values.gain_dB is not None:
            settings = replace(settings, gain_dB=values.gain_dB)
        return settings
