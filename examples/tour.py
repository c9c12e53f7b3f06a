"""Make the pictures of docs/tour.md: a photograph through a rig, what each term takes from it, and each tier's answer.

python examples/tour.py OUT               # writes JPEG files into OUT, docs/images for the documentation itself
python examples/tour.py OUT --tiers preview
"""

from __future__ import annotations

import argparse
from importlib import resources
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

import udccal
from udccal.benches.bench import simulated_rig
from udccal.benches.photograph import CapturedScene, capture_photograph
from udccal.compilation import keep_compilations
from udccal.displays.pictures import face_picture
from udccal.io.photograph import read_photograph
from udccal.kernels import kernel_size, kernels_at
from udccal.models.backscatter import backscatter_rate
from udccal.models.geometry import panel_points_mm
from udccal.reports.figures import backscatter_figure, psf_figure, wire_figure
from udccal.reports.maps import TermMaps, report_positions
from udccal.restoration.tone import Tone, display_exposure, to_rgb8

RIG = "lg55-reduced"  # its shipped profile is that of specimen 0
PANEL_PICTURE, ROOM_LIGHT = 7, 0.6
DETAIL = np.s_[60:340, 340:620]
WIDTH_PX, QUALITY = 1200, 82


def panel_picture(rig: udccal.RigDescription) -> UInt8[np.ndarray, "rows columns 3"]:
    """Return a crowd that the panel shows, which no calibration has captured."""
    return face_picture(PANEL_PICTURE, rig.panel.columns, rig.panel.rows)


def term_maps(profile: udccal.Profile, shown: UInt8[np.ndarray, "rows columns 3"]) -> TermMaps:
    """Evaluate the profile's terms on the sensor."""
    rig = profile.rig
    x, y = rig.camera.columns - 1.0, rig.camera.rows - 1.0
    corners = np.asarray(panel_points_mm(profile.geometry.term, np.array([[0, 0], [x, 0], [0, y], [x, y]])))
    low, high = (f(corners / rig.panel.pitch_mm.value, axis=0) for f in (np.min, np.max))
    left, top = (int(value) for value in np.maximum(low, 0))
    right, bottom = (int(value) for value in np.minimum(high, [rig.panel.columns - 1, rig.panel.rows - 1]))
    positions = report_positions(rig)
    return TermMaps(
        wire=profile.wire_map.astype(np.float64),
        positions_px=positions,
        kernels=kernels_at(profile.psf.term, positions, *kernel_size(rig)),
        picture=shown,
        seen_px=(left, top, right, bottom),
        backscatter=np.asarray(backscatter_rate(profile.backscatter.term, shown)),
    )


def photograph() -> Float[np.ndarray, "rows columns 3"]:
    """Return the portrait that ships with udccal, in linear light, as bright as a dim room."""
    radiance = read_photograph(Path(str(resources.files("udccal") / "data" / "portrait.jpg")))
    return ROOM_LIGHT * radiance / np.percentile(radiance, 97.0)


def write_jpeg(path: Path, picture: UInt8[np.ndarray, "rows columns 3"]) -> None:
    """Write an RGB picture, no wider than a page."""
    scale = min(1.0, WIDTH_PX / picture.shape[1])
    small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(path), small[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    print(f"{path}: {path.stat().st_size / 1000:.0f} kB")


def write_figure(path: Path, figure: Figure) -> None:
    """Draw a figure and write it."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    write_jpeg(path, np.asarray(canvas.buffer_rgba())[..., :3].copy())


def side_by_side(pictures: list[UInt8[np.ndarray, "rows columns 3"]]) -> UInt8[np.ndarray, "rows wide 3"]:
    """Join pictures with white gaps."""
    gap = np.full((pictures[0].shape[0], 8, 3), 255, np.uint8)
    return np.hstack([part for picture in pictures for part in (picture, gap)][:-1])


def restored(
    profile: udccal.Profile, scene: CapturedScene, shown: np.ndarray, tiers: list[udccal.Tier], out: Path
) -> None:
    """Write the whole view before and after, and a detail at every tier."""
    tone = Tone(display_exposure(scene.ideal))
    views: list[np.ndarray] = []
    for tier in tiers:
        restorer = udccal.Restorer.from_profile(profile, tier)
        if not views:
            views.append(restorer.before(scene.mosaic, scene.exposure_s))
        views.append(restorer.restore(scene.mosaic, scene.exposure_s, shown))
    shots = [to_rgb8(tone.apply(view)) for view in (*views, scene.ideal)]
    write_jpeg(out / "tour_before_after.jpg", side_by_side([shots[0], shots[-2]]))
    write_jpeg(out / "tour_tiers.jpg", side_by_side([shot[DETAIL] for shot in shots]))


def main() -> None:
    """Make every picture of the tour."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="folder of the pictures")
    parser.add_argument("--tiers", nargs="+", type=udccal.Tier, default=list(udccal.Tier), help="tiers to show")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    keep_compilations()
    profile = udccal.load_profile(RIG)
    shown = panel_picture(profile.rig)
    maps = term_maps(profile, shown)
    write_figure(given.out / "tour_wire.jpg", wire_figure(maps, None))
    write_figure(given.out / "tour_psf.jpg", psf_figure(maps, None, None))
    write_figure(given.out / "tour_backscatter.jpg", backscatter_figure(maps, None))
    view = udccal.Restorer.from_profile(profile, udccal.Tier.preview).view
    scene = capture_photograph(simulated_rig(profile.rig, seed=0), photograph(), view, shown)
    restored(profile, scene, shown, given.tiers, given.out)


if __name__ == "__main__":
    main()
