"""Draws of the accuracy table, and what it makes of its parts."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest

from tests.benchmarks.accuracy import finished, summaries, table
from tests.benchmarks.accuracy_part import Part, read_part
from tests.benchmarks.draws import FULL, REDUCED, Draw, draws
from tests.benchmarks.readme_tables import write_tables
from tests.benchmarks.rows import at_least, at_most
from udccal.reports.true_values import true_values


def _parts(*values: float) -> list[Part]:
    rows = [(at_most("K", value, 1.0, "%"), at_least("gain", 10 - value, 9.0, "dB")) for value in values]
    return [Part(Draw("lg55-reduced", k), f"c{k % 2}", both) for k, both in enumerate(rows)]


def test_every_rig_has_its_specimens() -> None:
    counts = {rig: sum(draw.rig == rig for draw in draws(8)) for rig in FULL + REDUCED}
    assert counts == {**dict.fromkeys(FULL, 1), **dict.fromkeys(REDUCED, 8)}
    assert {draw.number for draw in draws(8) if draw.at_ends} == {3, 7}
    assert Draw.named("lg55-reduced-3") == Draw("lg55-reduced", 3)
    with pytest.raises(ValueError, match="rig and a number"):
        Draw.named("no-such-rig-3")


def test_specimens_have_no_number_in_common() -> None:
    """Also those of two rigs: where each true number lies within its range."""
    truths = [{v.name: v.value for v in true_values(draw.truth) if v.term == "noise"} for draw in draws(2)]
    for one, other in itertools.combinations(truths, 2):
        # No data sheet gives these: all rigs draw them from one range.
        assert all(one[name] != other[name] for name in ("lambda_read", "dark_current_e_per_s", "PRNU1288"))


def test_ends_of_tolerances_are_reached() -> None:
    draw = Draw("mk31-reduced", 3)
    panel, built = draw.truth.panel, draw.description.panel
    off = (panel.pitch_mm - built.pitch_mm.value, panel.row_open - built.row_open.value)
    np.testing.assert_allclose(np.abs(off), (built.pitch_mm.tolerance, built.row_open.tolerance))


def test_median_and_worst_are_of_all_specimens() -> None:
    K, gain = summaries(_parts(0.1, 0.3, 2.0))
    assert (K.median.value, K.worst.value, gain.worst.value) == (0.3, 2.0, 8.0)
    assert K.median.ok
    assert not K.worst.ok
    assert not gain.worst.ok
    assert table([K, gain]).count("**missed**") == 2
    assert "**missed**" not in table(summaries(_parts(0.1, 0.3)))


def test_a_number_that_is_none_is_the_worst() -> None:
    K, _ = summaries(_parts(0.1, float("nan"), 0.2))
    assert np.isnan(K.worst.value)
    assert not K.worst.ok


def test_parts_are_merged_into_a_page_with_their_own_commits(tmp_path: Path) -> None:
    for part in _parts(0.1, 0.3):
        folder = tmp_path / str(part.draw)
        folder.mkdir()
        part.write(folder)
        assert read_part(folder) == part
    (tmp_path / "lg55-reduced-2").mkdir()  # begun, and not finished
    assert len(finished(tmp_path)) == 2
    page = tmp_path / "page.md"
    page.write_text("<!-- accuracy -->\n<!-- /accuracy -->\n<!-- scenes -->\n<!-- /scenes -->\n")
    write_tables(tmp_path, page)
    assert "| lg55-reduced: K | 0.2 | 0.3 | 1 | % | 2 | ok |" in page.read_text()
    assert page.read_text().count("Measured at commit c0, c1.") == 2


def test_a_damaged_part_and_an_empty_folder_are_refused(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("<!-- accuracy -->\n<!-- /accuracy -->\n")
    with pytest.raises(ValueError, match="commit"):
        write_tables(tmp_path, page)
    folder = tmp_path / "mk31-imx1600-0"
    folder.mkdir()
    (folder / "part.json").write_text('{"draw": "mk31-imx1600-0"}')
    with pytest.raises(ValueError, match="Delete its folder"):
        finished(tmp_path)
