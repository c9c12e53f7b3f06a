"""Writes a session as docs/session.md says, and imports nothing of udccal.

Run it as a program from the project's folder: ``python -m tests.sessions.foreign_writer FOLDER``.
"""

import sys

import cv2
import numpy as np

from tests.scenes.session_writer import SessionWriter, about
from tests.sessions import foreign_world as world

BOARD = {"columns": 7, "rows": 5, "square_mm": 75.0, "marker_mm": 56.0, "dictionary": "DICT_4X4_100"}
CAMERA = {"vendor": "other", "model": "tiny", "serial": "7", "backend": "foreign"}


def rig():
    """The description of the rig: nominal values near the true ones, with tolerances."""
    return {
        "format": "udccal-rig",
        "version": 2,
        "name": "foreign-tiny",
        "panel": {
            "model": "other display",
            "columns": world.PANEL_COLUMNS,
            "rows": world.PANEL_ROWS,
            "pitch_mm": about(0.63, 0.002),
            "row_open": about(0.4, 0.05),
            "column_open": about(0.94, 0.02),
            "depth_mm": about(0.03, 0.01),
            "glass_thickness_mm": 0.7,
            "glass_index": 1.52,
            "gamma": about(2.2, 0.05),
        },
        "camera": {
            "model": "tiny",
            "columns": world.COLUMNS,
            "rows": world.ROWS,
            "pitch_um": 13.333,
            "cfa": world.CFA,
            "bits": world.BITS,
            "full_well_e": about(11500.0, 600.0),
            "black_DN": about(64.0, 8.0),
            "K_DN_per_e": about(0.36, 0.02),
            "frame_rate_hz": 60.0,
            "min_exposure_s": 2e-5,
            "max_exposure_s": 10.0,
        },
        "lens": {"model": "6 mm", "focal_mm": about(6.0, 0.1), "f_number": about(1.85, 0.05), "focus_mm": 2000.0},
        "mounting": {
            "standoff_mm": about(13.2, 0.5),
            "tilt_deg": about(11.5, 1.0),
            "roll_deg": about(0.0, 1.0),
            "yaw_deg": about(0.0, 1.0),
            "panel_x_px": about(80.0, 3.0),
            "panel_y_px": about(40.0, 3.0),
        },
        "captures": {"psf_columns": 4, "psf_rows": 3, "psf_shifts": 4, "psf_exposures": 5, "board_views": 8},
        "view": {"columns": 256, "rows": 144},
    }


def write_noise(writer):
    """Pairs of flats from nearly nothing to beyond saturation, pairs of darks, and two stacks."""
    dark, flat = np.zeros((world.ROWS, world.COLUMNS)), world.flat_rate()
    half_s = 0.5 * 11000 / flat.max()
    for kind, rate in (("flat", flat), ("dark", dark)):
        writer.step(f"noise/{kind}_stack", {"kind": kind}, [writer.average(f"noise/{kind}_stack", rate, half_s, 16)])
        for index, factor in enumerate(np.linspace(0.05, 2.3, 10)):
            name, seconds = f"noise/{kind}_{index}", float(half_s * factor)
            writer.step(name, {"kind": kind}, [writer.single(f"{name}_{k}", rate, seconds) for k in (0, 1)])
    writer.step("noise/dark_10", {"kind": "dark"}, [writer.single(f"noise/dark_10_{k}", dark, 4.0) for k in (0, 1)])


def write_wire(writer):
    """One long average and its dark."""
    flat = world.flat_rate()
    seconds = 0.65 * 11000 / flat.max()
    writer.step("wire/flat", {"kind": "flat"}, [writer.average("wire/flat", flat, seconds, 40)])
    writer.step("wire/dark", {"kind": "dark"}, [writer.average("wire/dark", 0 * flat, seconds, 16)])


