from __future__ import annotations

import numpy as np
import pytest

from udccal.displays.checked import check_picture
from udccal.displays.protocol import PanelSize
from udccal.errors import DisplayError

SIZE = PanelSize(6, 4)


def test_a_picture_of_the_panels_size_passes() -> None:
    check_picture(np.zeros((4, 6, 3), np.uint8), SIZE)


@pytest.mark.parametrize(
    ("picture", "said"),
    [
        (np.zeros((4, 6, 3), np.float32), "found float32"),
        (np.zeros((4, 6, 3), np.uint16), "found uint16"),
        (np.zeros((4, 6), np.uint8), r"shape \(4, 6\)"),
        (np.zeros((4, 6, 4), np.uint8), r"shape \(4, 6, 4\)"),
        (np.zeros((6, 4, 3), np.uint8), "6 x 4 pixels, found 4 x 6"),
        (np.zeros((0, 0, 3), np.uint8), "6 x 4 pixels, found 0 x 0"),
    ],
    ids=["float", "16 bit", "grey", "alpha", "turned", "empty"],
)
def test_anything_else_is_refused(picture: np.ndarray, said: str) -> None:
    with pytest.raises(DisplayError, match=said):
        check_picture(picture, SIZE)
