"""Restore many scenes seen through a simulated rig: photographs, HDR pictures, and views into HDR panoramas.

    udccal calibrate --rig lg55-aca2040 --session session --profile profile
    python examples/restore_shared_scenes.py --profile profile --data ../shared/data --out restored

The rig and the seed must be those that the profile was made with. ``--rig`` names the rig when it is not a shipped one;
``--size`` limits the photographs' longer side and ``--every`` takes each n-th scene only, for a quick look.
"""

from __future__ import annotations

import argparse
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float

from udccal.benches.bench import simulated_rig
from udccal.benches.photograph import capture_photograph
from udccal.displays.pictures import face_picture
from udccal.io.photograph import read_photograph
from udccal.io.png import write_rgb8
from udccal.profiles.store import read_profile
from udccal.reports.pictures import PictureComparison, compare_pictures
from udccal.restoration.runtime import Restorer
from udccal.restoration.tone import to_rgb8
from udccal.rig import load_rig
from udccal.simulation.panorama import panorama_view

# (file, yaw in degrees, pitch in degrees): a person's view indoors and one outdoors.
PANORAMAS = (("lobby.hdr", 40.0, -5.0), ("park.hdr", -60.0, 0.0))
FIELD_OF_VIEW_DEG = 75.0


@dataclass(frozen=True)
class Scene:
    """A picture in linear light; its 97th percentile is 1."""

    name: str
    radiance: Float[np.ndarray, "rows columns 3"]


def scenes(folder: Path, size: int, every: int) -> Iterator[Scene]:
    """Yield all of hdr/ and photos/, and two views into panoramas."""
    files = [*sorted((folder / "hdr").glob("*.exr")), *sorted((folder / "photos").glob("*.png"))]
    for file in files[::every]:
        # The tone curve of an 8-bit photograph is unknown: gamma differs from file to file.
        gamma = np.random.default_rng(zlib.crc32(file.name.encode())).uniform(1.8, 2.2)
        yield _scene(f"{file.parent.name}-{file.stem}", read_photograph(file, float(gamma)), size)
    for name, yaw, pitch in PANORAMAS[::every]:
        equirect = read_photograph(folder / "environments" / name).astype(np.float64)
        view = panorama_view(equirect, yaw, pitch, FIELD_OF_VIEW_DEG, 1024, 768)
        yield _scene(f"{Path(name).stem}-view", view, size)


def _scene(name: str, radiance: Float[np.ndarray, "rows columns 3"], size: int) -> Scene:
    scale = min(1.0, size / max(radiance.shape[:2]))
    picture = np.clip(np.ascontiguousarray(radiance, dtype=np.float32), 0.0, 6.0e4)
    small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return Scene(name, small / max(float(np.percentile(small, 97.0)), 1e-6))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--profile", type=Path, required=True)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--out", type=Path, default=Path("restored"))
    parser.add_argument("--rig", help="name or folder of the rig, when it is not a shipped one")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--light", type=float, default=1.0, help="light in the room; 1 is a bright one")
    parser.add_argument("--size", type=int, default=4096)
    parser.add_argument("--every", type=int, default=1)
    arguments = parser.parse_args()

    profile = read_profile(arguments.profile)
    restorer = Restorer.from_profile(profile)
    world = simulated_rig(load_rig(arguments.rig or profile.rig.name), arguments.seed)
    panel = profile.rig.panel
    arguments.out.mkdir(parents=True, exist_ok=True)
    gains = []
    print(f"{'scene':22} {'before':>8} {'after':>8} {'gain':>7}   SSIM")
    for number, scene in enumerate(scenes(arguments.data, arguments.size, arguments.every)):
        shown = face_picture(9001 + number % 4, panel.columns, panel.rows)
        shot = capture_photograph(world, arguments.light * scene.radiance, restorer.view, shown)
        before = restorer.before(shot.mosaic, shot.exposure_s)
        after = restorer.restore(shot.mosaic, shot.exposure_s, shown)
        comparison = compare_pictures(scene.name, before, after, shot.ideal)
        write_rgb8(arguments.out / f"{scene.name}.png", _side_by_side(comparison))
        gains.append(comparison.gain_dB)
        print(
            f"{scene.name:22} {comparison.score_before.psnr_dB:8.2f} {comparison.score_after.psnr_dB:8.2f} "
            f"{comparison.gain_dB:+7.2f}   {comparison.score_before.ssim:.3f} -> {comparison.score_after.ssim:.3f}"
        )
    print(f"mean gain {np.mean(gains):+.2f} dB over {len(gains)} scenes; before | after | truth in {arguments.out}")


def _side_by_side(comparison: PictureComparison) -> np.ndarray:
    return to_rgb8(np.concatenate([comparison.before, comparison.after, comparison.truth], axis=1))


if __name__ == "__main__":
    main()
