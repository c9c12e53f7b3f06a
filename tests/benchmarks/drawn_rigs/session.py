"""Writes the session of a drawn rig as docs/session.md says, with nothing of udccal.

python -m tests.benchmarks.drawn_rigs.session SEED FOLDER
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np

from tests.benchmarks.drawn_rigs import diffraction
from tests.benchmarks.drawn_rigs.draw import Rig, draw
from tests.benchmarks.drawn_rigs.optics import directions, mosaic, rotation, sensor_pixels
from tests.benchmarks.drawn_rigs.scatter import Scatter
from tests.benchmarks.drawn_rigs.sensor import DrawnSensor
from tests.benchmarks.drawn_rigs.wire import wire_map
from tests.scenes.session_writer import Entry, SessionWriter, about

WHITE = np.array([0.6, 1.0, 0.7])
BOARD: Entry = {"columns": 7, "rows": 5, "square_mm": 75.0, "marker_mm": 56.0, "dictionary": "DICT_4X4_100"}
CAMERA = {"vendor": "drawn", "model": "drawn", "serial": "1", "backend": "drawn"}
_LONGEST_S, _LED_GRID, _LED_SHIFTS, _LED_FRAMES, LED_REGION = 10.0, (3, 3), 4, 6, (48, 96)
_FLATS, _LEVELS, _VIEWS, _PICTURES, _FRAMES = 80, 12, 10, 10, 4


@dataclass(frozen=True)
class Scene:
    """A rig, what its sensor sees through the panel, and where its session goes."""

    rig: Rig
    writer: SessionWriter
    rng: np.random.Generator

    @cached_property
    def wire(self) -> np.ndarray:
        """The map of the whole sensor."""
        return wire_map(self.rig)

    @cached_property
    def flat(self) -> np.ndarray:
        """Light of an even white field in e-/s."""
        even = np.broadcast_to(WHITE, (self.rig.rows, self.rig.columns, 3))
        return self.rig.flat_e_per_s * mosaic(self.rig, even) * self.wire

    @property
    def dark(self) -> np.ndarray:
        """No light."""
        return np.zeros((self.rig.rows, self.rig.columns))

    @property
    def full_e(self) -> float:
        """Electrons at saturation of the well or of the converter."""
        noise = self.rig.noise
        return min(noise.well_e, (2**noise.bits - 1 - noise.black_DN) / noise.K_DN_per_e)

    def filling(self, rate: np.ndarray, part: float) -> float:
        """Exposure at which the brightest sample reaches this part of saturation."""
        return float(np.clip(part * self.full_e / rate.max(), 2e-6, _LONGEST_S))


def write_noise(scene: Scene) -> None:
    """Pairs of flats and darks up to beyond saturation, long darks, and two stacks."""
    writer, half_s = scene.writer, scene.filling(scene.flat, 0.5)
    for kind, rate in (("flat", scene.flat), ("dark", scene.dark)):
        writer.step(f"noise/{kind}_stack", {"kind": kind}, [writer.average(f"noise/{kind}_stack", rate, half_s, 16)])
        times = [float(half_s * factor) for factor in np.linspace(0.05, 2.4, _LEVELS)]
        for index, seconds in enumerate(times + [0.25, 1.0, 4.0] * (kind == "dark")):
            name = f"noise/{kind}_{index}"
            writer.step(name, {"kind": kind}, [writer.single(f"{name}_{k}", rate, seconds) for k in (0, 1)])


def write_wire(scene: Scene) -> None:
    """A long average and its dark."""
    writer, seconds = scene.writer, scene.filling(scene.flat, 0.65)
    writer.step("wire/flat", {"kind": "flat"}, [writer.average("wire/flat", scene.flat, seconds, _FLATS)])
    writer.step("wire/dark", {"kind": "dark"}, [writer.average("wire/dark", scene.dark, seconds, 16)])


def write_psf(scene: Scene) -> None:
    """LEDs on a grid, several places each; the session says where they were to within a pixel."""
    rig, writer, rng = scene.rig, scene.writer, scene.rng
    size, around = (rig.columns, rig.rows), np.array(LED_REGION)
    flux = scene.full_e * 2e4
    far = rig.led_distance_mm + rig.true("standoff_mm")
    disc_px = rig.led_mm / far * float(rig.lens.focal_px.mean())
    grid = [np.linspace(0.04, 0.96, count) * (n - 1) for count, n in zip(_LED_GRID, size, strict=True)]
    for position, place in enumerate(np.stack(np.meshgrid(*grid), axis=-1).reshape(-1, 2)):
        first = np.clip(place - around / 2, 0, size - around).astype(int) // 2 * 2
        region = dict(zip(("x", "y", "columns", "rows"), [*first.tolist(), *around.tolist()], strict=True))
        part = np.s_[first[1] : first[1] + around[1], first[0] : first[0] + around[0]]
        reach = np.maximum(np.abs(place - first), np.abs(first + around - place)) + 4
        spread = diffraction.spread_of(rig, place, tuple(reach), disc_px)
        for shift in range(_LED_SHIFTS):
            source = place + (np.array([shift % 2, shift // 2]) + rng.uniform(0.05, 0.95, 2)) - 1.0
            x, y = (f + np.arange(n) for f, n in zip(first, around, strict=True))
            colours = diffraction.light(rig, spread, source, x, y)
            rate = flux * mosaic(rig, WHITE * colours, tuple(first)) * scene.wire[part]
            start, name = scene.filling(rate, 0.8), f"psf/p{position:02d}_s{shift}"
            times = sorted({min(start * 4.0**k, _LONGEST_S) for k in range(_LED_FRAMES)})
            frames = [writer.single(f"{name}_{k}", rate, seconds, region) for k, seconds in enumerate(times)]
            said = dict(zip(("x_px", "y_px"), source + rng.uniform(-0.5, 0.5, 2), strict=True))
            led = {"kind": "led", "distance_mm": rig.led_distance_mm, "diameter_mm": rig.led_mm}
            writer.step(name, {**led, **said}, frames)


def write_backscatter(scene: Scene) -> None:
    """White, dark, pictures and brightened ones, all at one exposure."""
    rig, writer, scatter = scene.rig, scene.writer, Scatter(scene.rig)
    white = np.full((rig.panel[1], rig.panel[0], 3), 255, np.uint8)
    shown = {"white": ("white", white)}
    for index in range(_PICTURES):
        picture = panel_picture(scene.rng, rig)
        shown[f"picture_{index}"] = ("picture", picture)
        if index % 2:
            lit = np.minimum((2 * (picture / 255) ** 2.2 + 0.3) ** (1 / 2.2), 1)
            shown[f"brightened_{index}"] = ("brightened", np.rint(255 * lit).astype(np.uint8))
    seconds = scene.filling(scatter.rate(white) * scene.wire, 0.7)
    for key, (role, picture) in shown.items():
        name, rate = f"backscatter/{key}", scatter.rate(picture) * scene.wire
        writer.step(name, writer.picture(name, picture, role), [writer.average(name, rate, seconds, _FRAMES)])
    dark = writer.average("backscatter/dark", scene.dark, seconds, _FRAMES)
    writer.step("backscatter/dark", {"kind": "dark"}, [dark])


def panel_picture(rng: np.random.Generator, rig: Rig) -> np.ndarray:
    """Soft areas of varied colour, some ten panel pixels wide, and patches with edges."""
    columns, rows = rig.panel
    soft = cv2.resize(
        rng.uniform(-40, 295, (rows // 9, columns // 9, 3)), (columns, rows), interpolation=cv2.INTER_CUBIC
    )
    for _ in range(columns * rows // 150):
        x, y, w, h = rng.integers([0, 0, 3, 3], [columns, rows, 16, 16])
        soft[y : y + h, x : x + w] = rng.uniform(0, 255, 3)
    return np.rint(np.clip(soft, 0, 255)).astype(np.uint8)


def write_geometry(scene: Scene) -> None:
    """Boards held by hand, and one parallel to the panel."""
    rig, writer, rng = scene.rig, scene.writer, scene.rng
    half_view = np.array([rig.columns, rig.rows]) / 2 / rig.lens.focal_px
    centre = (np.array([rig.columns, rig.rows]) - 1) / 2
    blur = np.moveaxis(diffraction.kernel(rig, centre, 41, 21), 0, -1)
    turn = rotation(rig)
    parallel = (np.eye(3), 650 * turn[:, 2])
    poses = [parallel]
    for index in range(_VIEWS):
        lean = rng.uniform(0.3, 0.6, 2) * [1 - 2 * (index & 1), 1 - (index & 2)]
        if index % 3 == 2:
            lean[rng.integers(2)] = 0.0
        way = np.array([(index & 1) * 2 - 1, (index >> 1 & 1) * 2 - 1]) * rng.uniform(0.1, 0.5, 2)
        at = rng.uniform(560, 760) * np.array([*(way * half_view), 1.0])
        poses.append((turn @ cv2.Rodrigues(np.array([*lean, rng.uniform(-0.4, 0.4)]))[0], turn @ at))
    for index, (own, offset) in enumerate(poses):
        rate = board_rate(rig, own, rig.pupil_place_mm + offset, blur) * scene.wire
        name = f"geometry/view_{index - 1}" if index else "geometry/panel"
        subject = {"kind": "board", **BOARD, "parallel_to_panel": not index}
        writer.step(name, subject, [writer.average(name, rate, scene.filling(rate, 0.75), _FRAMES)])


def board_rate(rig: Rig, turn: np.ndarray, centre_mm: np.ndarray, blur: np.ndarray) -> np.ndarray:
    """Light of a board whose middle and rotation are given in the panel's frame; the wire is not in it."""
    texels, square, size = 60, BOARD["square_mm"], (BOARD["columns"], BOARD["rows"])
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, BOARD["dictionary"]))
    board = cv2.aruco.CharucoBoard(size, square, BOARD["marker_mm"], dictionary)
    picture = board.generateImage((size[0] * texels, size[1] * texels), marginSize=0).astype(np.float32) / 255
    picture = cv2.GaussianBlur(picture, (0, 0), 1.0)
    corner = centre_mm - turn @ (np.array([*size, 0]) * square / 2)
    start, run = turn.T @ (rig.pupil_place_mm - corner), directions(rig, sensor_pixels(rig)) @ turn
    on_board = start[:2] - start[2] * run[..., :2] / run[..., 2:]
    texel = (on_board / square * texels - 0.5).astype(np.float32)
    grey = cv2.remap(picture, texel[..., 0], texel[..., 1], cv2.INTER_LINEAR, borderValue=0.4)
    # A correlation, which turns the kernel about: it is even in direction, to which these small ones are close.
    colours = [w * cv2.filter2D(0.05 + grey, -1, blur[..., c].astype(np.float32)) for c, w in enumerate(WHITE)]
    return rig.flat_e_per_s / 2 * mosaic(rig, np.stack(colours, axis=-1).astype(float))


