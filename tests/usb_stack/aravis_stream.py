"""Takes frames with aravis's library, an independent USB3 Vision host, and prints what came.

    python -m tests.usb_stack.aravis_stream DEVICE COUNT sync|async

One line for each frame: its id, aravis's status (0 is success), its length in bytes and the SHA-1 of its data; then
one that says how many came.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import sys
import time

_LIBRARY = "libaravis-0.8.so.0"
_TIMEOUT_US = 10_000_000
_OPEN_S = 30.0
_BUFFERS = 4
_MODES = {"sync": 0, "async": 1}  # ArvUvUsbMode


def _library() -> ctypes.CDLL:
    library = ctypes.CDLL(_LIBRARY)
    pointer, size = ctypes.c_void_p, ctypes.c_size_t
    signatures = (
        ("arv_camera_new", pointer, (ctypes.c_char_p, pointer)),
        ("arv_camera_uv_set_usb_mode", None, (pointer, ctypes.c_int)),
        ("arv_camera_get_payload", ctypes.c_uint, (pointer, pointer)),
        ("arv_camera_create_stream", pointer, (pointer, pointer, pointer, pointer)),
        ("arv_camera_start_acquisition", None, (pointer, pointer)),
        ("arv_camera_stop_acquisition", None, (pointer, pointer)),
        ("arv_buffer_new_allocate", pointer, (size,)),
        ("arv_stream_push_buffer", None, (pointer, pointer)),
        ("arv_stream_timeout_pop_buffer", pointer, (pointer, ctypes.c_uint64)),
        ("arv_buffer_get_status", ctypes.c_int, (pointer,)),
        ("arv_buffer_get_frame_id", ctypes.c_uint64, (pointer,)),
        ("arv_buffer_get_data", pointer, (pointer, ctypes.POINTER(size))),
    )
    for name, result, arguments in signatures:
        function = getattr(library, name)
        function.restype, function.argtypes = result, arguments
    return library


def _describe(library: ctypes.CDLL, buffer: int) -> str:
    length = ctypes.c_size_t()
    address = library.arv_buffer_get_data(buffer, ctypes.byref(length))
    digest = hashlib.sha1(ctypes.string_at(address, length.value)).hexdigest()
    status = library.arv_buffer_get_status(buffer)
    return f"frame {library.arv_buffer_get_frame_id(buffer)} {status} {length.value} {digest}"


def main(device: str, count: int, mode: str) -> int:
    """Take ``count`` frames; 1 when the camera cannot be had or a frame does not come."""
    library = _library()
    end_s = time.monotonic() + _OPEN_S
    while not (camera := library.arv_camera_new(device.encode(), None)) and time.monotonic() < end_s:
        pass  # aravis's waits of 32 ms can be too short for an emulated processor that is shared
    if not camera:
        print(f"Expected aravis to open {device}, found that it cannot.")
        return 1
    library.arv_camera_uv_set_usb_mode(camera, _MODES[mode])
    stream = library.arv_camera_create_stream(camera, None, None, None)
    payload = library.arv_camera_get_payload(camera, None)
    for _ in range(_BUFFERS):
        library.arv_stream_push_buffer(stream, library.arv_buffer_new_allocate(payload))
    library.arv_camera_start_acquisition(camera, None)
    for _ in range(count):
        buffer = library.arv_stream_timeout_pop_buffer(stream, _TIMEOUT_US)
        if not buffer:
            print("Expected a frame within the time-out, found none.")
            return 1
        print(_describe(library, buffer), flush=True)
        library.arv_stream_push_buffer(stream, buffer)
    library.arv_camera_stop_acquisition(camera, None)
    print(f"{count} frames came")
    return 0


if __name__ == "__main__":
    exit_status = main(sys.argv[1], int(sys.argv[2]), sys.argv[3])
    sys.stdout.flush()
    # Without tidying up: aravis 0.8 may wait for ever for the last transfers of an asynchronous stream that is freed.
    os._exit(exit_status)