def write_psf(writer):
    """LEDs on a 4 x 3 grid, four places each, five exposures each."""
    subject = {"kind": "led", "distance_mm": 2000.0, "diameter_mm": 2.0}
    for position, (x, y) in enumerate((x, y) for y in (20, 180, 340) for x in (20, 166, 312, 458)):
        columns, rows = 64, 96
        region = {
            "x": min(max(x - 32, 0), world.COLUMNS - columns) // 2 * 2,
            "y": min(max(y - 48, 0), world.ROWS - rows) // 2 * 2,
            "columns": columns,
            "rows": rows,
        }
        for shift, (dx, dy) in enumerate(((0.2, 0.3), (1.4, 0.8), (0.7, 1.6), (1.9, 1.1))):
            rate = world.led_rate(x + dx, y + dy, 2.0 / 2013.0 * world.FOCAL_PX)
            first_s = 0.8 * 11000 / rate.max()
            name = f"psf/p{position:02d}_s{shift}"
            captures = [writer.single(f"{name}_{k}", rate, float(min(first_s * 4**k, 10.0)), region) for k in range(5)]
            writer.step(name, {**subject, "x_px": x + dx, "y_px": y + dy}, captures)


def write_backscatter(writer):
    """White, dark, six pictures and the brightened versions of two of them, all at one exposure."""
    shape = (world.PANEL_ROWS, world.PANEL_COLUMNS, 3)
    rng = np.random.default_rng(5)
    pictures = {"white": ("white", np.full(shape, 255, np.uint8))}
    for index in range(6):
        coarse = rng.uniform(0, 255, (5, 8, 3))
        picture = np.clip(cv2.resize(coarse, shape[1::-1], interpolation=cv2.INTER_CUBIC), 0, 255).astype(np.uint8)
        pictures[f"picture_{index}"] = ("picture", picture)
        if index < 2:
            brighter = np.minimum((2 * (picture / 255.0) ** 2.2 + 0.3) ** (1 / 2.2), 1) * 255
            pictures[f"brightened_{index}"] = ("brightened", np.rint(brighter).astype(np.uint8))
    seconds = float(0.7 * 11000 / world.backscatter_rate(pictures["white"][1]).max())
    for key, (role, picture) in pictures.items():
        name = f"backscatter/{key}"
        average = writer.average(name, world.backscatter_rate(picture), seconds, 4)
        writer.step(name, writer.picture(name, picture, role), [average])
    dark = np.zeros((world.ROWS, world.COLUMNS))
    writer.step("backscatter/dark", {"kind": "dark"}, [writer.average("backscatter/dark", dark, seconds, 4)])


def write_geometry(writer):
    """Eight boards held by hand and one parallel to the panel."""
    size = (BOARD["columns"], BOARD["rows"])
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, BOARD["dictionary"]))
    board = cv2.aruco.CharucoBoard(size, BOARD["square_mm"], BOARD["marker_mm"], dictionary)
    axis = world.rotation()[:, 2]
    poses = [(np.eye(3), 700 * axis, True)]
    leans = ((0.5, 0, 0), (-0.5, 0.1, 0.2), (0, 0.5, 0), (0.1, -0.5, 0), (0.4, 0.4, 0.3), (-0.4, 0.4, 0))
    for index, lean in enumerate((*leans, (0.3, -0.4, 0), (0, 0, 1.2))):
        aside = np.array([(-1) ** index * 110, (index % 3 - 1) * 80, 0])
        turn = world.rotation() @ cv2.Rodrigues(np.array(lean, float))[0]
        poses.append((turn, (620 + 25 * index) * axis + aside, False))
    for index, (turn, offset, parallel) in enumerate(poses):
        centre = np.array([*world.PUPIL_XY_MM, -world.STANDOFF_MM]) + offset
        rate = world.board_rate(board, BOARD["square_mm"], size, turn, centre)
        name = "geometry/panel" if parallel else f"geometry/view_{index - 1}"
        subject = {"kind": "board", **BOARD, "parallel_to_panel": parallel}
        writer.step(name, subject, [writer.average(name, rate, float(0.75 * 11000 / rate.max()), 4)])


def main(folder):
    """Write the whole session."""
    writer = SessionWriter(folder, world.Sensor(), world.COLUMNS, world.ROWS)
    for write in (write_noise, write_geometry, write_wire, write_psf, write_backscatter):
        write(writer)
    writer.finish(rig(), CAMERA)
    used = [name for name in sys.modules if name.split(".")[0] in ("udccal", "procedures")]
    assert not used, used


if __name__ == "__main__":
    main(sys.argv[1])
