"""Evaluate a picture at arbitrary points from its transfer function, by one FFT and a cubic B-spline.

Cubic B-spline coefficients are the picture divided, in frequency, by the spline's own transfer function (Unser 1999,
"Splines: a perfect fit for signal and image processing"), so the prefilter costs no extra transform.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from udccal.models.arrays import Arrayish


@runtime_checkable
class Frequencies(Protocol):
    """The frequencies of a half-plane spectrum, in cycles per pixel."""

    @property
    def frequency_y(self) -> Float[np.ndarray, " rows"]:
        """Of each row."""

    @property
    def frequency_x(self) -> Float[np.ndarray, " half"]:
        """Of each column."""


@dataclass(frozen=True)
class Joined:
    """Frequencies of two lattices, one after the other: they make one transfer function of four parts."""

    first: Lattice
    second: Lattice

    @property
    def frequency_y(self) -> Float[np.ndarray, " rows"]:
        """Of each row, in cycles per pixel."""
        return np.concatenate([self.first.frequency_y, self.second.frequency_y])

    @property
    def frequency_x(self) -> Float[np.ndarray, " half"]:
        """Of each column, in cycles per pixel."""
        return np.concatenate([self.first.frequency_x, self.second.frequency_x])


@dataclass(frozen=True)
class Lattice:
    """``rows`` x ``columns`` nodes, both even, ``per_px_y`` and ``per_px_x`` to a pixel; node (0, 0) is the origin."""

    rows: int
    columns: int
    per_px_y: int
    per_px_x: int

    @property
    def frequency_y(self) -> Float[np.ndarray, " rows"]:
        """Cycles per pixel of each row of a half-plane spectrum."""
        return np.fft.fftfreq(self.rows) * self.per_px_y

    @property
    def frequency_x(self) -> Float[np.ndarray, " half"]:
        """Cycles per pixel of each column of a half-plane spectrum."""
        return np.fft.rfftfreq(self.columns) * self.per_px_x


def lattice_for(rows_px: float, columns_px: float, per_px_y: int, per_px_x: int) -> Lattice:
    """Return the smallest lattice of at least the given size whose Fourier transform is fast.

    Args:
        rows_px: height in px. columns_px: width in px.
        per_px_y: nodes per pixel along y. per_px_x: nodes per pixel along x.
    """
    return Lattice(_fast_even(rows_px * per_px_y), _fast_even(columns_px * per_px_x), per_px_y, per_px_x)


def _fast_even(at_least: float) -> int:
    size = 2 * int(np.ceil(at_least / 2))
    while _largest_prime_factor(size) > 5:
        size += 2
    return size


def _largest_prime_factor(number: int) -> int:
    for prime in (2, 3, 5):
        while number % prime == 0:
            number //= prime
    return max(number, 1)


def low_pass(frequency: Float[Arrayish, " n"], start: float, stop: float) -> Float[Array, " n"]:
    """Return 1 below ``start``, 0 above ``stop`` and a raised cosine between them, in the unit of ``frequency``."""
    along = jnp.clip((jnp.abs(jnp.asarray(frequency)) - start) / (stop - start), 0.0, 1.0)
    return 0.5 + 0.5 * jnp.cos(jnp.pi * along)


def spline_coefficients(lattice: Lattice, transfer: Float[Array, "c rows half"]) -> Float[Array, "rows columns c"]:
    """Return the cubic B-spline coefficients of pictures (Unser 1999).

    Args:
        lattice: the lattice of nodes.
        transfer: real transfer functions of the pictures; the value at frequency 0 is the picture's sum.
    """

    def prefilter(cycles_per_node: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        return (2.0 + np.cos(2 * np.pi * cycles_per_node)) / 3.0

    gain_y = prefilter(lattice.frequency_y / lattice.per_px_y)
    gain_x = prefilter(lattice.frequency_x / lattice.per_px_x)
    spectrum = transfer / (gain_y[:, None] * gain_x[None, :])
    picture = jnp.fft.irfft2(spectrum, s=(lattice.rows, lattice.columns))
    return jnp.moveaxis(picture, 0, -1) * (lattice.per_px_y * lattice.per_px_x)


def sample(
    lattice: Lattice, coefficients: Float[Arrayish, "rows columns c"], points_px: Float[Arrayish, "n 2"]
) -> Float[Arrayish, "n c"]:
    """Evaluate pictures at points.

    A lattice repeats itself. Pictures here fall as 1/x^2 along their series of diffraction orders, so their sum over
    all repeats is 1/sinc^2 times too high. The product with sinc^2 corrects that to first order.

    Args:
        lattice: the lattice of nodes.
        coefficients: from ``spline_coefficients``; of numpy, they are evaluated by numpy, without compiling.
        points_px: (x, y) in px from the origin.

    Returns:
        density per square pixel; zero outside the lattice.
    """
    xp: Any = jnp if isinstance(coefficients, jax.Array) else np
    nodes = points_px * xp.array([lattice.per_px_x, lattice.per_px_y])
    along = nodes / xp.array([lattice.columns, lattice.rows])
    inside = xp.all(xp.abs(along) < 0.5, axis=-1)
    base = xp.floor(nodes)
    weights_x, weights_y = (xp.stack(_cubic_b_spline(nodes[:, i] - base[:, i]), axis=-1) for i in (0, 1))
    first, taps = base.astype(xp.int32) - 1, xp.arange(4)
    columns = (first[:, 0, None] + taps) % lattice.columns
    rows = (first[:, 1, None] + taps) % lattice.rows
    flat = coefficients.reshape(lattice.rows * lattice.columns, -1)
    near = flat[(rows[:, :, None] * lattice.columns + columns[:, None, :]).reshape(-1, 16)]
    weights = (weights_y[:, :, None] * weights_x[:, None, :]).reshape(-1, 16)
    unfold = xp.prod(xp.sinc(along) ** 2, axis=-1)
    return xp.einsum("ntc,nt->nc", near, weights) * xp.where(inside, unfold, 0.0)[:, None]


def _cubic_b_spline(t: Float[Arrayish, " n"]) -> tuple[Float[Arrayish, " n"], ...]:
    """Return the weights of nodes -1, 0, 1, 2 at a fraction ``t`` between nodes 0 and 1."""
    u = 1.0 - t
    return u**3 / 6.0, (4.0 - 6.0 * t**2 + 3.0 * t**3) / 6.0, (4.0 - 6.0 * u**2 + 3.0 * u**3) / 6.0, t**3 / 6.0
