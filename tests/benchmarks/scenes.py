"""The shared scenes in linear radiance, each with the exposure at which its 97th percentile is displayed as 0.9."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float

from udccal.io.exr import read_rgb_exr
from udccal.io.png import read_rgb8
from udccal.simulation.panorama import panorama_view

# (file, yaw, pitch): a person's view indoors and one outdoors.
_PANORAMAS = (("lobby.hdr", 40.0, -5.0), ("park.hdr", -60.0, 0.0))


DISTANCE_MM, WIDTH_MM = 2000.0, 3200.0


@dataclass(frozen=True)
class Scene:
    """A picture ``width_mm`` wide to be hung 2 m in front of the panel."""

    name: str
    radiance: Float[np.ndarray, "rows columns 3"]
    width_mm: float = WIDTH_MM


def shared_scenes(folder: Path, every: int = 1) -> Iterator[Scene]:
    """All of hdr/ and photos/ and two panorama views; ``every`` > 1 keeps each n-th of them for a quicker look."""
    files = [*sorted((folder / "hdr").glob("*.exr")), *sorted((folder / "photos").glob("*.png"))]
    for file in files[::every]:
        yield Scene(file.stem, linear_photograph(file) if file.suffix == ".png" else _linear_exr(file))
    for name, yaw, pitch in _PANORAMAS[:: min(every, 2)]:
        view = panorama_view(linear_panorama(folder / "environments" / name), yaw, pitch, 75.0, 1024, 768)
        yield Scene(f"{Path(name).stem} view", np.maximum(view, 0.0))


def _linear_exr(file: Path) -> Float[np.ndarray, "rows columns 3"]:
    return np.maximum(np.nan_to_num(read_rgb_exr(file).astype(np.float64), posinf=6e4), 0.0)


def linear_photograph(file: Path) -> Float[np.ndarray, "rows columns 3"]:
    """8-bit display values to radiance with a gamma drawn from 1.8 to 2.2 by the file's name."""
    gamma = np.random.default_rng(zlib.crc32(file.name.encode())).uniform(1.8, 2.2)
    return (read_rgb8(file) / 255.0) ** gamma


def linear_panorama(file: Path) -> Float[np.ndarray, "rows columns 3"]:
    """An equirectangular panorama, linear already."""
    return np.ascontiguousarray(cv2.imread(str(file), cv2.IMREAD_UNCHANGED)[..., ::-1]).astype(np.float64)
