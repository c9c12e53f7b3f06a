"""Orders of a psf field, changes of them that keep what is known, and the first field, from the stamps themselves."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import final

import numpy as np
import scipy.ndimage
from jaxtyping import Float

from udccal.fitting.psf_stamps.data import Plane
from udccal.fitting.psf_stamps.field import PlaneField, warps
from udccal.fitting.psf_stamps.likelihood import Scene, State
from udccal.fitting.psf_stamps.prior import Precisions, envelope
from udccal.fitting.psf_stamps.rules import StampsRules
from udccal.fitting.psf_stamps.solve import improve, without_outliers
from udccal.models.fields import polynomial_terms

_WINDOW_PX, _ROUNDS = 1.6, 15
# How many nodes there are changes by steps: an image's nodes do not move with every digit of a map.
_STEP = 3
# How far images reach beyond stamps: at the start; and at least and at most, once it is known how far maps look.
_REACH, _LEAST_REACH, _MOST_REACH = 1.1, 1.0, 1.7
_LATERAL_DEGREE = 2


@final
@dataclass(frozen=True)
class Orders:
    """Degrees of the map and of the images over the field, and how many px lie between nodes."""

    warp: int
    image: int
    spacing_px: float

    @property
    def name(self) -> str:
        """For the table of candidates."""
        return f"map degree {self.warp}, image degree {self.image}, nodes every {self.spacing_px:g} px"


def orders_of(state: State) -> Orders:
    """Of a state."""
    field = state.fields[0]
    return Orders(field.warp_degree, field.image_degree, field.spacing_px)


def reference(planes: int) -> int:
    """The plane that places are of: green, where there are three."""
    return 1 if planes == 3 else 0


def coarse(scene: Scene, rules: StampsRules, most: Orders) -> State:
    """Places, light and a first field; what the model cannot follow yet is allowed for as an error of its own."""
    state = start(scene, rules)
    for warp, image, allowed in rules.coarse:
        state = replace(with_degrees(state, min(warp, most.warp), min(image, most.image), rules), model_error=allowed)
        state = without_outliers(scene, state, rules) if warp else state
        state = with_envelopes(improve(scene, state, rules, rules.coarse_steps).place)
    state = with_spacing(scene, state, rules.spacings_px[0])
    return without_outliers(scene, replace(state, model_error=0.0), rules)


def start(scene: Scene, rules: StampsRules) -> State:
    """A state of the lowest orders: a round image of the stamps' size."""
    spacing_px = rules.spacings_px[0]
    y, x = (np.arange(n) - (n - 1) / 2 for n in grid_size(scene.shape, spacing_px))
    image = np.exp(-0.5 * (y[:, None] ** 2 + x**2) * (spacing_px / _WINDOW_PX) ** 2) + 1e-3
    image /= image.sum() * spacing_px**2
    fields, precisions = [], []
    for plane in range(len(scene.planes)):
        lateral = 0 if plane == reference(len(scene.planes)) else _LATERAL_DEGREE
        terms = polynomial_terms(lateral) - 1
        fields.append(PlaneField(image[None], np.zeros((0, 2, 2)), np.zeros((terms, 2)), 0, 0, lateral, spacing_px))
        first = np.array([rules.first_image[0]])
        precisions.append(Precisions(first, np.zeros(0), np.full(lateral, rules.first_lateral)))
    return State(
        fields=tuple(fields),
        centre_px=_centroids(scene.planes, len(scene.unit)),
        flux_e=np.stack([_light(plane, scene.read_e) for plane in scene.planes], axis=1),
        precisions=tuple(precisions),
        envelopes=(envelope(image, spacing_px),) * len(fields),
        keep=tuple(np.ones(plane.usable.shape, dtype=bool) for plane in scene.planes),
    )


def with_degrees(state: State, warp: int, image: int, rules: StampsRules) -> State:
    """The state with other degrees: what is new starts at zero, what is dropped is forgotten."""
    fields, precisions = [], []
    for field, own in zip(state.fields, state.precisions, strict=True):
        nodes = _resized(field.nodes, polynomial_terms(image))
        maps = _resized(field.warp, polynomial_terms(warp) - 1)
        fields.append(replace(field, nodes=nodes, warp=maps, image_degree=image, warp_degree=warp))
        images = _resized(own.image, image + 1)
        for degree in range(len(own.image), image + 1):
            least = rules.new_image * images[degree - 1] if degree > 1 else np.zeros(2)
            images[degree] = np.maximum(rules.first_image[1], least)
        new = np.array([rules.first_map] * 2 + [rules.new_map] * warp)
        precisions.append(replace(own, image=images, warp=np.concatenate([own.warp, new[len(own.warp) :]])[:warp]))
    return replace(state, fields=tuple(fields), precisions=tuple(precisions))


