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
    """All shots about their LED.

    Attributes:
        basis: polynomials at each shot's position.
        down, across: from nodes to samples, along columns and along rows: shift and disc.
        flux: light of each sample's own colour, 0 where nothing is known.
        channel: each sample's colour: 0, 1, 2 for R, G, B.
        explained: light of each sample by diffraction, per unit of the LED's light.
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

    def pick(self, keep: np.ndarray) -> Windows:
        """The shots selected by an index or mask."""
        return Windows(*(part[keep] for part in vars(self).values()))

    def expected(self, free: bool, image: Image) -> Crops:
        """Return each sample's light in e-/s, by an image, and by diffraction unless the image is ``free``."""
        unit = predict(self, image) + (0.0 if free else self.explained)
        return unit * self.flux


def make_windows(
    shots: Shots,
    sources: Sources,
    explained: Crops,
    basis: Float[np.ndarray, "shots terms"],
    model_error: float,
    per_px: int = 1,
) -> Windows:
    """Return the data from which images are solved; see ``Windows``.

    ``model_error``, relative to the peak, adds to the data's noise. The image has ``per_px`` nodes to a pixel, the
    first and last on the first and last pixels.
    """
    known, rate = shots.weight > 0, shots.rate - sources.background[:, None, None]
    flux = sources.flux[np.arange(shots.count)[:, None, None], shots.channel]
    smooth = np.maximum(scipy.ndimage.uniform_filter(np.abs(rate), (0, 3, 3)), np.abs(flux * explained))
    unexplained = left_out(smooth.reshape(shots.count, -1), 1.0).reshape(smooth.shape)
    measured = 1.0 / np.where(known, shots.weight, 1.0)
    variance = noise_at(smooth, rate, measured, shots.noise_per_rate) + (model_error * unexplained) ** 2
    x, y = (sources.place_px - shots.origin_px).T
    return Windows(
        basis=basis,
        down=shifts(y, shots.disc_px, shots.rate.shape[1], per_px),
        across=shifts(x, shots.disc_px, shots.rate.shape[2], per_px),
        flux=flux * known,
        channel=shots.channel,
        explained=explained,
        rate=rate * known,
        left_out=unexplained,
        weight=np.where(known, 1.0 / variance, 0.0),
    )


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
    magnitude: Float[np.ndarray, "3 rows columns"], relative: float, per_px: int = 1
) -> Float[np.ndarray, "3 node_rows node_columns"]:
    """Return the prior sigma of every coefficient: a fraction of the kernel's own size near that node."""
    near = scipy.ndimage.maximum_filter(scipy.ndimage.gaussian_filter(np.abs(magnitude), (0, 0.7, 0.7)), (1, 3, 3))
    near = near + 1e-5 * near.max(axis=(1, 2), keepdims=True)
    nodes = [1.0, *((per_px * (size - 1) + 1) / size for size in near.shape[1:])]
    return np.asarray(relative * scipy.ndimage.zoom(near, nodes, order=1))


def predict(windows: Windows, image: Image) -> Crops:
    """Return each sample's light by an image, per unit of the LED's light."""
    of_shots = np.tensordot(windows.basis[:, : len(image)], image, 1)
    moved = windows.down[:, None] @ of_shots @ np.swapaxes(windows.across, 1, 2)[:, None]
    return np.take_along_axis(moved, windows.channel[:, None], axis=1)[:, 0]


def _by_colour(windows: Windows, light: Crops) -> Float[np.ndarray, "shots 3 rows columns"]:
    return light[:, None] * (windows.channel[:, None] == np.arange(3)[:, None, None])


def _gathered(windows: Windows, light: Crops, terms: int) -> Image:
    """Return the transpose of ``predict``."""
    moved = np.swapaxes(windows.down, 1, 2)[:, None] @ _by_colour(windows, light) @ windows.across[:, None]
    return np.tensordot(windows.basis[:, :terms].T, moved, 1)


@final
@dataclass(frozen=True)
class Moves:
    """Changes of each shot along with a free image: place in px (x, y), and relative light (R, G, B).

    ``design`` has the derivatives of samples, in e-/s; ``changed`` is the sum of the changes so far, and ``sigma`` the
    prior standard deviations of the whole changes.
    """

    design: Float[np.ndarray, "shots 5 rows columns"]
    changed: Float[np.ndarray, "shots 5"]
    sigma: Float[np.ndarray, "5"]

    def light(self, own: Float[np.ndarray, "shots 5"]) -> Crops:
        """Return the light that changes add, in e-/s."""
        return np.einsum("spyx,sp->syx", self.design, own)

    def fitted(self, light: Crops, weight: Crops) -> Float[np.ndarray, "shots 5"]:
        """Return the changes that this light is most likely to come from."""
        weighted = (self.design * weight[:, None]).reshape(*self.design.shape[:2], -1)
        flat = self.design.reshape(weighted.shape)
        normal = weighted @ np.swapaxes(flat, 1, 2) + np.diag(self.sigma**-2.0)
        return np.linalg.solve(normal, weighted @ light.reshape(len(light), -1, 1))[..., 0]


