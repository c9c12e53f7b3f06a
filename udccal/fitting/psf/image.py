"""The part of the kernel that diffraction does not explain: an image whose nodes are polynomials of the position.

All shots of all positions are solved together on Bayer sites: ridge regression by conjugate gradients, without forming
the matrix. A shot's expectation is the image at its position, shifted by a fraction of a pixel and smeared by the LED's
disc. Along rows and along columns this is one small matrix each (pixels cannot distinguish a disc of a pixel or two
from the product of its shadows).

One node to a pixel is enough in addition to diffraction. A free image carries the whole kernel. Values on whole pixels
do not determine its core, which is about as narrow as a pixel, and removing the LED's disc amplifies errors. It
therefore has two nodes to a pixel, and is smooth over about one: all shots at their places determine it together. The
LEDs' places and light are estimated with it: in every round the model is linear in both, and each shot's own parameters
are eliminated exactly (Golub and Pereyra, "The differentiation of pseudo-inverses and nonlinear least squares problems
whose variables separate", 1973).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, final

import numpy as np
import scipy.ndimage
import scipy.sparse.linalg
from jaxtyping import Float, Int

from udccal.fitting.psf.data import Crops, PsfRules, Shots, left_out, noise_at

FREE_PER_PX: Final = 2
Image = Float[np.ndarray, "terms 3 node_rows node_columns"]
Basis = Float[np.ndarray, "shots terms"]
Magnitude = Float[np.ndarray, "3 rows columns"]


@final
@dataclass(frozen=True)
class Sources:
    """Place and light of each shot's LED: (x, y) on the sensor in px, e-/s per colour, background in e-/s."""

    place_px: Float[np.ndarray, "shots 2"]
    flux: Float[np.ndarray, "shots 3"]
    background: Float[np.ndarray, " shots"]

    def pick(self, keep: np.ndarray) -> Sources:
        """The shots selected by an index or mask."""
        return Sources(self.place_px[keep], self.flux[keep], self.background[keep])

    def with_light_of_peak(self, shots: Shots, explained: Crops) -> Sources:
        """Return light from unweighted least squares: the peak determines it, not the wings as with weights."""
        colour = shots.colour * (shots.weight > 0)[..., None]
        rate = shots.rate - self.background[:, None, None]
        top, bottom = (np.einsum("syx,syx,syxc->sc", part, explained, colour) for part in (rate, explained))
        return replace(self, flux=np.where(bottom > 0, top / np.where(bottom > 0, bottom, 1.0), self.flux))


@final
@dataclass(frozen=True)
class Windows:
    """All shots about their LED, from which an image is solved in addition to diffraction, or a ``free`` one.

    Attributes:
        basis: polynomials at each shot's position.
        down, across: from nodes to samples, along columns and along rows: shift and disc.
        flux: light of each sample's own colour, 0 where nothing is known.
        channel: each sample's colour: 0, 1, 2 for R, G, B.
        explained: light of each sample by diffraction, per unit of the LED's light; 0 for a free image.
        rate: e-/s without background.
        left_out: standard deviation of the rate that a model error of 1 would add; see ``data.left_out``.
        weight: inverse variance of the rate that solutions use, 0 where nothing is known.
    """

    basis: Float[np.ndarray, "shots terms"]
    down: Float[np.ndarray, "shots rows node_rows"]
    across: Float[np.ndarray, "shots columns node_columns"]
    flux: Float[np.ndarray, "shots rows columns"]
    channel: Int[np.ndarray, "shots rows columns"]
    explained: Float[np.ndarray, "shots rows columns"]
    rate: Float[np.ndarray, "shots rows columns"]
    left_out: Float[np.ndarray, "shots rows columns"]
    weight: Float[np.ndarray, "shots rows columns"]
    free: bool

    def pick(self, keep: np.ndarray) -> Windows:
        """The shots selected by an index or mask."""
        return replace(self, **{name: part[keep] for name, part in vars(self).items() if name != "free"})

    def unit_light(self, image: Image) -> Crops:
        """Return each sample's light by an image, per unit of the LED's light."""
        of_shots = np.tensordot(self.basis[:, : len(image)], image, 1)
        moved = self.down[:, None] @ of_shots @ np.swapaxes(self.across, 1, 2)[:, None]
        return np.take_along_axis(moved, self.channel[:, None], axis=1)[:, 0]

    def by_colour(self, light: Crops) -> Float[np.ndarray, "shots 3 rows columns"]:
        """Return the light on samples of each colour, 0 on the others."""
        return light[:, None] * (self.channel[:, None] == np.arange(3)[:, None, None])

    def gathered(self, light: Crops, terms: int) -> Image:
        """Return the transpose of ``unit_light``."""
        moved = np.swapaxes(self.down, 1, 2)[:, None] @ self.by_colour(light) @ self.across[:, None]
        return np.tensordot(self.basis[:, :terms].T, moved, 1)

    def smoothed(self, image: Image) -> Image:
        """Smooth an image by a Gaussian of one node where it is free; the smoothing is its own transpose."""
        if not self.free:
            return image
        return np.asarray(scipy.ndimage.gaussian_filter(image, 1.0, mode="constant", axes=(-2, -1)))

    def expected(self, image: Image) -> Crops:
        """Return each sample's light in e-/s, by an image and by diffraction."""
        return (self.unit_light(image) + self.explained) * self.flux


