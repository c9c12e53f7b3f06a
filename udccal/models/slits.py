"""A period of a panel along a ray: its open part, a bar in it, its shape, and overlaps of rows of such slits."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from udccal.models.arrays import Arrayish
from udccal.models.bessel import sine_cosine

# A round corner is cut in five steps, at these parts of its radius along either axis. Orders down to a ten-thousandth
# of the brightest one have the right light to 4 % RMS where the radius is 0.15 of a period, and to 14 % at 0.2.
_STEPS = (0.0, 0.056, 0.179, 0.335, 0.545, 0.803)
# A slanted opening is cut across in four slits, whose widths differ from the middle's by these parts of the slant.
_SLANTED = (-0.75, -0.25, 0.25, 0.75)
# Of its length, round corners take so many radii at both ends together; what is left slants.
_ENDS = 1.5
# Lags in periods, and half the base of the triangle that each is averaged over.
Lags = tuple[Float[Array, "_ nodes"], Float[Array, "_ 1"]]


class Slits(eqx.Module):
    """A period of (columns, rows) along a ray: its open part, and an opaque bar in it, which a width of 0 leaves out.

    Attributes:
        opened: width of the opening in periods, the bar included.
        bar_width, bar_place: width of the bar, and distance of its middle from the opening's, in periods.
        corner_radius: on (columns, rows) in periods; smaller where an opening is narrow.
        slant: by how much openings of (columns, rows) are wider at one end than in their middle, in periods.
    """

    opened: Float[Arrayish, "2"]
    bar_width: Float[Arrayish, "2"]
    bar_place: Float[Arrayish, "2"]
    corner_radius: Float[Arrayish, "2"]
    slant: Float[Arrayish, "2"]

    def levels(
        self, shaped: bool
    ) -> tuple[Float[Array, "levels 2"], Float[Array, "levels 2"], Float[Array, "levels 2"]]:
        """Return open width, and width and place of the bar, at the steps of round corners, the widest first."""
        opened = self.opened - 2.0 * jnp.array(_STEPS if shaped else _STEPS[:1])[:, None] * self.corner_radius
        return opened, *inside_opening(opened, self.bar_width, self.bar_place)

    def open_part(self, shaped: bool) -> Float[Array, ""]:
        """Return what corners leave of the opening's area."""
        opened, bar_width, _ = self.levels(shaped)
        columns, rows = jnp.moveaxis(opened - bar_width, 1, 0)
        # Where rows are open least, columns are open most.
        return jnp.sum((columns - jnp.append(columns[1:], 0.0)) * rows[::-1]) / (columns[0] * rows[0])

    def slanted(self, axis: int, across: Lags, along: Lags) -> tuple[Array, Array]:
        """Return what a slant adds to the overlap of openings with themselves moved.

        It is cut in slits a quarter of its length apart. Pairs equally far apart share their overlap along the length.

        Args:
            axis: of the slant, 0 where columns are wider at one end.
            across: lags along that axis. along: lags along the other one.

        Returns:
            parts across and along: the sum of their products is the slanted opening's overlap less a rectangle's.
        """
        other = 1 - axis
        length, wide = self.opened[other] - _ENDS * self.corner_radius[other], self.opened[axis]
        # Held, so that the parts across depend on their own axis alone.
        straight = jax.lax.stop_gradient(length / self.opened[other])
        widths = (wide + straight * self.slant[axis] * jnp.array(_SLANTED))[:, None, None]
        quarter, count = length / len(_SLANTED), len(_SLANTED)
        sides = [jnp.sum(window_overlap(widths[: count - n], widths[n:], *across), axis=0) for n in range(count)]
        ends = [window_overlap(quarter, quarter, along[0] + n * quarter, along[1]) for n in range(1 - count, count)]
        ends = [ends[count - 1], *(ends[count - 1 - n] + ends[count - 1 + n] for n in range(1, count))]
        whole = -window_overlap(wide, wide, *across), window_overlap(length, length, *along)
        return jnp.stack([*sides, whole[0]]), jnp.stack([*ends, whole[1]])


def inside_opening(
    opened: Float[Arrayish, "*levels 2"], bar: Float[Arrayish, "2"], place: Float[Arrayish, "2"]
) -> tuple[Float[Array, "*levels 2"], Float[Array, "*levels 2"]]:
    """Return width and place of what is inside the opening of a bar."""
    first, last = (jnp.clip(place + side * bar / 2, -opened / 2, opened / 2) for side in (-1.0, 1.0))
    return jnp.minimum(last - first, 0.9 * opened), (first + last) / 2


def slit_coefficients(
    relative_lag: Float[Arrayish, "*n"], opened: Float[Arrayish, "*#n"], highest: int
) -> Float[Array, "orders *n"]:
    """Return Fourier coefficients, orders 1 to highest, of a row of slits times itself moved by the lag in pitches.

    Slits overlap those N pitches away. The common openings are ``opened`` - |lag - N| wide and lie half a pitch further
    per N. The origin is the middle of an opening. Order 0 would be 1 at lag 0; see ``window_overlap``.
    """
    lag = jnp.asarray(relative_lag)
    whole = jnp.floor(lag)
    here, next_one = jnp.maximum(opened - lag + whole, 0.0), jnp.maximum(opened - 1.0 + lag - whole, 0.0)
    made = []
    odd = 1.0 - 2.0 * jnp.mod(whole, 2.0)
    waves = [sine_cosine(jnp.pi * width) for width in (here, next_one)]
    sines, twice = [(jnp.zeros_like(lag), sine) for sine, _ in waves], [2.0 * cosine for _, cosine in waves]
    for order in range(1, highest + 1):
        (_, near), (_, far) = sines
        parity = odd if order % 2 else 1.0
        made.append(parity * (near + (-1) ** order * far) / (jnp.pi * order * opened))
        # sin((n + 1) x) = 2 cos(x) sin(n x) - sin((n - 1) x)
        sines = [(now, two * now - before) for two, (before, now) in zip(twice, sines, strict=True)]
    return jnp.stack(made)


def window_overlap(
    one: Float[Arrayish, "*#n"], other: Float[Arrayish, "*#n"], apart: Float[Array, "*#n"], spread: Float[Array, "*#n"]
) -> Array:
    """Return the overlap of two rows of windows of period 1, averaged over a triangle of distances.

    Its second derivative by the distance is a sum of pulses where edges meet.

    Args:
        one, other: widths of the windows.
        apart: distance of the rows.
        spread: half of the triangle's base, in periods.
    """

    def fourth(edge: Array) -> Array:
        part = edge - jnp.floor(edge)
        return (part * (1.0 - part)) ** 2 / 24.0

    def bend(edge: Array) -> Array:
        # Minus the second integral of a pulse in every period less its mean, averaged over the triangle, but for a
        # constant: of a narrow one by what it changes near the pulse, of a wide one by differences of the fourth.
        away = jnp.abs(edge - jnp.round(edge))
        part = jnp.minimum(away / wide, 1.0)
        near = wide * (1.0 / 6.0 + part**2 * (0.5 - part / 6.0))
        narrow = 0.5 * away**2 - jnp.where(away < wide, near, 0.5 * away)
        differences = fourth(edge + wide) - 2.0 * fourth(edge) + fourth(edge - wide)
        return jnp.where(wide > 0.25, differences / jnp.maximum(wide, 0.25) ** 2, narrow)

    wide, reach, differ = jnp.maximum(spread, 1e-9), (one + other) / 2.0, (one - other) / 2.0
    edges = bend(apart + reach) + bend(apart - reach) - bend(apart + differ) - bend(apart - differ)
    return one * other - edges
