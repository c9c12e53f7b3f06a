"""The likelihood of stamps, and the prior of a psf field.

The model's own light gives the weights of samples (shot noise is that of the expectation, not of the sample). Clipped
samples have the likelihood of a clipped normal.

The prior expects that a kernel has its own size, is smooth, and changes little over the field. Images of the same
degree have one Gaussian prior with the precision E^-1 (a + b D^2) E^-1, where E is the kernel's size nearby and D the
Laplacian on the nodes. Maps and lateral colour have one precision per degree. The precisions maximise the evidence
(empirical Bayes), by the updates of Fellner and Schall (Wood and Fasiolo, "A generalized Fellner-Schall method for
smoothing parameter optimization", Biometrics 73, 2017).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import scipy.ndimage
import scipy.sparse
from jaxtyping import Bool, Float, Int
from scipy.sparse.linalg import LaplacianNd
from scipy.special import log_ndtr

from udccal.fitting.psf_stamps.data import Stamps, StampsRules
from udccal.fitting.psf_stamps.field import Changes, PsfField, Seen, degree_of, degrees, see
from udccal.models.fields import polynomial_terms


def envelope(nodes: Float[np.ndarray, "*k rows columns"], spacing_px: float) -> Float[np.ndarray, "*k rows columns"]:
    """Return the kernel's size E on the nodes of images of degree 0: their root mean square nearby."""
    width = [0.0] * (nodes.ndim - 2) + [1.5 / spacing_px] * 2
    peak = np.abs(nodes).max(axis=(-2, -1), keepdims=True)
    return np.sqrt(scipy.ndimage.gaussian_filter(nodes**2, width, mode="nearest") + (2e-5 * peak) ** 2)


def grid_size(shape: tuple[int, ...], spacing_px: float, reach: float) -> tuple[int, int]:
    """Return numbers of nodes that cover stamps ``reach`` times, in steps of 3: small changes of a map keep them."""
    rows, columns = (3 * math.ceil(((size + 1) * reach / spacing_px + 3) / 3) for size in shape)
    return rows, columns


@lru_cache(maxsize=4)
def laplacian(rows: int, columns: int) -> tuple[scipy.sparse.csr_array, Float[np.ndarray, " nodes"]]:
    """Return the Laplacian of a grid, and the eigenvalues of its square."""
    grid = LaplacianNd((rows, columns), dtype=np.float64)
    return scipy.sparse.csr_array(grid.tosparse()), grid.eigenvalues() ** 2


