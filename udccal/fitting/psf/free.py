"""Places and light of the LEDs when diffraction explains none of the kernel, and an image carries the whole of it.

A core about as narrow as a pixel is not determined by its values on whole pixels, and undoing the LED's disc makes more
of what is wrong: such an image has two nodes to a pixel. No shot sees all of these, but all shots at their places do
together, and what pixels integrate is smooth over about one.

Where the LEDs are and how bright is estimated along with the image: in every round the model is linear in both, and
each shot's own parameters are eliminated exactly (Golub and Pereyra, "The differentiation of pseudo-inverses and
nonlinear least squares problems whose variables separate", 1973).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
from jaxtyping import Float

from udccal.fitting.psf.data import Shots
from udccal.fitting.psf.image import (
    Moves,
    Sources,
    Windows,
    image_of,
    make_windows,
    predict,
    prior_sigma,
    shifts,
    solve_image,
)

FREE_PER_PX: Final = 2
_ROUNDS: Final = 2
_STEP_PX: Final = 0.05
# Places and light change by less than this (px; relatively).
_FARTHEST: Final = 0.7


def free_sources(
    shots: Shots,
    basis: Float[np.ndarray, "shots terms"],
    terms: int,
    magnitude: Float[np.ndarray, "3 rows columns"],
    model_error: float,
) -> Sources:
    """Places and light when diffraction explains nothing: from the crops themselves, then along with an image.

    The image has the first ``terms`` of the ``basis``; ``magnitude`` is how large the kernel is on average.
    """
    colour = np.eye(3)[shots.channel] * (shots.weight > 0)[..., None]
    light = np.einsum("syx,syxc->sc", shots.rate, colour)
    covered = np.einsum("cyx,syxc->sc", magnitude, colour)
    start = Sources(shots.centre_px, light / np.maximum(covered, 1e-6), np.zeros(shots.count))
    nothing = np.zeros_like(shots.rate)
    room = np.arange(basis.shape[1]) < terms
    sigma = room[:, None, None, None] * prior_sigma(magnitude, 1.0, FREE_PER_PX)
    sources, changed = start, np.zeros((shots.count, 5))
    windows = make_windows(shots, sources, nothing, basis, model_error, FREE_PER_PX)
    scaled, _ = solve_image(windows, sigma, 0.0, np.zeros_like(sigma))
    for _ in range(_ROUNDS):
        moves = _moves(shots, sources, windows, np.asarray(image_of(scaled, sigma, True)), changed)
        scaled, found = solve_image(windows, sigma, 0.0, scaled, moves)
        # What is common to the shots of a position, a change of the image there does as well.
        values, count = np.asarray(found), np.maximum(np.bincount(shots.position), 1)
        mean = np.stack([np.bincount(shots.position, column) for column in values.T], axis=-1) / count[:, None]
        changed = np.clip(values - mean[shots.position], -_FARTHEST, _FARTHEST)
        sources = replace(start, place_px=start.place_px + changed[:, :2], flux=start.flux * (1.0 + changed[:, 2:]))
        windows = make_windows(shots, sources, nothing, basis, model_error, FREE_PER_PX)
    return sources


def _moves(
    shots: Shots,
    sources: Sources,
    windows: Windows,
    image: Float[np.ndarray, "terms 3 node_rows node_columns"],
    changed: Float[np.ndarray, "shots 5"],
) -> Moves:
    """About ``sources``, at which places and light have been ``changed`` by so much."""
    x, y = (sources.place_px - shots.origin_px).T

    def at(right: float, below: float) -> Float[np.ndarray, "shots rows columns"]:
        down = shifts(y + below, shots.disc_px, shots.rate.shape[1], FREE_PER_PX)
        across = shifts(x + right, shots.disc_px, shots.rate.shape[2], FREE_PER_PX)
        return np.asarray(predict(replace(windows, down=down, across=across), image))

    h = _STEP_PX
    by_place = [(at(h, 0.0) - at(-h, 0.0)) / (2 * h), (at(0.0, h) - at(0.0, -h)) / (2 * h)]
    light = np.moveaxis(at(0.0, 0.0)[..., None] * np.asarray(windows.colour), -1, 1)
    return Moves(np.concatenate([np.stack(by_place, 1), light], 1) * np.asarray(windows.flux)[:, None], changed)
