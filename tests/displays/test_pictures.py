from __future__ import annotations

import numpy as np

from udccal.displays.pictures import face_picture


def test_any_small_place_changes_from_picture_to_picture_and_within() -> None:
    light = np.stack([(face_picture(seed, 640, 360) / 255.0) ** 2.2 for seed in range(12)])
    for top, left in ((100, 300), (165, 305), (300, 40)):
        patch = light[:, top : top + 30, left : left + 30]
        brightness = patch.mean(axis=(1, 2))
        assert brightness.std(axis=0).min() > 0.25 * brightness.mean()
        assert np.median(patch.std(axis=(1, 2)) / brightness) > 0.4
        assert brightness.mean() > 0.1


def test_same_seed_same_picture() -> None:
    first, again, other = (face_picture(seed, 320, 180) for seed in (3, 3, 4))
    assert first.shape == (180, 320, 3)
    assert first.dtype == np.uint8
    assert (first == again).all()
    assert (first != other).any()