def make_windows(
    shots: Shots, sources: Sources, explained: Crops, basis: Basis, model_error: float, free: bool = False
) -> Windows:
    """Return the data from which images are solved; see ``Windows``.

    ``model_error``, relative to the peak, adds to noise. First and last nodes are on the first and last pixels.
    """
    known, rate = shots.weight > 0, shots.rate - sources.background[:, None, None]
    flux = sources.flux[np.arange(shots.count)[:, None, None], shots.channel]
    smooth = np.maximum(scipy.ndimage.uniform_filter(np.abs(rate), (0, 3, 3)), np.abs(flux * explained))
    unexplained = left_out(smooth.reshape(shots.count, -1), 1.0).reshape(smooth.shape)
    measured = 1.0 / np.where(known, shots.weight, 1.0)
    variance = noise_at(smooth, rate, measured, shots.noise_per_rate) + (model_error * unexplained) ** 2
    weight, explained = np.where(known, 1.0 / variance, 0.0), explained * (not free)
    moves = _moves(shots, sources.place_px - shots.origin_px, free)
    return Windows(basis, *moves, flux * known, shots.channel, explained, rate * known, unexplained, weight, free)


def _moves(
    shots: Shots, offset_px: Float[np.ndarray, "shots 2"], free: bool
) -> tuple[Float[np.ndarray, "shots rows node_rows"], Float[np.ndarray, "shots columns node_columns"]]:
    """Return ``Windows.down`` and ``Windows.across`` for LEDs at these offsets from the middle samples."""
    (x, y), (rows, columns), per_px = offset_px.T, shots.rate.shape[1:], FREE_PER_PX if free else 1
    return shifts(y, shots.disc_px, rows, per_px), shifts(x, shots.disc_px, columns, per_px)


def shifts(
    offset_px: Float[np.ndarray, " shots"], disc_px: Float[np.ndarray, " shots"], samples: int, per_px: int = 1
) -> Float[np.ndarray, "shots samples nodes"]:
    """Return matrices along one axis that shift an image by an offset and average it over a disc's shadow.

    Interpolation is Lanczos's over six nodes; Gauss and Chebyshev's rule at eight points sums a disc's shadow.
    """
    angle, reach = np.pi * np.arange(1, 9) / 9, 3
    shots, nodes = len(offset_px), per_px * (samples - 1) + 1
    matrix = np.zeros((shots, samples, nodes + 2 * reach))  # the end cuts off what falls outside the nodes
    index = np.ogrid[:shots, :samples]
    for part, weight in zip(np.cos(angle) / 2, 2 / 9 * np.sin(angle) ** 2, strict=True):
        place = per_px * (np.arange(samples) - (offset_px + part * disc_px)[:, None])
        first = np.floor(place).astype(np.int64) - reach + 1
        away = np.stack([place - first - tap for tap in range(2 * reach)])
        taps = np.where(np.abs(away) < reach, np.sinc(away) * np.sinc(away / reach), 0.0)
        for tap, value in enumerate(weight * taps / taps.sum(axis=0)):
            matrix[(*index, np.clip(first + tap + reach, 0, matrix.shape[2] - 1))] += value
    return matrix[:, :, reach:-reach]


def prior_sigma(
    magnitude: Magnitude, relative: float, per_px: int = 1
) -> Float[np.ndarray, "3 node_rows node_columns"]:
    """Return the prior sigma of every coefficient: a fraction of the kernel's own size near that node."""
    near = scipy.ndimage.maximum_filter(scipy.ndimage.gaussian_filter(np.abs(magnitude), (0, 0.7, 0.7)), (1, 3, 3))
    near = near + 1e-5 * near.max(axis=(1, 2), keepdims=True)
    nodes = [1.0, *((per_px * (size - 1) + 1) / size for size in near.shape[1:])]
    return np.asarray(relative * scipy.ndimage.zoom(near, nodes, order=1))


@final
@dataclass(frozen=True)
class Changes:
    """Changes of each shot along with a free image: place in px (x, y), and relative light (R, G, B); or none.

    ``design`` has the derivatives of samples, in e-/s; ``so_far`` is the sum of the changes so far, and ``sigma`` the
    prior standard deviations of the whole changes.
    """

    design: Float[np.ndarray, "shots own rows columns"]
    so_far: Float[np.ndarray, "shots own"]
    sigma: Float[np.ndarray, " own"]

    @classmethod
    def none(cls, shape: tuple[int, ...]) -> Changes:
        """For shots x rows x columns whose place and light are known."""
        return cls(np.zeros((shape[0], 0, *shape[1:])), np.zeros((shape[0], 0)), np.zeros(0))

    def light(self, own: Float[np.ndarray, "shots own"]) -> Crops:
        """Return the light that changes add, in e-/s."""
        return np.einsum("spyx,sp->syx", self.design, own)

    def fitted(self, light: Crops, weight: Crops) -> Float[np.ndarray, "shots own"]:
        """Return the changes that this light is most likely to come from."""
        weighted = (self.design * weight[:, None]).reshape(*self.design.shape[:2], light[0].size)
        flat = self.design.reshape(weighted.shape)
        normal = weighted @ np.swapaxes(flat, 1, 2) + np.diag(self.sigma**-2.0)
        return np.linalg.solve(normal, weighted @ light.reshape(len(light), -1, 1))[..., 0]


