"""The light of one lamp beyond the sensor's range, found from its halo.

Y are the samples of the lamp's tile, in units of their noise, and P = (s B + 1)^-1 their precision under the filter's
prior (``mosaic_filter``). The light u of the lamp's pixels, blurred by T, is not negative. Nothing is known of hidden
samples, those that clip and those next to them: the lamp's shape, which no pixel resolves, decides what they have. So u
and the hidden samples' f minimise

    (Y - T u + E f)^T P (Y - T u + E f) + sum over hidden samples that do not clip of max(0, (T u - Y) / sigma)^2,

E being their places: a sample's light is not less than its part of the halo. f is eliminated (a Schur complement).
Within a tile P is the same at every cell of the colour pattern. So all blocks of the equations are read from its
responses to one sample, and to one pixel of light, for each place of the cell.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, final

import numpy as np
from jaxtyping import Bool, Float, Float64, Int
from scipy import fft
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize

from udccal.cfa import Cfa
from udccal.restoration.filter_tables import FilterTables
from udccal.restoration.kernel_grid import centred

# Of a kernel, near the lamp: its relative error counts as noise where a halo is compared with a sample.
_KERNEL_ERROR: Final = 0.03
_STEPS, _MEMORY = 100, 30
# Keeps the equations solvable: of hidden samples, in units of their noise, a precision of nothing; of light that no
# sample sees, its scale over the largest.
_RIDGE, _UNSEEN = 1e-12, 1e-10

Tile = Float64[np.ndarray, "rows columns"]
Places = tuple[Int[np.ndarray, " _"], Int[np.ndarray, " _"]]


@final
@dataclass(frozen=True)
class Responses:
    """What the precision P answers, anywhere in a tile.

    Attributes:
        cfa: the colour pattern.
        channel: colour of each sample of a tile.
        transfer: spectrum of the kernel of each of its colours.
        vectors, weights: P in the coordinates of ``FilterTables``.
        to_sample: P, from a sample at each place of the cell.
        to_light: P T, from a pixel's light of each colour at each place of the cell, at the samples.
        of_light: T^T P T, the same at the pixels, by the colour there and the colour of the light.
    """

    cfa: Cfa
    channel: Int[np.ndarray, "rows columns"]
    transfer: np.ndarray
    vectors: np.ndarray
    weights: np.ndarray
    to_sample: Float64[np.ndarray, "down across rows columns"]
    to_light: Float64[np.ndarray, "colours down across rows columns"]
    of_light: Float64[np.ndarray, "colours colours down across rows columns"]

    @classmethod
    def of(
        cls,
        tables: FilterTables,
        strength: np.float32,
        kernels: Float[np.ndarray, "channels ky kx"],
        cfa: Cfa,
        size: tuple[int, int],
    ) -> Responses:
        """Compute them.

        Args:
            tables: of the tile's kernel.
            strength: of the tile's prior.
            kernels: of the tile, by channel.
            cfa: the colour pattern.
            size: (rows, columns) of a tile.
        """
        cell, count = (cfa.rows, cfa.columns), len(cfa.colours)
        transfer = np.array([fft.rfft2(centred(kernels[colour], *size)) for colour in cfa.colours])
        # Eliminating hidden samples cancels nearly all of the equations: single precision would leave noise.
        vectors, weights = tables.vectors.astype(complex), 1 / (tables.values.astype(float) * strength + 1)
        empty = (np.empty(shape + cell + size) for shape in ((), (count,), (count, count)))
        made = cls(cfa, cfa.channel_map(*size), transfer, vectors, weights, *empty)
        for place in np.ndindex(cell):
            one = np.zeros(size)
            one[place] = 1.0
            made.to_sample[place] = made.precision(one)
            for index in range(count):
                light = np.zeros((count, *size))
                light[(index, *place)] = 1.0
                made.to_light[(index, *place)] = made.precision(made.blurred(light))
                made.of_light[(slice(None), index, *place)] = made.gathered(made.to_light[(index, *place)])
        return made

    def precision(self, samples: Tile) -> Tile:
        """Return P Y."""
        planes = np.stack([samples[site.samples] for site in self.cfa.sites])
        along = np.conj((self.vectors * fft.rfft2(planes)).sum(axis=1)) * self.weights
        solved = fft.irfft2(np.conj((self.vectors.swapaxes(0, 1) * along).sum(axis=1)), s=planes.shape[1:])
        result = np.empty(samples.shape)
        for site, plane in zip(self.cfa.sites, solved, strict=True):
            result[site.samples] = plane
        return result

    def blurred(self, light: Float64[np.ndarray, "colours rows columns"]) -> Tile:
        """Return T u, of the light of every pixel of a tile."""
        planes = fft.irfft2(fft.rfft2(light) * self.transfer, s=self.channel.shape)
        return np.select([self.channel == colour for colour in self.cfa.colours], list(planes))

    def gathered(self, samples: Tile) -> Float64[np.ndarray, "colours rows columns"]:
        """Return T^T Y."""
        own = np.stack([np.where(self.channel == colour, samples, 0.0) for colour in self.cfa.colours])
        found: Float64[np.ndarray, "colours rows columns"] = fft.irfft2(
            fft.rfft2(own) * np.conj(self.transfer), s=samples.shape
        )
        return found

    def between(self, responses: np.ndarray, to: Places, source: Places) -> np.ndarray:
        """Return the responses at some places of a tile to others, as (..., to, source)."""
        rows, columns = self.channel.shape
        down, across = source[0] % self.cfa.rows, source[1] % self.cfa.columns
        row, column = (down + to[0][:, None] - source[0]) % rows, (across + to[1][:, None] - source[1]) % columns
        found: np.ndarray = responses[..., down, across, row, column]
        return found


@final
@dataclass(frozen=True)
class LampLight:
    """What one lamp's fit gives.

    Attributes:
        light: of its pixels, by colour of the pattern, in units of the colour's noise.
        hidden: what the hidden samples would have without the lamp, less their level, in units of their noise.
        evidence: by how much the lamp lowers twice the negative log likelihood of the tile's other samples.
    """

    light: Float64[np.ndarray, "colours pixels"]
    hidden: Float64[np.ndarray, " hidden"]
    evidence: float


def lamp_light(
    samples: Tile,
    level: Tile,
    hidden: Bool[np.ndarray, "rows columns"],
    unclipped: Bool[np.ndarray, "rows columns"],
    lamp: Bool[np.ndarray, "rows columns"],
    start: Float64[np.ndarray, "colours pixels"],
    responses: Responses,
) -> LampLight:
    """Return the likeliest light of a lamp.

    Args:
        samples: of the tile, less their level, in units of their noise; tapered.
        level: of each sample's colour, in the same units.
        hidden: samples of which nothing is known but a limit.
        unclipped: those of the hidden samples that do not clip.
        lamp: pixels that may be the lamp's.
        start: light that the search starts with, in units of the colours' noise.
        responses: of the tile's prior.
    """
    at, pixels, known = _places(hidden), _places(lamp), np.where(hidden, 0.0, samples)
    own = responses.between(responses.to_sample, at, at)
    own[np.diag_indices_from(own)] += _RIDGE
    cross = np.concatenate(list(responses.between(responses.to_light, at, pixels)), axis=1)
    light = responses.between(responses.of_light, pixels, pixels)
    light = light.swapaxes(1, 2).reshape(2 * (start.size,))
    answer = responses.precision(known)
    slope = responses.gathered(answer)[:, pixels[0], pixels[1]].ravel()
    solved = cho_solve(cho_factor(own, check_finite=False), np.column_stack([answer[at], cross]))
    matrix, slope = light - cross.T @ solved[:, 1:], slope - cross.T @ solved[:, 0]
    halo, most = _limits(samples + level, hidden & unclipped, pixels, responses)
    found, evidence = _not_negative((matrix + matrix.T) / 2, slope, halo, most, start.ravel())
    # What was eliminated has the lamp's own light, too.
    lit = np.zeros((len(start), *samples.shape))
    lit[:, pixels[0], pixels[1]] = found.reshape(start.shape)
    rest = solved[:, 1:] @ found - solved[:, 0] - responses.blurred(lit)[at]
    return LampLight(found.reshape(start.shape), rest, evidence)


def _places(mask: Bool[np.ndarray, "rows columns"]) -> Places:
    row, column = np.nonzero(mask)
    return row, column


def _limits(
    samples: Tile, beside: Bool[np.ndarray, "rows columns"], pixels: Places, responses: Responses
) -> tuple[Float64[np.ndarray, "beside light"], Float64[np.ndarray, " beside"]]:
    """Return the halo at samples beside a lamp, by its pixels' light, and the most that it may be; both over sigma."""
    at = _places(beside)
    kernels = fft.irfft2(responses.transfer, s=samples.shape)
    row, column = at[0][:, None] - pixels[0], at[1][:, None] - pixels[1]
    channel = responses.channel[at]
    parts = [
        np.where((channel == colour)[:, None], kernel[row, column], 0.0)
        for colour, kernel in zip(responses.cfa.colours, kernels, strict=True)
    ]
    sigma = np.hypot(1.0, _KERNEL_ERROR * np.maximum(samples[at], 0.0))
    return np.concatenate(parts, axis=1) / sigma[:, None], samples[at] / sigma + 1.0


def _not_negative(
    matrix: Float64[np.ndarray, "light light"],
    slope: Float64[np.ndarray, " light"],
    halo: Float64[np.ndarray, "beside light"],
    most: Float64[np.ndarray, " beside"],
    start: Float64[np.ndarray, " light"],
) -> tuple[Float64[np.ndarray, " light"], float]:
    """Minimise u^T M u / 2 - b^T u and the excess of the halo, for light u that is not negative."""
    own = np.diag(matrix)
    scale = np.sqrt(np.maximum(own, _UNSEEN * own.max()))
    matrix, slope, halo = matrix / scale / scale[:, None], slope / scale, halo / scale

    def cost(light: np.ndarray) -> tuple[float, np.ndarray]:
        along, excess = matrix @ light, np.maximum(halo @ light - most, 0.0)
        value = light @ along / 2 - slope @ light + excess @ excess / 2
        return float(value), along - slope + halo.T @ excess

    options = {"maxiter": _STEPS, "maxcor": _MEMORY, "ftol": 1e-12, "gtol": 1e-9}
    bounds = [(0.0, None)] * len(start)
    best = minimize(cost, start * scale, jac=True, method="L-BFGS-B", bounds=bounds, options=options)
    return best.x / scale, -2.0 * float(best.fun)
