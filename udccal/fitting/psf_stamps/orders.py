"""Changes of a psf field's orders, which keep what is known: degrees of images and map, spacing of the nodes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.ndimage
from jaxtyping import Float

from udccal.fitting.psf_stamps.field import PlaneField, warps
from udccal.fitting.psf_stamps.prior import Precisions, envelope
from udccal.fitting.psf_stamps.start import IMAGE_HIGHER, MAP, grid_size
from udccal.fitting.psf_stamps.state import State
from udccal.models.fields import polynomial_terms

# A degree that comes new is nearly absent at first: where the data want it, one update makes it appear.
_NEW, _NEW_MAP = 20.0, 3e4
_LEAST_REACH, _MOST_REACH = 1.0, 1.7


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


def with_degrees(state: State, warp: int, image: int) -> State:
    """The state with other degrees: what is new starts at zero, what is dropped is forgotten."""
    fields = tuple(_field(field, warp, image) for field in state.fields)
    precisions = tuple(_precisions(own, warp, image) for own in state.precisions)
    return replace(state, fields=fields, precisions=precisions)


def with_spacing(state: State, spacing_px: float, shape: tuple[int, ...], unit: Float[np.ndarray, "stars 2"]) -> State:
    """The state on other nodes, which give the same images and reach as far as maps look."""
    fields, envelopes, precisions = [], [], []
    size = grid_size(shape, spacing_px, _reach(state, unit))
    for field, own in zip(state.fields, state.precisions, strict=True):
        nodes = np.stack([_resampled(image, field.spacing_px, spacing_px, size) for image in field.nodes])
        fields.append(replace(field, nodes=nodes, spacing_px=spacing_px))
        envelopes.append(envelope(nodes[0], spacing_px))
        # A squared Laplacian is a difference of fourth order; there are more nodes for what is as rough.
        ratio = spacing_px / field.spacing_px
        precisions.append(replace(own, image=own.image * ratio**2 * np.array([1.0, ratio**-4])))
    return replace(state, fields=tuple(fields), envelopes=tuple(envelopes), precisions=tuple(precisions))


def with_envelopes(state: State) -> State:
    """The state with priors that know the kernel's size as it is now."""
    return replace(
        state, envelopes=tuple(envelope(np.asarray(field.nodes[0]), field.spacing_px) for field in state.fields)
    )


def _field(field: PlaneField, warp: int, image: int) -> PlaneField:
    nodes = np.zeros((polynomial_terms(image), *field.nodes.shape[1:]))
    maps = np.zeros((polynomial_terms(warp) - 1, 2, 2))
    images, kept = min(len(nodes), len(field.nodes)), min(len(maps), len(field.warp))
    nodes[:images], maps[:kept] = field.nodes[:images], field.warp[:kept]
    return replace(field, nodes=nodes, warp=maps, image_degree=image, warp_degree=warp)


def _precisions(own: Precisions, warp: int, image: int) -> Precisions:
    images = np.concatenate([own.image, np.tile(IMAGE_HIGHER, (image, 1))])[: image + 1]
    for degree in range(len(own.image), image + 1):
        images[degree] = np.maximum(images[degree], _NEW * images[degree - 1] if degree > 1 else 0.0)
    maps = np.concatenate([own.warp, np.array([MAP, MAP, *[_NEW_MAP] * warp])[len(own.warp) :]])[:warp]
    return replace(own, image=images, warp=maps)


def _reach(state: State, unit: Float[np.ndarray, "stars 2"]) -> float:
    """How far maps look beyond stamps, along either axis."""
    inverse = np.concatenate([np.linalg.inv(np.asarray(warps(field, unit))) for field in state.fields])
    return float(np.clip(np.abs(inverse).sum(axis=2).max(), _LEAST_REACH, _MOST_REACH))


def _resampled(
    image: Float[np.ndarray, "rows columns"], before_px: float, after_px: float, grid: tuple[int, int]
) -> Float[np.ndarray, "grid_rows grid_columns"]:
    grids = [
        (np.arange(n) - (n - 1) / 2) * after_px / before_px + (size - 1) / 2
        for n, size in zip(grid, image.shape, strict=True)
    ]
    # Coefficients to values at the new nodes, and these to coefficients.
    places = np.stack(np.meshgrid(*grids, indexing="ij"))
    values = scipy.ndimage.map_coordinates(image, places, order=3, mode="constant", prefilter=False)
    return np.asarray(scipy.ndimage.spline_filter(values, order=3, mode="mirror"))
