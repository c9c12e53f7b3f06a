"""Writes the files of a session as docs/session.md says, and imports nothing of udccal: what other programs share."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
import OpenEXR

NOW = "2024-05-01T12:00:00+00:00"
Entry = dict[str, Any]


class FrameSource(Protocol):
    """A sensor."""

    def frame(
        self, rate: np.ndarray, exposure_s: float, x: int = 0, y: int = 0, columns: int = 0, rows: int = 0
    ) -> np.ndarray:
        """One frame in DN, 16 bits, of a region of light in e-/s."""


def about(value: float, tolerance: float) -> Entry:
    """A nominal value of the rig's description."""
    return {"value": value, "tolerance": tolerance}


class SessionWriter:
    """Collects steps; files go straight to disk, the manifest when it is finished."""

    def __init__(self, folder: str | Path, sensor: FrameSource, columns: int, rows: int) -> None:
        self.folder, self.sensor, self.clock = Path(folder), sensor, 0.0
        self.steps: list[Entry] = []
        self.whole = {"x": 0, "y": 0, "columns": columns, "rows": rows}

    def put(self, name: str, content: bytes) -> str:
        """Write a file; returns its SHA-256."""
        file = self.folder / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(content)
        return hashlib.sha256(content).hexdigest()

    def single(self, name: str, rate: np.ndarray, exposure_s: float, region: Entry | None = None) -> Entry:
        """One frame."""
        region = region or self.whole
        data = self.sensor.frame(rate, exposure_s, **region)
        sha256 = self.put(f"{name}.png", cv2.imencode(".png", data)[1].tobytes())
        return self._capture("frame", f"{name}.png", sha256, 1, exposure_s, region)

    def average(self, name: str, rate: np.ndarray, exposure_s: float, frames: int) -> Entry:
        """Mean and variance of frames of the whole sensor."""
        total, squares, first = 0.0, 0.0, self.sensor.frame(rate, exposure_s).astype(np.float64)
        for index in range(frames):
            # Differences from the first frame are small, so that their squares lose no digits.
            off = (self.sensor.frame(rate, exposure_s) if index else first) - first
            total, squares = total + off, squares + off * off
        variance = (squares - total * total / frames) / (frames - 1)
        channels = {"mean": (first + total / frames).astype(np.float32), "variance": variance.astype(np.float32)}
        file = self.folder / f"{name}.exr"
        file.parent.mkdir(parents=True, exist_ok=True)
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        with OpenEXR.File(header, channels) as exr:
            exr.write(str(file))
        sha256 = hashlib.sha256(file.read_bytes()).hexdigest()
        return self._capture("average", f"{name}.exr", sha256, frames, exposure_s, self.whole)

    def picture(self, name: str, picture: np.ndarray, role: str) -> Entry:
        """The subject of a step whose panel shows an 8-bit RGB picture."""
        sha256 = self.put(f"{name}_shown.png", cv2.imencode(".png", picture[..., ::-1])[1].tobytes())
        return {"kind": "panel", "picture": f"{name}_shown.png", "picture_sha256": sha256, "role": role}

    def step(self, step_id: str, subject: Entry, captures: list[Entry]) -> None:
        """Add a step."""
        term = step_id.split("/")[0]
        self.steps.append({"id": step_id, "term": term, "subject": subject, "completed_at": NOW, "captures": captures})

    def finish(self, rig: Entry, camera: Entry) -> None:
        """Write the manifest."""
        head = {"format": "udccal-session", "version": 1, "created_at": NOW}
        self.put("session.json", json.dumps({**head, "rig": rig, "camera": camera, "steps": self.steps}).encode())

    def _capture(self, kind: str, name: str, sha256: str, frames: int, exposure_s: float, region: Entry) -> Entry:
        self.clock += 1.0
        return {
            "kind": kind,
            "file": name,
            "sha256": sha256,
            "frames": frames,
            "exposure_s": exposure_s,
            "gain_dB": 0.0,
            "region": region,
            "first_timestamp_s": self.clock,
            "last_timestamp_s": self.clock,
            "rejected": [],
        }
