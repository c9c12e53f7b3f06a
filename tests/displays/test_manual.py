from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from udccal.displays.manual import ManualDisplay
from udccal.displays.protocol import Display, PanelSize
from udccal.errors import DisplayError
from udccal.io.png import read_rgb8

SIZE = PanelSize(16, 9)
PICTURES = np.random.default_rng(5).integers(0, 256, (2, 9, 16, 3), dtype=np.uint8)


@dataclass
class Person:
    """Answers yes by default."""

    answer: bool = True
    heard: list[str] = field(default_factory=list)
    asked: int = 0

    def tell(self, sentence: str) -> None:
        self.heard.append(sentence)

    def confirm(self, question: str) -> bool:
        self.asked += 1
        return self.answer


def test_the_person_is_told_which_file_and_asked_for_each_change_only(tmp_path: Path) -> None:
    person = Person()
    with ManualDisplay(tmp_path / "panel", SIZE, person.tell, person.confirm) as display:
        assert isinstance(display, Display)
        assert display.size == SIZE
        for picture in PICTURES:
            display.show(picture)
            (file,) = [f for f in (tmp_path / "panel").iterdir() if str(f.resolve()) in person.heard[-1]]
            assert (read_rgb8(file) == picture).all()
        display.show(PICTURES[1].copy())
        assert person.asked == 2
        display.check()
        for _ in range(3):
            display.off()
        assert person.asked == 3
        assert "black" in person.heard[-1]
        display.show(PICTURES[1])
        assert person.asked == 4
    assert len(list((tmp_path / "panel").iterdir())) == 2


def test_no_is_an_error_and_the_question_comes_again(tmp_path: Path) -> None:
    person = Person(answer=False)
    display = ManualDisplay(tmp_path, SIZE, person.tell, person.confirm)
    for _ in range(2):
        with pytest.raises(DisplayError, match="answer yes"):
            display.show(PICTURES[0])
    assert person.asked == 2


def test_ctrl_c_ends_the_wait_and_what_is_shown_is_then_not_known(tmp_path: Path) -> None:
    person = Person()

    def interrupted(question: str) -> bool:
        raise KeyboardInterrupt

    display = ManualDisplay(tmp_path, SIZE, person.tell, person.confirm)
    display.off()
    display._confirm = interrupted
    with pytest.raises(KeyboardInterrupt):
        display.show(PICTURES[0])
    display._confirm = person.confirm
    display.off()
    assert person.asked == 2


def test_refuses_a_picture_of_another_size_before_anything_is_said(tmp_path: Path) -> None:
    person = Person()
    with pytest.raises(DisplayError, match="16 x 9 pixels, found 9 x 16"):
        ManualDisplay(tmp_path, SIZE, person.tell, person.confirm).show(np.zeros((16, 9, 3), np.uint8))
    assert not person.heard
    assert not list(tmp_path.iterdir())