def solve_image(
    windows: Windows, sigma: Image, free: bool, start: Image, moves: Moves | None = None
) -> tuple[Image, Float[np.ndarray, "shots 5"]]:
    """Return the ridge estimate of an image, with diffraction or ``free`` of it, and the changes of own parameters.

    The image, like its ``start``, is in units of ``sigma``, its prior standard deviations; see ``image_of``. The prior
    is about the addition to the start: a prior about the whole would prefer a smaller image and brighter LEDs. With
    ``moves``, places and light of the shots are estimated too.
    """
    flux, weight, changes = windows.flux, windows.weight, np.zeros((len(windows.flux), 5))
    data = windows.rate - (0.0 if free else flux * windows.explained)
    # The prior is about the whole change, and the model is linear: the data become those before any change.
    data = data if moves is None else data + moves.light(moves.changed)

    def forward(scaled: Image) -> Crops:
        return flux * predict(windows, image_of(scaled, sigma, free))

    def backward(light: Crops) -> Image:
        left = light if moves is None else light - moves.light(moves.fitted(light, weight))
        return sigma * smoothed(_gathered(windows, flux * weight * left, len(sigma)), free)

    def normal(flat: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        return flat + backward(forward(flat.reshape(sigma.shape))).ravel()

    iterations, tolerance = (150, 1e-5) if free else (60, 1e-4)
    operator = scipy.sparse.linalg.LinearOperator((sigma.size, sigma.size), matvec=normal, dtype=np.float64)
    # Pixels hardly share a residual's nodes: divided by the diagonal, bright nodes and dark ones converge alike, in few
    # iterations. A free image's are finer, and smoothed: it gains nothing.
    preconditioner = None
    if not free:
        squared = replace(windows, basis=windows.basis**2, down=windows.down**2, across=windows.across**2)
        diagonal = 1.0 + sigma**2 * _gathered(squared, flux**2 * weight, len(sigma))
        preconditioner = scipy.sparse.diags_array(1.0 / diagonal.ravel())
    right = backward(data - forward(start)).ravel()
    added, _ = scipy.sparse.linalg.cg(operator, right, rtol=tolerance, maxiter=iterations, M=preconditioner)
    image = start + added.reshape(sigma.shape)
    return image, changes if moves is None else moves.fitted(data - forward(image), weight)


def image_of(scaled: Image, sigma: Image, free: bool) -> Image:
    """Return the image from its scaled values."""
    return smoothed(scaled * sigma, free)


def smoothed(image: Image, free: bool) -> Image:
    """Smooth an image by a Gaussian of one node where it is free; the smoothing is its own transpose."""
    if not free:
        return image
    return np.asarray(scipy.ndimage.gaussian_filter(image, 1.0, mode="constant", axes=(-2, -1)))


def free_sources(
    shots: Shots,
    basis: Float[np.ndarray, "shots terms"],
    terms: int,
    magnitude: Float[np.ndarray, "3 rows columns"],
    rules: PsfRules,
) -> Sources:
    """Estimate places and light without diffraction: from the crops themselves, then along with a free image.

    The image has the first ``terms`` of the ``basis``; ``magnitude`` is the kernel's average size.
    """
    colour = shots.colour * (shots.weight > 0)[..., None]
    light, covered = (np.einsum("syx,syxc->sc", shots.rate, colour), np.einsum("cyx,syxc->sc", magnitude, colour))
    start = Sources(shots.centre_px, light / np.maximum(covered, 1e-6), np.zeros(shots.count))
    nothing = np.zeros_like(shots.rate)
    sigma = np.tile(prior_sigma(magnitude, 1.0, FREE_PER_PX), (terms, 1, 1, 1))
    sources, changed, scaled = start, np.zeros((shots.count, 5)), np.zeros_like(sigma)
    for moving in (False, True, True):
        windows = make_windows(shots, sources, nothing, basis, rules.free_model_error, FREE_PER_PX)
        image = image_of(scaled, sigma, True)
        moves = _moves(shots, sources, windows, image, changed, rules) if moving else None
        scaled, found = solve_image(windows, sigma, True, scaled, moves)
        # A change of the image has the same effect as a change common to the shots of a position.
        mean = np.stack([found[shots.position == g].mean(axis=0) for g in range(shots.positions)])
        # Places and light change by less than this (px; relative).
        changed = np.clip(found - mean[shots.position], -0.7, 0.7)
        sources = replace(start, place_px=start.place_px + changed[:, :2], flux=start.flux * (1.0 + changed[:, 2:]))
    return sources


def _moves(
    shots: Shots,
    sources: Sources,
    windows: Windows,
    image: Image,
    changed: Float[np.ndarray, "shots 5"],
    rules: PsfRules,
) -> Moves:
    """Linearise about ``sources``, whose places and light have already changed by ``changed``."""
    x, y = (sources.place_px - shots.origin_px).T

    def at(right: float, below: float) -> Crops:
        down = shifts(y + below, shots.disc_px, shots.rate.shape[1], FREE_PER_PX)
        across = shifts(x + right, shots.disc_px, shots.rate.shape[2], FREE_PER_PX)
        return predict(replace(windows, down=down, across=across), image)

    h = 0.05
    by_place = [(at(h, 0.0) - at(-h, 0.0)) / (2 * h), (at(0.0, h) - at(0.0, -h)) / (2 * h)]
    design = np.concatenate([np.stack(by_place, 1), _by_colour(windows, at(0.0, 0.0))], 1) * windows.flux[:, None]
    return Moves(design, changed, np.repeat(rules.own_sigma, (2, 3)))
