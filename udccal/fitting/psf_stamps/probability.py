"""The likelihood of stamps, and the prior of a psf field.

The model's own light gives the weights of samples (shot noise is that of the expectation, not of the sample). Clipped
samples have the likelihood of a clipped normal.

The prior expects that a kernel has its own size, is smooth, and changes little over the field. Each image has a
Gaussian prior with the precision E^-1 (a + b D^2) E^-1, where E is the kernel's size nearby and D the Laplacian on the
nodes. Maps and lateral colour have one precision per degree, and so have the backgrounds' mean and scatter. The
precisions maximise the evidence (empirical Bayes), by the updates of Fellner and Schall (Wood and Fasiolo, "A
generalized Fellner-Schall method for smoothing parameter optimization", Biometrics 73, 2017).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
import scipy.ndimage
import scipy.sparse
from jaxtyping import Bool, Float, Int
from scipy.sparse.linalg import LaplacianNd
from scipy.special import log_ndtr

from udccal.fitting.psf_stamps.data import Stamps, StampsRules
from udccal.fitting.psf_stamps.field import BACKGROUND, Changes, PsfField, Seen, degree_of, see

LEAST = 2e-5  # size of the faintest light that the prior expects, relative to the peak
ABSENT = 1e8  # precision of a term that is not there, relative to the kernel
HELD, FAR = [-4, -2], -3  # precisions of the means of pedestals and backgrounds, and of pedestals' change


def envelope(
    nodes: Float[np.ndarray, "*k rows columns"], spacing_px: float, noise: Float[np.ndarray, "*k"] | float = 0.0
) -> Float[np.ndarray, "*k rows columns"]:
    """Return the kernel's size E on the nodes of the first images: their root mean square nearby.

    It is not below ``noise``, that of a sample in all stars together (relative to their light): a prior that is tighter
    than the data takes faint rings for nothing, and then knows that there are none.
    """
    width = [0.0] * (nodes.ndim - 2) + [1.5 / spacing_px] * 2
    peak = np.abs(nodes).max(axis=(-2, -1), keepdims=True)
    least = (LEAST * peak) ** 2 + np.square(noise)[..., None, None]
    return np.sqrt(scipy.ndimage.gaussian_filter(nodes**2, width, mode="nearest") + least)


def faintest(
    stamps: Stamps, light_e: Float[np.ndarray, "stars planes"], background_e: Float[np.ndarray, "stars planes"]
) -> Float[np.ndarray, " planes"]:
    """Return the noise of a sample without a star's light in all stars together, relative to their light."""
    return 1.0 / np.linalg.norm(light_e / np.sqrt(stamps.read_e**2 + np.maximum(background_e, 0.0)), axis=0)


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
        background_e: light per sample that is not the stars'.
        precisions: of the priors: (a, b) of images by colour and image; of maps by colour and degree, from 1; of
            lateral colour likewise, of all colours but the reference; of pedestals' mean and change over the field; of
            backgrounds' mean and scatter.
        size: E of the priors, see ``envelope``.
        keep: True for samples that are not outliers.
        model_error: what the model does not describe, in light per pixel at the nodes.
        error_e: the same in samples, which adds to their noise. It stays while places move: what is likely would jump
            otherwise whenever a sample has another node next to it.
        margin: of the nodes' grid, where images other than the first are zero.
        left_out_off: least relative error of stars that were left out of the fit.
        strength_precision: of the prior of what is free of images' strengths.
    """

    field: PsfField
    centre_px: Float[np.ndarray, "stars 2"]
    light_e: Float[np.ndarray, "stars planes"]
    background_e: Float[np.ndarray, "stars planes"]
    precisions: Float[np.ndarray, " groups"]
    size: Float[np.ndarray, "planes grid_rows grid_columns"]
    keep: Bool[np.ndarray, "stars samples"]
    model_error: Float[np.ndarray, "planes grid_rows grid_columns"]
    error_e: Float[np.ndarray, "stars samples"]
    margin: int = 0
    left_out_off: float = 0.0
    strength_precision: float = 0.0

    @property
    def name(self) -> str:
        """Name in the table of candidates."""
        field, count = self.field, self.field.nodes.shape[1]
        images = "1 image" if count == 1 else f"{count} images"
        return f"map degree {field.map_degree}, {images}, nodes every {field.spacing_px:g} px"

    @property
    def maps_from(self) -> int:
        """Index in the dense block of the first number of a map, after the stars' own unknowns."""
        return self.centre_px.size + self.light_e.size + self.background_e.size

    @property
    def lit(self) -> bool:
        """Whether there is a background that matters, of an electron in a sample."""
        return bool((self.background_e**2).mean() > 1.0)

    @property
    def misfit(self) -> float:
        """Model error relative to the kernel, root mean square."""
        return float(np.linalg.norm(self.model_error) / np.linalg.norm(self.size))

    @property
    def width_px(self) -> float:
        """Standard deviation of a Gaussian as wide as the kernel in the middle, by its noise-equivalent area."""
        nodes = self.field.nodes[self.field.reference, 0] * self.field.spacing_px
        return float(nodes.sum() * self.field.spacing_px / np.sqrt(4 * np.pi * (nodes**2).sum()))

    @property
    def inner(self) -> tuple[slice, slice]:
        """Rows and columns of the nodes of images other than the first."""
        rows, columns = self.size.shape[1:]
        return slice(self.margin, rows - self.margin), slice(self.margin, columns - self.margin)

    @property
    def kept(self) -> Bool[np.ndarray, "grid_rows grid_columns images"]:
        """True for nodes that images have."""
        out = np.zeros((*self.size.shape[1:], self.field.nodes.shape[1]), dtype=bool)
        out[..., 0] = out[self.inner] = True
        return out

    @property
    def of_images(self) -> Float[np.ndarray, "planes images 2"]:
        """Precisions of the images."""
        planes, count = self.field.nodes.shape[:2]
        return self.precisions[: 2 * planes * count].reshape(planes, count, 2)

    @property
    def maps(self) -> int:
        """How many numbers maps, lateral colour and pedestals have."""
        return sum(part.size for part in self.field.dense)

    @cached_property
    def vector(self) -> Float[np.ndarray, " unknowns"]:
        """Values of the unknowns, in the order of ``Changes``; 0 for places and light, of which no prior knows."""
        stars = np.concatenate([np.zeros((len(self.light_e), 2 + self.light_e.shape[1])), self.background_e], axis=1)
        parts = stars, *self.field.dense, np.moveaxis(self.field.nodes, 1, 3)
        return np.concatenate([np.ravel(part) for part in parts])

    @cached_property
    def roots(self) -> tuple[scipy.sparse.csr_array, Int[np.ndarray, " groups"]]:
        """Matrix whose product with the unknowns gives the squares of each precision, and how many each has."""
        (stars, planes), field, every = self.light_e.shape, self.field, scipy.sparse.eye_array(self.vector.size).tocsr()
        numbers, parts = Changes.of(field, stars, np.arange(self.vector.size)[:, None]), []
        for plane, image in np.ndindex(*field.nodes.shape[:2]):
            inside = self.inner if image else np.s_[:, :]
            index, size = (part[inside].ravel() for part in (numbers.nodes[plane, image, ..., 0], self.size[plane]))
            parts.append(scipy.sparse.diags_array(1.0 / size) @ every[index])
            parts.append(laplacian(*self.size[plane][inside].shape)[0] @ parts[-1])
        *maps, pedestal = field.split(numbers.maps)
        for own, like in zip(maps, (field.warp, field.lateral), strict=True):
            ends = np.cumsum(np.arange(2, degree_of(1 + like.shape[1]) + 1))
            parts += [every[one.ravel()] for of in own.reshape(like.shape) for one in np.split(of, ends) if one.size]
        parts += [every[one.ravel()] for one in np.split(pedestal.reshape(field.pedestal.shape), [1], axis=1)]
        level, mean = every[numbers.stars[:, -planes:, 0].T.ravel()], np.full((1, stars), 1 / np.sqrt(stars))
        means = scipy.sparse.kron(np.eye(planes), mean)
        parts += [means @ level, level - means.T @ means @ level]
        return scipy.sparse.csr_array(scipy.sparse.vstack(parts)), np.array([part.shape[0] for part in parts])

    @cached_property
    def prior(self) -> scipy.sparse.csr_array:
        """Precision of all unknowns before the data."""
        root, counts = self.roots
        return scipy.sparse.csr_array(root.T @ scipy.sparse.diags_array(np.repeat(self.precisions, counts)) @ root)

    def shifted(self, vector: Float[np.ndarray, " unknowns"]) -> State:
        """Return the state with changes added, in the order of ``Changes``."""
        changes = Changes.of(self.field, len(self.light_e), vector[:, None])
        centre, light, background = np.split(changes.stars[..., 0], [2, 2 + self.light_e.shape[1]], axis=1)
        return replace(
            self,
            field=self.field.moved(changes),
            centre_px=self.centre_px + centre,
            light_e=self.light_e * np.exp(light),
            background_e=self.background_e + background,
        )

    def with_images(self, mix: Float[np.ndarray, "images terms"], rules: StampsRules) -> State:
        """Return the state with more images, of strengths ``mix``: they start at zero."""
        old, more = self.of_images, len(mix) - self.field.nodes.shape[1]
        images = np.concatenate([old, np.tile(rules.first_image[1], (len(old), more, 1))], axis=1)
        nodes = np.pad(self.field.nodes, [(0, 0), (0, more), (0, 0), (0, 0)])
        precisions = np.concatenate([images.ravel(), self.precisions[old.size :]])
        return replace(self, field=replace(self.field, nodes=nodes, mix=mix), precisions=precisions)._confined(rules)

    def with_spacing(self, stamps: Stamps, spacing_px: float, rules: StampsRules) -> State:
        """Return the state on other nodes, which give the same images and cover the reach of the maps."""
        reach = np.abs(np.linalg.inv(self.field.maps(stamps.unit))).sum(axis=3).max()
        ratio = spacing_px / self.field.spacing_px
        grid = grid_size(stamps.values_e.shape[1:], spacing_px, float(np.clip(reach, 1.0, 1.7)))
        nodes = np.array([[_resampled(image, ratio, grid) for image in own] for own in self.field.nodes])
        # A squared Laplacian is a difference of fourth order; more nodes have the same roughness.
        precisions = self.precisions.copy()
        precisions[: self.of_images.size] *= np.tile([ratio**2, ratio**-2], self.of_images.size // 2)
        field = replace(self.field, nodes=nodes, spacing_px=spacing_px)
        size = envelope(nodes[:, 0], spacing_px, faintest(stamps, self.light_e, self.background_e))
        plain = self.without_error()
        state = replace(plain, field=field, precisions=precisions, size=size, model_error=np.zeros_like(size))
        return state._confined(rules)

    def without_error(self) -> State:
        """Return the state with noise alone."""
        return replace(self, model_error=np.zeros_like(self.size), error_e=np.zeros_like(self.error_e))

    def _confined(self, rules: StampsRules) -> State:
        """Return the state with further images in the middle of the grid, as far as the work requires."""
        (rows, columns), more = self.size.shape[1:], self.field.nodes.shape[1] - 1
        for margin in range(max(min(rows, columns) // 2 - 3, 1) if more else 1):
            inner = rows - 2 * margin, columns - 2 * margin
            if inner[0] * (columns + more * inner[1]) ** 3 <= rules.most_work:
                break
        state = replace(self, margin=margin)
        return replace(state, field=replace(self.field, nodes=self.field.nodes * np.moveaxis(state.kept, 2, 0)))

    def squares(self, vectors: Float[np.ndarray, "unknowns k"] | None = None) -> Float[np.ndarray, " groups"]:
        """Return each precision's factor in minus twice the log prior: of the field, or a mean over changes."""
        root, counts = self.roots
        each = ((root @ (self.vector[:, None] if vectors is None else vectors)) ** 2).mean(axis=1)
        ends = np.concatenate([[0.0], np.cumsum(each)])[np.concatenate([[0], np.cumsum(counts)])]
        return np.diff(ends)

    def volume(self) -> tuple[float, Float[np.ndarray, " groups"]]:
        """Return the log determinant of the priors' precision, and its derivatives: the squares that priors expect."""
        count, (stars, planes) = self.of_images.size, self.light_e.shape
        numbers, own = self.roots[1][count:].copy(), self.precisions[count:]
        numbers[-1] = planes * (stars - 1)
        log_det, squares = numbers @ np.log(own), np.empty_like(self.of_images)
        for image, (a, b) in enumerate(np.moveaxis(self.of_images, 0, 2)[..., None]):
            size = self.size[:, *self.inner] if image else self.size
            eigenvalues = laplacian(*size.shape[1:])[1]
            prior = a + b * eigenvalues
            log_det += np.log(prior).sum() - 2 * np.log(size).sum()
            squares[:, image] = np.stack([(1 / prior).sum(axis=1), (eigenvalues / prior).sum(axis=1)], axis=1)
        return float(log_det), np.concatenate([squares.ravel(), numbers / own])


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
    """Samples under the model; ``seen`` has stars' light in ``down`` and ``jacobian``; unused ones have weight 0.

    ``node`` is the flat index of a node next to each sample, over all colours.
    """

    seen: Seen
    residual: Float[np.ndarray, "stars samples"]
    weight: Float[np.ndarray, "stars samples"]
    mean_e: Float[np.ndarray, "stars samples"]
    node: Int[np.ndarray, "stars samples"]
    log_likelihood: float


def expectation(stamps: Stamps, state: State) -> Weighted:
    """Return the expectation of samples under the model, with residuals and weights."""
    # Shot noise, and read noise r with the model's error, together are those of y + r^2 ~ Poisson(m + r^2) (Snyder et
    # al., J. Opt. Soc. Am. A 10, 1993), whose score (y - m) / (m + r^2) needs only the variance.
    seen = see(state.field, stamps.unit, state.centre_px, stamps.offset_px, stamps.plane)
    _, rows, columns = state.size.shape
    node = seen.first + columns + 1 + rows * columns * stamps.plane
    light, background = (np.take_along_axis(own, stamps.plane, axis=1) for own in (state.light_e, state.background_e))
    mean, read = light * seen.value + background, stamps.read_e**2 + state.error_e**2
    # Expected light below zero has no shot noise.
    variance = np.maximum(mean, 0.0) + read
    residual, weight = stamps.value_e - mean, 1.0 / variance
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
    jacobian = light[..., None] * seen.jacobian
    jacobian[..., BACKGROUND] = 1.0
    seen = seen._replace(down=light[..., None] * seen.down, jacobian=jacobian)
    return Weighted(seen, residual, weight, mean, node, float(likelihood[used].sum()))


def with_error(stamps: Stamps, state: State, model_error: Float[np.ndarray, "planes rows columns"]) -> State:
    """Return the state with a model error, in light per pixel at the nodes."""
    light = np.take_along_axis(state.light_e, stamps.plane, axis=1)
    error_e = light * model_error.ravel()[expectation(stamps, state).node]
    return replace(state, model_error=model_error, error_e=error_e)


def log_posterior(stamps: Stamps, state: State) -> float:
    """Return the logarithm of likelihood times prior, up to a constant and the precisions' own part."""
    return expectation(stamps, state).log_likelihood - 0.5 * float(state.precisions @ state.squares())
