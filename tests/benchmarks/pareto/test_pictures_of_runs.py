"""Groups of cases, fine scenes, sheets, and what a picture is judged by."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from jaxtyping import Float

from tests.benchmarks.pareto.drawing import draw
from tests.benchmarks.pareto.fine_scenes import bands_of, mosaic_of
from tests.benchmarks.pareto.groups import Group, cases_of
from tests.benchmarks.pareto.made_runs import DB, good_runs, made
from tests.benchmarks.pareto.runs import Clear, band_percent, flip, mean_dB, median_ms, of_group, write_csv
from tests.benchmarks.pareto.sheets import busiest_part, shown_part, write_sheet
from tests.benchmarks.pareto.tables import clear_dB, groups_table
from tests.benchmarks.pictures import Shot
from udccal.arrangements import Photograph
from udccal.io.png import read_rgb8
from udccal.tiers import Tier

EMPTY = np.zeros((1, 1, 3), np.float32)
NAMES = ("Carrots", "CandleGlass", "Desk", "kodim07", "kodim15", "lobby view", "park view")


def shot(name: str) -> Shot:
    return Shot(name, Photograph(EMPTY, 1.0, 1.0), 1.0, EMPTY[..., 0], EMPTY, 0)


def picture(rows: int = 64, columns: int = 96) -> Float[np.ndarray, "rows columns 3"]:
    return np.random.default_rng(5).random((rows, columns, 3)).astype(np.float32) * 0.5 + 0.25


def test_every_group_has_cases_and_lamps_are_no_other_pictures() -> None:
    cases = cases_of([shot(name) for name in NAMES], [shot("mosaic 1")])
    counts = {group: sum(case.group is group for case in cases) for group in Group}
    assert counts == {Group.nineteen: 7, Group.fine: 1, Group.lamps: 2, Group.dark: 6, Group.panel: 20}
    assert len({case.key for case in cases}) == 7 + 1 + 6 + 20
    greys = {case.conditions.grey for case in cases if case.group is Group.panel}
    assert greys == {0, 64, 128, 255, None}


def test_a_quicker_look_has_a_scene_in_every_group() -> None:
    cases = cases_of([shot("kodim01")], [shot("mosaic 1")])
    assert {case.group for case in cases} == set(Group)


def test_a_mosaic_covers_the_sensor_without_the_edges_of_the_scans() -> None:
    photographs = [np.full((40, 60, 3), float(index)) for index in range(6)]
    photographs[1] = np.full((60, 40, 3), 1.0)
    for each in photographs:
        each[:2] = each[-2:] = 99.0
        each[:, :2] = each[:, -2:] = 99.0
    mosaic = mosaic_of(photographs, 0, 60, 100)
    assert mosaic.shape == (64, 104, 3)
    assert set(np.unique(mosaic)) == {0.0, 1.0, 2.0, 3.0}
    assert not np.array_equal(mosaic, mosaic_of(photographs, 1, 60, 100))
    assert np.array_equal(mosaic, mosaic_of(photographs, 0, 60, 100))


def test_bands_of_a_panorama_cover_the_sensor_without_its_poles() -> None:
    equirect = np.broadcast_to(np.arange(16.0)[:, None, None], (16, 32, 3)).copy()
    equirect[:, 0] = 99.0
    bands = bands_of(equirect, 20, 40)
    assert bands.shape == (24, 64, 3)
    assert bands[:, 1, 0].tolist() == [*range(2, 14)] * 2
    assert np.argwhere(bands[0, :, 0] == 99.0).ravel().tolist() == [0, 32]
    assert np.argwhere(bands[12, :, 0] == 99.0).ravel().tolist() == [16, 48]


def test_flip_tells_a_spoilt_picture_from_a_good_one() -> None:
    truth = picture()
    noisy = truth + np.random.default_rng(6).normal(0, 0.05, truth.shape).astype(np.float32)
    green = truth * np.array([0.8, 1.1, 0.8], np.float32)
    assert flip(truth, truth) == pytest.approx(0.0, abs=1e-6)
    assert flip(truth, truth) < flip(noisy, truth) < 1
    assert flip(green, truth) > 0.1


@pytest.mark.parametrize(("cycles_per_px", "seen"), [(0.24, 1.0), (0.19, 1.0), (0.12, 0.0), (0.36, 0.0)])
def test_lines_in_the_band_that_the_panel_swallows_are_told_by_their_size(cycles_per_px: float, seen: float) -> None:
    truth = np.full((250, 40, 3), 0.5, np.float32)
    lines = (0.01 * np.sin(2 * np.pi * cycles_per_px * np.arange(250))).astype(np.float32)
    expected = pytest.approx(100 * seen * 0.01 / np.sqrt(2) / 0.5, rel=0.02, abs=0.01)
    assert band_percent(truth + lines[:, None, None], truth) == expected
    across = np.broadcast_to(lines[:40, None], truth.shape)
    assert band_percent(truth + across, truth) == pytest.approx(0.0, abs=0.01)
    assert band_percent(truth, truth) == 0.0


def test_means_of_a_group_leave_the_others_out() -> None:
    runs = [*good_runs(), made(Group.dark, Tier.fast, "cellar", dB=5.0)]
    assert mean_dB(of_group(runs, Group.nineteen, Tier.fast)) == DB[Tier.fast]
    assert mean_dB(of_group(runs, Group.dark, Tier.fast)) == 5.0
    assert np.isnan(mean_dB([]))
    assert np.isnan(median_ms([], Tier.fast))


def test_a_file_has_a_line_per_run(tmp_path: Path) -> None:
    write_csv(good_runs(), tmp_path / "pareto.csv")
    with (tmp_path / "pareto.csv").open(encoding="utf-8") as stream:
        lines = list(csv.DictReader(stream))
    assert len(lines) == 16
    assert lines[0]["group"] == "nineteen"
    assert (lines[0]["tier"], float(lines[0]["after_dB"]), float(lines[0]["ms"])) == ("preview", 25.0, 4.0)


def test_tables_and_drawings_show_every_group(tmp_path: Path) -> None:
    runs = [
        *good_runs(),
        *(made(group, tier, "x") for group in (Group.lamps, Group.dark, Group.panel) for tier in Tier),
    ]
    clear = [Clear(Group.nineteen, "a", 38.0), Clear(Group.nineteen, "b", 40.0), Clear(Group.fine, "c", 35.0)]
    assert clear_dB(clear, Group.nineteen) == 39.0
    lines = groups_table(runs, clear).splitlines()
    assert len(lines) == 2 + len(Group)
    assert lines[2].endswith("| 2 | 20.00 | 25.00 | 31.00 | 33.00 | 34.00 | 39.00 | 2.50, 2.50, 2.50, 2.50 |")
    draw(runs, clear, "a title", tmp_path / "pareto.svg")
    drawing = (tmp_path / "pareto.svg").read_text(encoding="utf-8")
    assert drawing.startswith("<?xml")
    assert len(drawing) > 10_000


def test_a_sheet_shows_the_busiest_part(tmp_path: Path) -> None:
    truth = np.full((400, 600, 3), 0.5, np.float32)
    truth[300:340, 500:540] = picture(40, 40)
    rows, columns = busiest_part(truth, 200, 300)
    assert rows.start <= 300 < 340 <= rows.stop
    assert columns.start <= 500 < 540 <= columns.stop
    shown = shown_part("a title", truth * 0, truth, truth)
    write_sheet([shown, shown], tmp_path / "fast.png")
    sheet = read_rgb8(tmp_path / "fast.png")
    assert sheet.shape == (2 * (300 + 22), 3 * 420, 3)
    assert sheet[22:322, :420].max() == 0
    assert np.array_equal(sheet[22:322, 420:840], sheet[22:322, 840:])