def with_envelopes(state: State) -> State:
    """The state with priors that know the kernel's size as it is now."""
    return replace(state, envelopes=tuple(envelope(np.asarray(f.nodes[0]), f.spacing_px) for f in state.fields))


def with_spacing(scene: Scene, state: State, spacing_px: float) -> State:
    """The state on other nodes, which give the same images and reach as far as maps look."""
    fields, precisions = [], []
    inverse = np.concatenate([np.linalg.inv(np.asarray(warps(field, scene.unit))) for field in state.fields])
    reach = float(np.clip(np.abs(inverse).sum(axis=2).max(), _LEAST_REACH, _MOST_REACH))
    size = grid_size(scene.shape, spacing_px, reach)
    for field, own in zip(state.fields, state.precisions, strict=True):
        nodes = np.stack([_resampled(image, spacing_px / field.spacing_px, size) for image in field.nodes])
        fields.append(replace(field, nodes=nodes, spacing_px=spacing_px))
        # A squared Laplacian is a difference of fourth order; there are more nodes for what is as rough.
        ratio = spacing_px / field.spacing_px
        precisions.append(replace(own, image=own.image * ratio**2 * np.array([1.0, ratio**-4])))
    return with_envelopes(replace(state, fields=tuple(fields), precisions=tuple(precisions)))


def grid_size(shape: tuple[int, ...], spacing_px: float, reach: float = _REACH) -> tuple[int, int]:
    """Nodes that cover stamps, and by ``reach`` more where maps look beyond."""
    rows, columns = (_STEP * math.ceil(((size + 1) * reach / spacing_px + 3) / _STEP) for size in shape)
    return rows, columns


def _resized(values: Float[np.ndarray, "n *rest"], count: int) -> Float[np.ndarray, "count *rest"]:
    """The first ``count``, zeros where there were fewer."""
    out = np.zeros((count, *values.shape[1:]))
    out[: len(values)] = values[:count]
    return out


def _resampled(
    image: Float[np.ndarray, "rows columns"], ratio: float, grid: tuple[int, int]
) -> Float[np.ndarray, "grid_rows grid_columns"]:
    """On nodes ``ratio`` as far from each other."""
    grids = [(np.arange(n) - (n - 1) / 2) * ratio + (size - 1) / 2 for n, size in zip(grid, image.shape, strict=True)]
    # Coefficients to values at the new nodes, and these to coefficients.
    places = np.stack(np.meshgrid(*grids, indexing="ij"))
    values = scipy.ndimage.map_coordinates(image, places, order=3, mode="constant", prefilter=False)
    return np.asarray(scipy.ndimage.spline_filter(values, order=3, mode="mirror"))


def _centroids(planes: tuple[Plane, ...], stars: int) -> Float[np.ndarray, "stars 2"]:
    """Under a Gaussian that follows, all colours alike: of light per sample, each colour by its own number of them."""
    centre = np.zeros((stars, 2))
    for _ in range(_ROUNDS):
        top, bottom = np.zeros((stars, 2)), np.zeros(stars)
        for plane in planes:
            off = plane.offset_px - centre[:, None]
            weight = plane.usable * np.exp(-0.5 * (off**2).sum(axis=2) / _WINDOW_PX**2)
            light = weight * np.maximum(plane.value_e, 0.0)
            # The mean under the weight alone is taken off: samples of a mosaic do not lie evenly about the centre.
            mean = np.einsum("ks,ksi->ki", weight, off) / np.maximum(weight.sum(axis=1), 1e-300)[:, None]
            top += np.einsum("ks,ksi->ki", light, off - mean[:, None])
            bottom += light.sum(axis=1)
        move = 2 * top / np.maximum(bottom, 1e-300)[:, None]
        centre = np.clip(centre + np.clip(move, -1.0, 1.0), -3.0, 3.0)
    return centre


def _light(plane: Plane, read_e: float) -> Float[np.ndarray, " stars"]:
    """Sums, scaled up for samples that are missing; in light per pixel of all colours."""
    known = np.maximum(plane.usable.sum(axis=1), 1)
    total = (plane.value_e * plane.usable).sum(axis=1)
    pixels = int(plane.place.max()) + 1
    return np.maximum(total * pixels / known, 10 * read_e)
