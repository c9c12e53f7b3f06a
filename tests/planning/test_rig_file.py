from __future__ import annotations

from pathlib import Path

import pytest

from tests.toy_rigs import RIGS, write_toy_rig
from udccal.errors import RigError, UdccalError
from udccal.planning.rig_file import write_planned_rig
from udccal.rig import Captures, load_rig

CAPTURES = Captures(flats=77, psf_shifts=3, psf_led_mm=2.5)


def test_only_the_captures_change(tmp_path: Path) -> None:
    toy = write_toy_rig(tmp_path)
    write_planned_rig(toy, CAPTURES, tmp_path / "new" / "rig.toml")
    before, after = load_rig(toy), load_rig(tmp_path / "new")
    assert after == before.model_copy(update={"captures": CAPTURES})
    # Comments elsewhere stay.
    assert (tmp_path / "new" / "rig.toml").read_text().startswith("# The same mirror")


@pytest.mark.parametrize("rig", ["lg55-aca2040", "mk31-imx1600"])
def test_every_shipped_rig_can_be_taken_over(rig: str, tmp_path: Path) -> None:
    write_planned_rig(RIGS / rig, CAPTURES, tmp_path / "rig.toml")
    assert load_rig(tmp_path).captures == CAPTURES


def test_a_description_without_captures_gets_them(tmp_path: Path) -> None:
    toy = write_toy_rig(tmp_path)
    head, rest = (toy / "rig.toml").read_text().split("[captures]\n")
    (toy / "rig.toml").write_text(head + rest[rest.index("[view]") :])
    write_planned_rig(toy, CAPTURES, tmp_path / "new" / "rig.toml")
    assert load_rig(tmp_path / "new").captures == CAPTURES


def test_comments_after_the_captures_stay(tmp_path: Path) -> None:
    toy = write_toy_rig(tmp_path)
    text = (toy / "rig.toml").read_text()
    (toy / "rig.toml").write_text(text.replace("\n[view]", "\n# Where a person looks from.\n[view]"))
    write_planned_rig(toy, CAPTURES, tmp_path / "new" / "rig.toml")
    assert "\n\n# Where a person looks from.\n[view]" in (tmp_path / "new" / "rig.toml").read_text()


@pytest.mark.parametrize("there", ["file", "folder", "broken link"])
def test_nothing_is_overwritten(there: str, tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    if there == "file":
        path.write_text("precious")
    elif there == "folder":
        path.mkdir()
    else:
        path.symlink_to(tmp_path / "nowhere")
    with pytest.raises(RigError, match="Expected nothing at"):
        write_planned_rig("lg55-reduced", CAPTURES, path)
    assert there != "file" or path.read_text() == "precious"


def test_captures_written_otherwise_are_refused_and_nothing_is_left(tmp_path: Path) -> None:
    toy = write_toy_rig(tmp_path)
    text = (toy / "rig.toml").read_text()
    head, rest = text.split("[captures]\n")
    numbers, tail = rest.split("\n\n[view]")
    inline = f"captures = {{ {', '.join(numbers.splitlines())} }}\n"
    (toy / "rig.toml").write_text(inline + head + "\n[view]" + tail)
    load_rig(toy)
    with pytest.raises(RigError, match=r"\[captures\] section"):
        write_planned_rig(toy, CAPTURES, tmp_path / "new" / "rig.toml")
    assert not (tmp_path / "new").exists()


def test_a_place_that_cannot_be_written_is_a_sentence(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(UdccalError, match="Expected to write the results"):
        write_planned_rig("lg55-reduced", CAPTURES, tmp_path / "file" / "rig.toml")