def solve_image(
    windows: Windows, sigma: Image, start: Image, changes: Changes
) -> tuple[Image, Float[np.ndarray, "shots own"]]:
    """Return the ridge estimate of an image, and the changes of shots that are estimated along with it.

    The image, like its ``start``, is in units of ``sigma``, its prior standard deviations, before it is smoothed. The
    prior is about the addition to the start: a prior about the whole would prefer a smaller image and brighter LEDs.
    """
    flux, weight = windows.flux, windows.weight
    # The prior is about the whole change, and the model is linear: the data become those before any change.
    data = windows.rate - flux * windows.explained + changes.light(changes.so_far)

    def forward(scaled: Image) -> Crops:
        return flux * windows.unit_light(windows.smoothed(scaled * sigma))

    def backward(light: Crops) -> Image:
        left = light - changes.light(changes.fitted(light, weight))
        return sigma * windows.smoothed(windows.gathered(flux * weight * left, len(sigma)))

    def normal(flat: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        return flat + backward(forward(flat.reshape(sigma.shape))).ravel()

    iterations, tolerance = (150, 1e-5) if windows.free else (60, 1e-4)
    operator = scipy.sparse.linalg.LinearOperator((sigma.size, sigma.size), matvec=normal, dtype=np.float64)
    # Pixels hardly share a residual's nodes: divided by the diagonal, bright nodes and dark ones converge alike, in few
    # iterations. A free image's are finer, and smoothed: it gains nothing.
    preconditioner = None
    if not windows.free:
        squared = replace(windows, basis=windows.basis**2, down=windows.down**2, across=windows.across**2)
        diagonal = 1.0 + sigma**2 * squared.gathered(flux**2 * weight, len(sigma))
        preconditioner = scipy.sparse.diags_array(1.0 / diagonal.ravel())
    right = backward(data - forward(start)).ravel()
    added, _ = scipy.sparse.linalg.cg(operator, right, rtol=tolerance, maxiter=iterations, M=preconditioner)
    image = start + added.reshape(sigma.shape)
    return image, changes.fitted(data - forward(image), weight)


def free_sources(shots: Shots, basis: Basis, magnitude: Magnitude, rules: PsfRules) -> Sources:
    """Estimate places and light without diffraction: from the crops themselves, then along with a free image.

    The image is mixed by the ``basis``; ``magnitude`` is the kernel's average size.
    """
    colour = shots.colour * (shots.weight > 0)[..., None]
    light, covered = (np.einsum("syx,syxc->sc", shots.rate, colour), np.einsum("cyx,syxc->sc", magnitude, colour))
    sources = start = Sources(shots.centre_px, light / np.maximum(covered, 1e-6), np.zeros(shots.count))
    sigma = np.tile(prior_sigma(magnitude, 1.0, FREE_PER_PX), (basis.shape[1], 1, 1, 1))
    scaled, so_far = np.zeros_like(sigma), np.zeros((shots.count, 5))
    for moving in (False, True, True):
        windows = make_windows(shots, sources, np.zeros_like(shots.rate), basis, rules.free_model_error, True)
        changes = Changes.none(shots.rate.shape)
        if moving:
            design = _slopes(shots, sources, windows, windows.smoothed(scaled * sigma))
            changes = Changes(design, so_far, np.repeat(rules.own_sigma, (2, 3)))
        scaled, found = solve_image(windows, sigma, scaled, changes)
        if moving:
            # A change of the image has the same effect as a change common to the shots of a position.
            mean = np.stack([found[shots.position == g].mean(axis=0) for g in range(shots.positions)])
            # Places and light change by less than this (px; relative).
            so_far = np.clip(found - mean[shots.position], -0.7, 0.7)
            sources = replace(start, place_px=start.place_px + so_far[:, :2], flux=start.flux * (1.0 + so_far[:, 2:]))
    return sources


def _slopes(
    shots: Shots, sources: Sources, windows: Windows, image: Image
) -> Float[np.ndarray, "shots own rows columns"]:
    """Return derivatives of samples, in e-/s, by their LED's place in px (x, y) and relative light (R, G, B)."""
    offset_px = sources.place_px - shots.origin_px

    def at(right: float, below: float) -> Crops:
        down, across = _moves(shots, np.add(offset_px, (right, below)), True)
        return replace(windows, down=down, across=across).unit_light(image)

    h = 0.05
    by_place = [(at(h, 0.0) - at(-h, 0.0)) / (2 * h), (at(0.0, h) - at(0.0, -h)) / (2 * h)]
    return np.concatenate([np.stack(by_place, 1), windows.by_colour(at(0.0, 0.0))], 1) * windows.flux[:, None]
