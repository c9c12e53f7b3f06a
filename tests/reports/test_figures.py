"""Figures: drawn without a display, of the numbers they are given."""

from __future__ import annotations

import base64
import sys

import cv2
import numpy as np
import pytest
from matplotlib.figure import Figure

from udccal.fitting.psf.held_out import KernelError
from udccal.reports import figures
from udccal.reports.board_views import BoardEvidence
from udccal.reports.evidence import PhotonTransfer
from udccal.reports.maps import TermMaps


def maps(seed: int) -> TermMaps:
    rng = np.random.default_rng(seed)
    kernels = rng.random((2, 3, 21, 11)) ** 8
    return TermMaps(
        wire=1 + 0.02 * rng.normal(size=(24, 32)),
        positions_px=np.array([[10.0, 5.0], [20.0, 9.0]]),
        kernels=kernels / kernels.sum(axis=(2, 3), keepdims=True),
        picture=rng.integers(0, 255, (40, 60, 3)).astype(np.uint8),
        seen_px=(10, 5, 30, 25),
        backscatter=rng.random((24, 32)),
    )


DRAWN = {
    "transfer": lambda: figures.photon_transfer_figure(
        PhotonTransfer(np.full((4, 3), 100.0), np.full((4, 3), 35.0), 0.35, 3900.0)
    ),
    "board": lambda: figures.board_figure(BoardEvidence(np.ones((5, 2)), np.zeros((5, 2)), 1), 32, 24),
    "wire": lambda: figures.wire_figure(maps(1), None),
    "wire and truth": lambda: figures.wire_figure(maps(1), maps(2)),
    "psf": lambda: figures.psf_figure(maps(1), None, None),
    "psf and truth": lambda: figures.psf_figure(maps(1), maps(2), KernelError(0.01, 0.3, 0.75)),
    "backscatter": lambda: figures.backscatter_figure(maps(1), None),
    "backscatter and truth": lambda: figures.backscatter_figure(maps(1), maps(2)),
    "difference": lambda: figures.difference_figure(np.zeros((8, 8)), "nothing"),
}


@pytest.mark.parametrize("name", DRAWN)
def test_every_figure_becomes_a_png(name: str) -> None:
    figure = DRAWN[name]()
    assert isinstance(figure, Figure)
    kind, _, data = figures.embedded_png(figure).partition(",")
    assert kind == "data:image/png;base64"
    picture = cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR)
    assert picture.std() > 1.0


def test_pictures_keep_their_colours() -> None:
    picture = np.zeros((4, 4, 3), np.uint8)
    picture[..., 0] = 200
    data = figures.embedded_picture(picture).partition(",")[2]
    decoded = cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR)
    assert decoded[0, 0].tolist() == [0, 0, 200]  # OpenCV's order is blue, green, red


def test_nothing_opens_a_window() -> None:
    assert "matplotlib.pyplot" not in sys.modules
