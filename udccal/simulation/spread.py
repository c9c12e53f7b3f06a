"""Distribution of the light of one distant source after the panel, by colour, in direction cosines."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
import scipy.sparse
from jaxtyping import Float, Int

from udccal.simulation.diffraction import ellipse_cover, power_spectrum
from udccal.simulation.spectrum import camera_spectrum
from udccal.simulation.truth import RigTruth

# In sensor pixels: cells have the finest size up to the reach from the source, then grow by a factor to the coarsest.
_FINEST, _COARSEST, _FINE_REACH, _GROWTH = 1 / 32, 0.25, 3.0, 1.06
_BLOCK_ROWS, _WORKERS = 64, 2


@dataclass(frozen=True)
class AngularSpread:
    """Cumulative light by colour over direction cosines relative to the source (panel axes X, Y).

    ``cumulative[k, m, c]`` is the fraction of colour c's light with l_y < edges_y[k] and l_x < edges_x[m], counted from
    the first edges.
    """

    edges_x: Float[np.ndarray, "nodes_x"]
    edges_y: Float[np.ndarray, "nodes_y"]
    cumulative: Float[np.ndarray, "nodes_y nodes_x 3"]

    def below(self, x: Float[np.ndarray, "*n"], y: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n 3"]:
        """Return the light at direction cosines below both ``x`` and ``y``, relative to the source."""
        column, right = _bracket(self.edges_x, x)
        row, down = _bracket(self.edges_y, y)
        flat = self.cumulative.reshape(-1, 3)
        corner = row * self.edges_x.size + column
        top = _mix(flat[corner], flat[corner + 1], right)
        corner += self.edges_x.size
        return _mix(top, _mix(flat[corner], flat[corner + 1], right), down)


def angular_spread(
    truth: RigTruth,
    direction: Float[np.ndarray, "3"],
    reach: tuple[float, float],
    shifts: tuple[tuple[float, float], ...] = ((0.0, 0.0),),
) -> AngularSpread:
    """Compute the spread of a source at ``direction``, out to direction cosines ``reach`` = (x, y) from it."""
    spectrum = camera_spectrum(truth)
    shortest_mm = float(spectrum.wavelengths_nm[0]) * 1e-6
    power = power_spectrum(truth, direction, (reach[0] / shortest_mm, reach[1] / shortest_mm), shifts)
    unit = 1.0 / truth.optics.fx_px
    edges_x, edges_y = _edges(reach[0], unit), _edges(reach[1], unit)
    relative_step = spectrum.step_nm / spectrum.wavelengths_nm
    # Power is even: only cells with l_y >= 0 are computed; the others are their mirror image.
    half_y = edges_y[edges_y.size // 2 :]
    picks = []
    for wavelength_nm, relative in zip(spectrum.wavelengths_nm, relative_step, strict=True):
        per_y, per_x = (step * wavelength_nm * 1e-6 for step in (power.step_y, power.step_x))
        pick_y = _cell_operator(half_y, float(relative), per_y, power.zero_y, power.cumulative.shape[0])
        pick_x = _cell_operator(edges_x, float(relative), per_x, power.zero_x, power.cumulative.shape[1])
        picks.append((pick_y, pick_x))
    cells = np.empty((3, half_y.size - 1, edges_x.size - 1))

    def fill(first: int) -> None:
        rows = slice(first, first + _BLOCK_ROWS)
        light = [pick_x @ np.ascontiguousarray((pick_y[rows] @ power.cumulative).T) for pick_y, pick_x in picks]
        cells[:, rows] = np.tensordot(spectrum.weights, light, axes=1).swapaxes(1, 2)

    # Rows by the block, so that one block's light at every wavelength stays in the processor's cache.
    with ThreadPoolExecutor(_WORKERS) as pool:
        list(pool.map(fill, range(0, half_y.size - 1, _BLOCK_ROWS)))
    return AngularSpread(edges_x, edges_y, _cumulative(np.concatenate([cells[:, ::-1, ::-1], cells], axis=1)))


def averaged_over(
    spread: AngularSpread,
    shape: Float[np.ndarray, "2 2"],
    low: Float[np.ndarray, "2"],
    high: Float[np.ndarray, "2"],
    step: Float[np.ndarray, "2"],
) -> AngularSpread:
    """Return the spread of an even source, the ellipse ``shape @ u`` over the unit disc of u, about the same direction.

    Args:
        spread: of a point.
        shape: of the source, in direction cosines.
        low, high: (x, y) between which the result is needed.
        step: (x, y) of the even grid of the result.
    """
    reach = (np.ceil(np.linalg.norm(shape, axis=1) / step) + 1).astype(np.int64)
    # Multiples of the step, so that the result does not depend on the window.
    first, last = np.floor(low / step).astype(np.int64) - reach, np.ceil(high / step).astype(np.int64) + reach
    x, y = (step[i] * np.arange(first[i], last[i] + 1) for i in range(2))
    pick_x, pick_y = _linear_operator(spread.edges_x, x), _linear_operator(spread.edges_y, y)
    rows = (pick_y @ spread.cumulative.reshape(spread.edges_y.size, -1)).reshape(y.size, -1, 3)
    table = np.stack([(pick_x @ np.ascontiguousarray(rows[..., c].T)).T for c in range(3)], axis=-1)
    taps_x, taps_y = (step[i] * np.arange(-reach[i], reach[i] + 1) for i in range(2))
    source = ellipse_cover(taps_x, taps_y, shape, step).astype(np.float64)
    # A correlation, but the source is the same either way round; the rim that lacks neighbours is cut off.
    inner_x, inner_y = slice(reach[0], -reach[0]), slice(reach[1], -reach[1])
    even = cv2.filter2D(table, -1, source / source.sum())[inner_y, inner_x]
    return AngularSpread(x[inner_x], y[inner_y], np.ascontiguousarray(even))


def _linear_operator(edges: Float[np.ndarray, "nodes"], values: Float[np.ndarray, "n"]) -> scipy.sparse.csr_array:
    """Return the sparse matrix that interpolates from the edges to the values, constant outside."""
    index, part = _bracket(edges, values)
    rows = np.arange(values.size)
    entries = np.concatenate([1.0 - part[:, 0], part[:, 0]]), (np.tile(rows, 2), np.concatenate([index, index + 1]))
    return scipy.sparse.csr_array(entries, shape=(values.size, edges.size))


def _edges(reach: float, unit: float) -> Float[np.ndarray, "nodes"]:
    """Return cell edges, symmetric about zero and finest there."""
    fine = np.arange(0.0, _FINE_REACH, _FINEST)
    edges = list(fine * unit)
    step = _FINEST
    while edges[-1] < reach:
        step = min(step * _GROWTH, _COARSEST)
        edges.append(edges[-1] + step * unit)
    positive = np.array(edges)
    return np.concatenate([-positive[:0:-1], positive])


def _cell_operator(
    edges: Float[np.ndarray, "nodes"], relative_step: float, cosine_per_row: float, origin: float, nodes: int
) -> scipy.sparse.csr_array:
    """Return the sparse matrix from cumulative power to the light in each cell, for one wavelength.

    The wavelength represents a band, over which light at distance l moves by l * step / wavelength. Each cell collects
    from a window widened by that amount (variances add), and is scaled back to the cell's width.
    """
    middle, width = (edges[1:] + edges[:-1]) / 2, np.diff(edges)
    window = np.hypot(width, middle * relative_step)
    rows, columns, values = [], [], []
    for edge, sign in ((middle + window / 2, 1.0), (middle - window / 2, -1.0)):
        position = np.clip(edge / cosine_per_row + origin, 0.0, nodes - 1.0)
        first = np.clip(position.astype(np.int64) - 1, 0, nodes - 4)
        for tap, weight in enumerate(_cubic_weights(position - first)):
            rows.append(np.arange(middle.size))
            columns.append(first + tap)
            values.append(sign * weight * width / window)
    entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    return scipy.sparse.csr_array(entries, shape=(middle.size, nodes))


def _cubic_weights(position: Float[np.ndarray, "n"]) -> tuple[Float[np.ndarray, "n"], ...]:
    """Return Lagrange's weights of the values at 0, 1, 2, 3 for the cubic through them."""
    a, b, c, d = position, position - 1, position - 2, position - 3
    return -b * c * d / 6, a * c * d / 2, -a * b * d / 2, a * b * c / 6


def _cumulative(cells: Float[np.ndarray, "3 cells_y cells_x"]) -> Float[np.ndarray, "nodes_y nodes_x 3"]:
    total = np.zeros((cells.shape[1] + 1, cells.shape[2] + 1, 3))
    total[1:, 1:] = np.moveaxis(cells.cumsum(axis=1).cumsum(axis=2), 0, -1)
    return total


def _bracket(
    edges: Float[np.ndarray, "nodes"], value: Float[np.ndarray, "*n"]
) -> tuple[Int[np.ndarray, "*n"], Float[np.ndarray, "*n 1"]]:
    """Return the node before each value, and the value's fraction of the way to the next node."""
    position = np.interp(value, edges, np.arange(edges.size))
    index = np.minimum(position.astype(np.int64), edges.size - 2)
    return index, (position - index)[..., None]


def _mix(
    first: Float[np.ndarray, "*n 3"], second: Float[np.ndarray, "*n 3"], part: Float[np.ndarray, "*n 1"]
) -> Float[np.ndarray, "*n 3"]:
    second -= first
    second *= part
    second += first
    return second
