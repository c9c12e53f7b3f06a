"""Where a psf field starts: places and light from the stamps themselves, and a round image of the stamps' size."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float

from udccal.fitting.psf_stamps.data import Plane, Stamps
from udccal.fitting.psf_stamps.field import PlaneField
from udccal.fitting.psf_stamps.prior import Precisions, envelope
from udccal.fitting.psf_stamps.state import Scene, State
from udccal.models.fields import polynomial_terms

_WINDOW_PX, _ROUNDS = 1.6, 15
# How many nodes there are changes by steps: an image's nodes do not move with every digit of a map.
_STEP = 3
_REACH = 1.1  # how far images reach beyond stamps, before it is known how far maps look
# Priors before the data speak: of images (a, b) by degree 0 and higher, of maps and of lateral colour.
IMAGE_FIRST, IMAGE_HIGHER, MAP, LATERAL = (1e-3, 1e-4), (30.0, 30.0), 100.0, 10.0


def start(scene: Scene, stamps: Stamps, spacing_px: float = 1.0) -> State:
    """A state of the lowest orders, with the model's coarseness allowed for."""
    centre = np.stack([_centroid(scene.planes, k) for k in range(len(scene.unit))])
    light = np.stack([_light(plane, scene.read_e) for plane in scene.planes], axis=1)
    image = _round_image(stamps.values_e.shape[1:], spacing_px)
    lateral = 0 if len(scene.planes) == 1 else 2
    fields, precisions = [], []
    for plane in range(len(scene.planes)):
        own = 0 if plane == reference(len(scene.planes)) else lateral
        terms = max(polynomial_terms(own) - 1, 0)
        fields.append(PlaneField(image[None], np.zeros((0, 2, 2)), np.zeros((terms, 2)), 0, 0, own, spacing_px))
        precisions.append(Precisions(np.array([IMAGE_FIRST]), np.zeros(0), np.full(own, LATERAL)))
    return State(
        fields=tuple(fields),
        centre_px=centre,
        flux_e=light,
        precisions=tuple(precisions),
        envelopes=(envelope(image, spacing_px),) * len(fields),
        keep=tuple(np.ones(plane.usable.shape, dtype=bool) for plane in scene.planes),
        model_error=0.3,
    )


def reference(planes: int) -> int:
    """The plane that places are of: green, where there are three."""
    return 1 if planes == 3 else 0


def grid_size(shape: tuple[int, ...], spacing_px: float, reach: float = _REACH) -> tuple[int, int]:
    """Nodes that cover stamps, and by ``reach`` more where maps look beyond."""
    rows, columns = (_STEP * math.ceil(((size + 1) * reach / spacing_px + 3) / _STEP) for size in shape)
    return rows, columns


def _centroid(planes: tuple[Plane, ...], star: int) -> Float[np.ndarray, "2"]:
    """Under a Gaussian that follows, all colours alike: of light per sample, each colour by its own number of them."""
    centre = np.zeros(2)
    for _ in range(_ROUNDS):
        top, bottom = np.zeros(2), 0.0
        for plane in planes:
            known = plane.usable[star]
            off = plane.offset_px[star][known] - centre
            weight = np.exp(-0.5 * (off**2).sum(axis=1) / _WINDOW_PX**2)
            light = np.maximum(plane.value_e[star][known], 0.0)
            # The mean under the weight alone is taken off: samples of a mosaic do not lie evenly about the centre.
            lie = weight @ off / max(weight.sum(), 1e-300)
            top += (weight * light) @ (off - lie)
            bottom += float(weight @ light)
        move = 2 * top / max(bottom, 1e-300)
        centre = np.clip(centre + np.clip(move, -1.0, 1.0), -3.0, 3.0)
    return centre


def _light(plane: Plane, read_e: float) -> Float[np.ndarray, " stars"]:
    """Sums, scaled up for samples that are missing; in light per pixel of all colours."""
    known = np.maximum(plane.usable.sum(axis=1), 1)
    total = (plane.value_e * plane.usable).sum(axis=1)
    pixels = int(plane.place.max()) + 1
    return np.maximum(total * pixels / known, 10 * read_e)


def _round_image(shape: tuple[int, ...], spacing_px: float) -> Float[np.ndarray, "grid_rows grid_columns"]:
    rows, columns = grid_size(shape, spacing_px)
    y, x = ((np.arange(n) - (n - 1) / 2) * spacing_px for n in (rows, columns))
    image = np.exp(-0.5 * (y[:, None] ** 2 + x**2) / _WINDOW_PX**2) + 1e-3
    return image / (image.sum() * spacing_px**2)