@dataclass(frozen=True)
class State:
    """The current state of a fit.

    Attributes:
        centre_px: of the stars, from their middle samples.
        precisions: of the priors: (a, b) of images by colour and degree, from 0; of maps by colour and degree, from 1;
            of lateral colour likewise, of all colours but the reference.
        size: E of the priors, see ``envelope``.
        keep: True for samples that are not outliers.
        model_error: relative error of a model that is still coarse, which adds to the noise.
    """

    field: PsfField
    centre_px: Float[np.ndarray, "stars 2"]
    light_e: Float[np.ndarray, "stars planes"]
    precisions: Float[np.ndarray, " groups"]
    size: Float[np.ndarray, "planes grid_rows grid_columns"]
    keep: Bool[np.ndarray, "stars samples"]
    model_error: float = 0.0

    @property
    def maps_from(self) -> int:
        """Index in the dense block of the first number of a map, after places and light of the stars."""
        return self.centre_px.size + self.light_e.size

    @property
    def of_images(self) -> Float[np.ndarray, "planes image_degrees 2"]:
        """Precisions of the images."""
        planes, count = len(self.size), self.field.degrees[1] + 1
        return self.precisions[: 2 * planes * count].reshape(planes, count, 2)

    @property
    def map_groups(self) -> Int[np.ndarray, " numbers"]:
        """Index of the precision of every number of maps and lateral colour."""
        parts = (self.field.warp, 4), (self.field.lateral, 2)
        sizes = [np.tile(k * np.arange(2, degree_of(1 + part.shape[1]) + 2), len(part)) for part, k in parts]
        every = np.concatenate(sizes).astype(int)
        return np.repeat(self.of_images.size + np.arange(len(every)), every)

    @property
    def maps(self) -> Float[np.ndarray, " numbers"]:
        """Numbers of the maps, then of lateral colour."""
        return np.concatenate([np.ravel(self.field.warp), np.ravel(self.field.lateral)])

    def shifted(self, vector: Float[np.ndarray, " unknowns"]) -> State:
        """Return the state with changes added, in the order of ``Changes``."""
        changes = Changes.of(self.field, len(self.light_e), vector[:, None])
        centre, light = np.split(changes.stars[..., 0], [2], axis=1)
        field, light = self.field.moved(changes), self.light_e * np.exp(light)
        return replace(self, field=field, centre_px=self.centre_px + centre, light_e=light)

    def with_degrees(self, warp: int, image: int, rules: StampsRules) -> State:
        """Return the state with other degrees: new numbers start at zero, and dropped ones are lost."""
        (old_warp, old_image), planes = self.field.degrees, len(self.size)
        nodes = _resized(self.field.nodes, polynomial_terms(image))
        field = replace(self.field, nodes=nodes, warp=_resized(self.field.warp, polynomial_terms(warp) - 1))
        _, warps, lateral = np.split(self.precisions, np.cumsum([self.of_images.size, planes * old_warp]))
        images = _resized(self.of_images, image + 1)
        for degree in range(old_image + 1, image + 1):
            least = rules.new_image * images[:, degree - 1] if degree > 1 else 0.0
            images[:, degree] = np.maximum(rules.first_image[1], least)
        new = np.tile([rules.first_map] * 2 + [rules.new_map] * warp, (planes, 1))
        warps = np.concatenate([warps.reshape(planes, old_warp), new[:, old_warp:]], axis=1)[:, :warp]
        return replace(self, field=field, precisions=np.concatenate([images.ravel(), warps.ravel(), lateral]))

    def with_spacing(self, stamps: Stamps, spacing_px: float) -> State:
        """Return the state on other nodes, which give the same images and cover the reach of the maps."""
        reach = np.abs(np.linalg.inv(self.field.maps(stamps.unit))).sum(axis=3).max()
        ratio = spacing_px / self.field.spacing_px
        grid = grid_size(stamps.values_e.shape[1:], spacing_px, float(np.clip(reach, 1.0, 1.7)))
        nodes = np.array([[_resampled(image, ratio, grid) for image in own] for own in self.field.nodes])
        # A squared Laplacian is a difference of fourth order; more nodes have the same roughness.
        precisions = self.precisions.copy()
        precisions[: self.of_images.size] *= np.tile([ratio**2, ratio**-2], self.of_images.size // 2)
        field = replace(self.field, nodes=nodes, spacing_px=spacing_px)
        return replace(self, field=field, precisions=precisions, size=envelope(nodes[:, 0], spacing_px))

    def squares(self, vectors: Float[np.ndarray, "unknowns k"] | None = None) -> Float[np.ndarray, " groups"]:
        """Return each precision's factor in minus twice the log prior: of the field, or a mean over changes."""
        nodes, maps = self.field.nodes[..., None], self.maps[:, None]
        if vectors is not None:
            _, maps, nodes = Changes.of(self.field, len(self.light_e), vectors)
        planes, terms, rows, columns, k = nodes.shape
        z = np.moveaxis(nodes / self.size[:, None, :, :, None], (2, 3), (0, 1)).reshape(rows * columns, -1)
        both = np.stack([(z**2).sum(axis=0), ((laplacian(rows, columns)[0] @ z) ** 2).sum(axis=0)])
        each = both.reshape(2, planes, terms, k).mean(axis=3)
        first = np.flatnonzero(np.diff(degrees(self.field.degrees[1]), prepend=-1))
        image = np.moveaxis(np.add.reduceat(each, first, axis=2), 0, 2).ravel()
        return np.concatenate([image, np.bincount(self.map_groups, (maps**2).mean(axis=1))[image.size :]])

    def volume(self) -> tuple[float, Float[np.ndarray, " groups"]]:
        """Return the log determinant of the priors' precision, and its derivatives: the squares that priors expect."""
        images, count = self.of_images.size, 1.0 + np.arange(self.of_images.shape[1])
        maps, own = np.bincount(self.map_groups)[images:], self.precisions[images:]
        a, b = np.moveaxis(self.of_images, 2, 0)[..., None]
        eigenvalues = laplacian(*self.size.shape[1:])[1]
        prior = a + b * eigenvalues
        log_det = (
            maps @ np.log(own) + (np.log(prior).sum(axis=2) @ count).sum() - 2 * count.sum() * np.log(self.size).sum()
        )
        squares = np.stack([(1 / prior).sum(axis=2), (eigenvalues / prior).sum(axis=2)], axis=2) * count[:, None]
        return float(log_det), np.concatenate([squares.ravel(), maps / own])


def _resized(values: Float[np.ndarray, "planes n *rest"], count: int) -> Float[np.ndarray, "planes count *rest"]:
    """Return the first ``count`` of each colour, with zeros where there were fewer."""
    kept = values[:, :count]
    return np.concatenate([kept, np.zeros((len(kept), count - kept.shape[1], *kept.shape[2:]))], axis=1)


def _resampled(
    image: Float[np.ndarray, "m n"], ratio: float, grid: tuple[int, int]
) -> Float[np.ndarray, "rows columns"]:
    """Resample to nodes at ``ratio`` of the spacing: coefficients to values there, and these to coefficients."""
    grids = [(np.arange(n) - (n - 1) / 2) * ratio + (size - 1) / 2 for n, size in zip(grid, image.shape, strict=True)]
    places = np.stack(np.meshgrid(*grids, indexing="ij"))
    values = scipy.ndimage.map_coordinates(image, places, order=3, mode="constant", prefilter=False)
    return np.asarray(scipy.ndimage.spline_filter(values, order=3, mode="mirror"))


@dataclass(frozen=True)
class Weighted:
    """Samples under the model; ``seen`` has stars' light in ``down`` and ``jacobian``; unused ones have weight 0."""

    seen: Seen
    residual: Float[np.ndarray, "stars samples"]
    weight: Float[np.ndarray, "stars samples"]
    log_likelihood: float


def expectation(stamps: Stamps, state: State) -> Weighted:
    """Return the expectation of samples under the model, with residuals and weights."""
    # Shot noise and read noise r together are those of y + r^2 ~ Poisson(m + r^2) (Snyder et al., J. Opt. Soc. Am. A
    # 10, 1993), whose score (y - m) / (m + r^2) needs only the variance.
    seen = see(state.field, stamps.unit, state.centre_px, stamps.offset_px, stamps.plane)
    light = np.take_along_axis(state.light_e, stamps.plane, axis=1)
    mean, read = light * seen.value, stamps.read_e**2
    # Expected light below zero has no shot noise.
    variance = np.maximum(mean, 0.0) + read + (state.model_error * mean) ** 2
    residual, weight = stamps.value_e - mean, 1.0 / variance
    if state.model_error:
        likelihood = -0.5 * (residual**2 * weight + np.log(variance / read))
    else:
        below = np.where(mean < 0, mean * stamps.value_e - 0.5 * mean**2, 0.0) / read
        likelihood = (stamps.value_e + read) * np.log(variance / read) - np.maximum(mean, 0.0) + below
    cut = stamps.clipped
    sigma = np.sqrt(variance[cut])
    z = (stamps.clip_e - mean[cut]) / sigma
    # Score and information of a unit normal's mean for a sample known only to lie above z.
    score = np.exp(-0.5 * z**2 - 0.5 * np.log(2 * np.pi) - log_ndtr(-z))
    information = np.maximum(score * (score - z), 1e-12)
    residual[cut], weight[cut], likelihood[cut] = sigma * score / information, information / variance[cut], log_ndtr(-z)
    used = stamps.known & state.keep & seen.inside
    residual, weight = np.where(used, residual, 0.0), np.where(used, weight, 0.0)
    seen = seen._replace(down=light[..., None] * seen.down, jacobian=light[..., None] * seen.jacobian)
    return Weighted(seen, residual, weight, float(likelihood[used].sum()))
