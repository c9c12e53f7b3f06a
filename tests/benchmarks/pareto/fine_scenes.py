"""Scenes with detail to the pixel: pictures that are hung so large that a texel is about one pixel of the sensor.

A photograph of the Kodak suite that fills the view has a texel of some two to four pixels: the finest detail that a
sensor can see is not in it. Several of them side by side have it, and so have panoramas hung flat, in bands. The
panoramas are the two that no training of the network has seen.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from tests.benchmarks.scenes import DISTANCE_MM, Scene, linear_panorama, linear_photograph
from udccal.simulation.truth import RigTruth

_MOSAICS = 3
_PANORAMAS = ("lobby.hdr", "park.hdr")
# The scans of the Kodak suite have a black edge; between photographs it would be a line.
_EDGE_PX = 4

Radiance = Float[np.ndarray, "rows columns 3"]


def fine_scenes(folder: Path, truth: RigTruth, every: int = 1) -> list[Scene]:
    """Mosaics of photographs, and panoramas at their full resolution, for the pixels of a rig.

    Args:
        folder: of the shared pictures.
        truth: the rig.
        every: keeps each n-th scene for a quicker look.
    """
    photographs = [linear_photograph(file) for file in sorted((folder / "photos").glob("*.png"))]
    camera = truth.description.camera
    scenes = [
        Scene(f"mosaic {index + 1}", mosaic_of(photographs, index, camera.rows, camera.columns))
        for index in range(_MOSAICS)
    ]
    for name in _PANORAMAS:
        bands = bands_of(linear_panorama(folder / "environments" / name), camera.rows, camera.columns)
        scenes.append(Scene(f"{Path(name).stem} bands", bands))
    return [_hung(scene, truth) for scene in scenes[::every]]


def mosaic_of(photographs: list[Radiance], index: int, rows: int, columns: int) -> Radiance:
    """Photographs side by side, without their edges, that cover as many texels as a sensor has pixels.

    Args:
        photographs: of one size, or on their sides.
        index: of the mosaic; each has other photographs first, in another order.
        rows: that are covered at least. columns: that are covered at least.
    """
    order = (
        np.random.default_rng([0xF19E, index]).permutation(len(photographs)) if index else np.arange(len(photographs))
    )
    inner = [_lying(photograph)[_EDGE_PX:-_EDGE_PX, _EDGE_PX:-_EDGE_PX] for photograph in photographs]
    height, width = min(each.shape[0] for each in inner), min(each.shape[1] for each in inner)
    across, down = -(-columns // width), -(-rows // height)
    chosen = [inner[order[place % len(order)]][:height, :width] for place in range(across * down)]
    return np.concatenate([np.concatenate(chosen[row * across : (row + 1) * across], axis=1) for row in range(down)])


def bands_of(equirect: Radiance, rows: int, columns: int) -> Radiance:
    """The middle of a panorama, hung in bands below each other, each turned to another side.

    Towards its poles a panorama is stretched, and has no fine detail.

    Args:
        equirect: the panorama.
        rows: that are covered at least. columns: that are covered at least.
    """
    pole = equirect.shape[0] // 8
    band = equirect[pole:-pole]
    down, across = -(-rows // len(band)), -(-columns // band.shape[1])
    turned = [np.roll(band, index * band.shape[1] // down, axis=1) for index in range(down)]
    return np.concatenate([np.concatenate([each] * across, axis=1) for each in turned])


def _lying(photograph: Radiance) -> Radiance:
    """The longer side across."""
    return photograph if photograph.shape[1] >= photograph.shape[0] else np.rot90(photograph)


def _hung(scene: Scene, truth: RigTruth) -> Scene:
    """So large that a texel is a pixel of the sensor, straight ahead."""
    texel_mm = (DISTANCE_MM - float(truth.optics.pupil_mm[2])) / truth.optics.fx_px
    return Scene(scene.name, scene.radiance, texel_mm * scene.radiance.shape[1])