def description(rig: Rig) -> Entry:
    """What the rig was built to be."""
    known = {name: about(one.nominal, one.tolerance) for name, one in rig.about.items()}

    def these(*names: str) -> Entry:
        return {name: known[name] for name in names}

    return {
        "format": "udccal-rig", "version": 2, "name": f"drawn-{rig.seed}",
        "panel": {
            "model": "drawn", "columns": rig.panel[0], "rows": rig.panel[1],
            "glass_thickness_mm": rig.glass[0], "glass_index": rig.glass[1],
            **these("pitch_mm", "row_open", "column_open", "depth_mm", "gamma"),
        },
        "camera": {
            "model": "drawn", "columns": rig.columns, "rows": rig.rows, "pitch_um": rig.pitch_um, "cfa": rig.cfa,
            "bits": rig.noise.bits, "frame_rate_hz": 60.0, "min_exposure_s": 1e-6, "max_exposure_s": _LONGEST_S,
            **these("full_well_e", "black_DN", "K_DN_per_e"),
        },
        "lens": {"model": "drawn", "focus_mm": rig.lens.focus_mm, **these("focal_mm", "f_number")},
        "mounting": these("standoff_mm", "tilt_deg", "roll_deg", "yaw_deg", "panel_x_px", "panel_y_px"),
        "captures": {
            "psf_columns": _LED_GRID[0], "psf_rows": _LED_GRID[1], "psf_shifts": _LED_SHIFTS,
            "psf_exposures": _LED_FRAMES, "psf_region_columns": LED_REGION[0], "psf_region_rows": LED_REGION[1],
        },
        "view": {"columns": 256, "rows": 144},
    }  # fmt: skip


WRITERS: dict[str, Callable[[Scene], None]] = {
    "noise": write_noise, "geometry": write_geometry, "wire": write_wire, "psf": write_psf,
    "backscatter": write_backscatter,
}  # fmt: skip


def write_session(rig: Rig, folder: Path, terms: Iterable[str] = WRITERS) -> None:
    """Write the session of these terms."""
    writer = SessionWriter(folder, DrawnSensor(rig), rig.columns, rig.rows)
    scene = Scene(rig, writer, np.random.default_rng([rig.seed, 6]))
    for term in terms:
        WRITERS[term](scene)
    writer.finish(description(rig), CAMERA)


def require_own(modules: Iterable[str]) -> None:
    """Make sure that nothing of udccal had a part in the light.

    Raises:
        RuntimeError: when one of these modules is udccal's.
    """
    used = [name for name in modules if name.split(".")[0] in ("udccal", "procedures")]
    if used:
        raise RuntimeError(f"Expected a program of its own, found {', '.join(used)} imported. Remove the import.")


def main() -> None:
    """Write the session of a seed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("seed", type=int)
    parser.add_argument("folder", type=Path)
    options = parser.parse_args()
    write_session(draw(options.seed), options.folder)
    require_own(sys.modules)


if __name__ == "__main__":
    main()
