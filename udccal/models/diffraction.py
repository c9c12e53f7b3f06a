"""Diffraction by a panel of periodic slits in front of a round pupil, as a field over the sensor.

The light sent from direction cosines l0 to l has the transfer function, f in cycles per unit direction cosine,

    O(f) = sum over wavelengths of w(lambda) R(lambda f),  R(s) = sum_gh cos(2 pi (g X + h Y)) A_g(s_x) A_h(s_y) H_gh(s)

R is the autocorrelation of the open part of the pupil's footprint at a lag s on the panel. A_h are the Fourier
coefficients of a row of slits times itself moved by the lag. H_gh is that of the footprint times itself moved by the
lag. (X, Y) is the footprint's centre in pitches (Goodman, Introduction to Fourier Optics, sections 3.10, 6.3).
The term g = h = 0 is the average over X and Y, an incoherent sum of diffraction orders. With round corners it is a sum
of products: the opening is a pile of slits, which get narrower as a corner is cut in steps. The other terms are the
interference between neighbouring orders, which changes as the footprint slides over the rows (see ``interference``).
Direction cosines along the panel make this exact at any angle: the geometry adds stretch and conical bending.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from udccal.models.arrays import Arrayish
from udccal.models.bessel import sine_cosine
from udccal.models.geometry import Geometry, panel_directions, rotation_matrix
from udccal.models.lattice import Frequencies

# Of sums over the light of a wavelength node; 1 changes kernels by 2e-6.
_FINE_NM = 5.0
# Bars narrower than this are none, in periods.
_LEAST_BAR = 1e-3
# Corners with a smaller radius are none, in periods.
_LEAST_CORNER = 1e-3
# A round corner is cut in five steps, at these parts of its radius along either axis. Orders down to a ten-thousandth
# of the brightest one have the right light to 4 % RMS where the radius is 0.15 of a period, and to 14 % at 0.2.
_STEPS = (0.0, 0.056, 0.179, 0.335, 0.545, 0.803)
PUPIL_NODES = 4


class Diffraction(eqx.Module):
    """Parameters of the diffraction over the whole field.

    Attributes:
        pitch_mm: pitch of rows and columns.
        openings: open part of the (columns, rows) for a ray along the panel's normal.
        depth_mm: depth of the opaque structure; it narrows slits by depth * |tangent of the obliquity|.
        depth_ratio: logarithm of the rows' depth over the columns', whose geometric mean is ``depth_mm``.
        bar_width: width of an opaque bar through the openings of the (columns, rows) in periods, for a ray along the
            normal; none below a thousandth. Its depth is theirs.
        bar_place: distance of the bar's middle from the opening's, in periods; kernels do not tell its sign.
        corner_radius: that of the openings' round corners, in periods.
        pupil_diameter_mm: diameter of the entrance pupil.
        offset_periods: centre (X, Y) of the footprint of a ray along the normal, in periods from the middle of an
            opening, modulo 1.
        standoff_per_pitch: distance from the pupil to the openings in pitches; the centre moves by this times slope.
        visibility: 1, or 0 to leave out the interference between orders, where the footprint's place is not known.
        blur_px: standard deviation of a Gaussian that represents all other small blur, on the camera's axis.
        blur_growth: (radial, tangential) growth of the logarithm of that deviation by the square of the image's
            distance from the axis in focal lengths. A lens's field curvature and astigmatism are of this order.
        blur_colour: logarithm of each colour's deviation over ``blur_px``: lenses focus colours at different distances.
        wavelengths_nm: nodes of the spectra, evenly spaced.
        spectrum: light per colour channel at the nodes, linear between them; each channel sums to 1.
    """

    pitch_mm: Float[Arrayish, ""]
    openings: Float[Arrayish, "2"]
    depth_mm: Float[Arrayish, ""]
    depth_ratio: Float[Arrayish, ""]
    bar_width: Float[Arrayish, "2"]
    bar_place: Float[Arrayish, "2"]
    corner_radius: Float[Arrayish, ""]
    pupil_diameter_mm: Float[Arrayish, ""]
    offset_periods: Float[Arrayish, "2"]
    standoff_per_pitch: Float[Arrayish, ""]
    visibility: Float[Arrayish, ""]
    blur_px: Float[Arrayish, ""]
    blur_growth: Float[Arrayish, "2"]
    blur_colour: Float[Arrayish, "3"]
    wavelengths_nm: Float[Arrayish, " nodes"]
    spectrum: Float[Arrayish, "3 nodes"]


class Slits(eqx.Module):
    """A period of (columns, rows) along a ray: its open part, and an opaque bar in it, which a width of 0 leaves out.

    Attributes:
        opened: width of the opening in periods, the bar included.
        bar_width, bar_place: width of the bar, and distance of its middle from the opening's, in periods.
        corner_radius: on (columns, rows) in periods; smaller where an opening is narrow.
    """

    opened: Float[Arrayish, "2"]
    bar_width: Float[Arrayish, "2"]
    bar_place: Float[Arrayish, "2"]
    corner_radius: Float[Arrayish, "2"]

    def levels(
        self, rounded: bool
    ) -> tuple[Float[Array, "levels 2"], Float[Array, "levels 2"], Float[Array, "levels 2"]]:
        """Return open width, and width and place of the bar, at the steps of round corners, the widest first."""
        opened = self.opened - 2.0 * jnp.array(_STEPS if rounded else _STEPS[:1])[:, None] * self.corner_radius
        return opened, *_inside(opened, self.bar_width, self.bar_place)

    def open_part(self, rounded: bool) -> Float[Array, ""]:
        """Return what corners leave of the opening's area."""
        opened, bar_width, _ = self.levels(rounded)
        columns, rows = jnp.moveaxis(opened - bar_width, 1, 0)
        # Where rows are open least, columns are open most.
        return jnp.sum((columns - jnp.append(columns[1:], 0.0)) * rows[::-1]) / (columns[0] * rows[0])


class LocalFrame(eqx.Module):
    """Geometry around one source.

    Attributes:
        direction: (l_x, l_y, l_z) of the source in panel coordinates.
        jacobian: d(l_x, l_y) / d(pixel x, y).
        footprint: matrix that takes the unit disc of the pupil (camera x, y) to the panel plane along the source's ray.
        radius: (x, y) of the source's image from the camera's axis, in focal lengths.
    """

    direction: Float[Array, "3"]
    jacobian: Float[Array, "2 2"]
    footprint: Float[Array, "2 2"]
    radius: Float[Array, "2"]


def local_frame(geometry: Geometry, position_px: Float[Arrayish, "2"]) -> LocalFrame:
    """Return direction, scale and pupil footprint of a source imaged at ``position_px`` (x, y) by ``geometry``."""

    def cosines(position: Float[Array, "2"]) -> Float[Array, "3"]:
        return panel_directions(geometry, position[None])[0]

    position = jnp.asarray(position_px)
    direction = cosines(position)
    jacobian = jax.jacfwd(cosines)(position)[:2]
    across = rotation_matrix(geometry.rotation_rad)[:, :2]
    footprint = across[:2] - jnp.outer(direction[:2] / direction[2], across[2])
    radius = (position - jnp.asarray(geometry.principal_point_px)) / jnp.asarray(geometry.focal_px)
    return LocalFrame(direction, jacobian, footprint, radius)


def node_scale(frame: LocalFrame) -> Float[Array, "2"]:
    """Return direction cosines per pixel (along x, along y) at the source: the unit of the lattice around it."""
    return jnp.abs(jnp.diagonal(frame.jacobian))


def average_transfer(
    model: Diffraction,
    frame: LocalFrame,
    lattice: Frequencies,
    spectra: Float[Array, "3 nodes"],
    disc_px: Float[Arrayish, ""] = 0.0,
    *,
    rounded: bool,
) -> Float[Array, "3 rows half"]:
    """Return transfer functions averaged over the footprint's place: the term g = h = 0, pixel included.

    Args:
        model: the diffraction term.
        frame: geometry around the source.
        lattice: lattice in panel directions around the source.
        spectra: light of each colour at the model's wavelength nodes.
        disc_px: diameter of a round source on the sensor; 0 for a point.
        rounded: False leaves round corners out, which saves time.
    """
    fx, fy = lattice_frequencies(frame, lattice)
    slits = slits_along(model, frame)
    columns, rows = opening_overlaps(model, slits, fx, fy, rounded)
    rows = rows / slits.open_part(rounded)

    def add(
        total: Float[Array, "3 rows half"], anchor: tuple[Array, Array]
    ) -> tuple[Float[Array, "3 rows half"], None]:
        pupil, part = anchor
        return total + jnp.einsum("cj,pyj,pxj->cyx", spectra * part, rows, columns) * pupil, None

    # A loop over overlaps computed beforehand: without it the compiler computes them again for every channel.
    anchors = pupil_overlaps(model, frame, lattice), pupil_anchors(model)[1]
    total, _ = jax.lax.scan(add, jnp.zeros((3, rows.shape[1], columns.shape[1])), anchors)
    return through_sensor(total, sensor_transfer(frame, fx, fy, blur_variance(model, frame), disc_px))


def pupil_overlaps(model: Diffraction, frame: LocalFrame, lattice: Frequencies) -> Float[Array, "anchors rows half"]:
    """Return the overlap of the pupil's footprint with itself moved, at the wavelengths of ``pupil_anchors``.

    Args:
        model: the diffraction term.
        frame: geometry around the source.
        lattice: lattice whose frequencies give the lags.
    """
    lag_x, lag_y = relative_lag(model, frame, *lattice_frequencies(frame, lattice))
    distance = jnp.sqrt(lag_x**2 + lag_y**2 + 1e-30)
    anchors, _ = pupil_anchors(model)
    return jax.lax.map(lambda anchor: disc_autocorrelation(distance * (anchor * 1e-6)), anchors)


def through_sensor(
    transfer: Float[Array, "3 rows half"], sensor: Float[Array, "3 rows half"]
) -> Float[Array, "3 rows half"]:
    """Multiply each colour's ``transfer`` by its ``sensor_transfer``; the loop has both computed only once."""
    return jax.lax.map(lambda one: one[0] * one[1], (transfer, sensor))


def lattice_frequencies(frame: LocalFrame, lattice: Frequencies) -> tuple[Float[Array, " half"], Float[Array, " rows"]]:
    """Return (f_x, f_y) of ``lattice`` around the source of ``frame``, in cycles per unit direction cosine."""
    scale = node_scale(frame)
    return jnp.asarray(lattice.frequency_x) / scale[0], jnp.asarray(lattice.frequency_y) / scale[1]


def slits_along(model: Diffraction, frame: LocalFrame) -> Slits:
    """Return the period of ``model`` along the ray of ``frame``'s source: its openings narrow, and its bars widen."""
    depth = model.depth_mm / model.pitch_mm * jnp.exp(model.depth_ratio * jnp.array([-0.5, 0.5]))
    shadow = depth * jnp.abs(frame.direction[:2] / frame.direction[2])
    opened, bar, place = (jnp.asarray(part) for part in (model.openings, model.bar_width, model.bar_place))
    opened, bar = jnp.clip(opened - shadow, 0.02, 1.0), jnp.where(bar > _LEAST_BAR, bar + shadow, 0.0)
    # Beyond a half, corners are half-circles; a little more leaves the radius a derivative there.
    return Slits(opened, *_inside(opened, bar, place), jnp.clip(model.corner_radius, 0.0, 0.6 * opened))


def has_round_corners(model: Diffraction) -> bool:
    """Return whether openings have round corners, which take longer to compute; a traced radius may be any."""
    return isinstance(model.corner_radius, jax.core.Tracer) or float(model.corner_radius) > _LEAST_CORNER


def _inside(
    opened: Float[Arrayish, "*levels 2"], bar: Float[Arrayish, "2"], place: Float[Arrayish, "2"]
) -> tuple[Float[Array, "*levels 2"], Float[Array, "*levels 2"]]:
    """Return width and place of what is inside the opening of a bar."""
    first, last = (jnp.clip(place + side * bar / 2, -opened / 2, opened / 2) for side in (-1.0, 1.0))
    return jnp.minimum(last - first, 0.9 * opened), (first + last) / 2


def relative_lag(
    model: Diffraction, frame: LocalFrame, fx: Float[Array, " half"], fy: Float[Array, " rows"]
) -> tuple[Float[Array, "rows half"], Float[Array, "rows half"]]:
    """Return each frequency's lag (x, y) per mm of wavelength, in diameters of the pupil and along its own axes."""
    (a, b), (c, d) = frame.footprint * model.pupil_diameter_mm
    fx, fy = fx / (a * d - b * c), fy[:, None] / (a * d - b * c)
    return d * fx - b * fy, a * fy - c * fx


def disc_autocorrelation(relative_lag: Float[Arrayish, "*n"]) -> Float[Array, "*n"]:
    """Return the overlap of a disc with itself moved by ``relative_lag`` diameters, as a fraction of its area."""
    inside = relative_lag < 1.0
    x = jnp.where(inside, relative_lag, 0.5)
    return jnp.where(inside, (jnp.arccos(x) - x * jnp.sqrt(1.0 - x * x)) * (2.0 / jnp.pi), 0.0)


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


def opening_overlaps(
    model: Diffraction, slits: Slits, fx: Float[Array, " half"], fy: Float[Array, " rows"], rounded: bool
) -> tuple[Float[Array, "parts half nodes"], Float[Array, "parts rows nodes"]]:
    """Return the open part times itself moved, averaged over the light of each wavelength node, by columns and rows.

    The sum over parts of one times the other is that of a period, relative to an opening with square corners: at no lag
    it is ``Slits.open_part``. Without round corners there is one part. With them the opening is a pile of slits: those
    of rows that each step leaves, by the columns that it opens in addition.

    Args:
        model: the diffraction term.
        slits: along the source's ray.
        fx: cycles per unit direction cosine along x, for the columns. fy: along y, for the rows.
        rounded: whether the openings' corners may be round.
    """
    nodes, levels = jnp.asarray(model.wavelengths_nm) * (1e-6 / model.pitch_mm), slits.levels(rounded)

    def pairs(axis: int, frequency: Float[Array, " n"]) -> Float[Array, "levels levels n nodes"]:
        # A node's light is a triangle as wide as its distance to its neighbours.
        lag, spread = frequency[:, None] * nodes, jnp.abs(frequency)[:, None] * (nodes[1] - nodes[0])
        opened, bar, place = (part[:, axis, None, None, None] for part in levels)
        other, other_bar, other_place = (jnp.swapaxes(part, 0, 1) for part in (opened, bar, place))
        both = window_overlap(opened, other, lag, spread)
        both += window_overlap(bar, other_bar, lag + other_place - place, spread)
        both -= window_overlap(opened, other_bar, lag + other_place, spread)
        both -= window_overlap(other, bar, lag - place, spread)
        return both / (slits.opened[axis] - slits.bar_width[axis])

    columns, rows = pairs(0, fx), pairs(1, fy)[::-1, ::-1]
    for axis in (0, 1):
        columns = -jnp.diff(columns, axis=axis, append=0.0)
    return columns.reshape(-1, *columns.shape[2:]), rows.reshape(-1, *rows.shape[2:])


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


def slits_of(
    model: Diffraction, slits: Slits, fx: Float[Array, " half"], fy: Float[Array, " rows"], highest: int
) -> tuple[Float[Array, "orders half nodes"], Float[Array, "orders rows nodes"]]:
    """Return slit coefficients of columns and of rows, averaged over the light of each wavelength node.

    A node's light is a triangle as wide as its distance to its neighbours. High orders therefore smear into a
    continuum, as they do in daylight, without a node for every nanometre. Coefficients above order 0 are summed in
    steps of some nanometres and leave bars out: they move a hundredth of the light, and a bar changes a part of that.

    Args:
        model: the diffraction term.
        slits: along the source's ray.
        fx: cycles per unit direction cosine along x, for the columns. fy: along y, for the rows.
        highest: highest Fourier order.
    """
    nodes = jnp.asarray(model.wavelengths_nm)
    step = nodes[1] - nodes[0]
    count = _fine_count(model)
    offset = jnp.arange(-count + 1, count) / count
    triangle = (1.0 - jnp.abs(offset)) / count
    fine = nodes[:, None] + offset * step
    # One loop for both axes: it compiles once.
    frequency, count = jnp.concatenate([fx, fy])[:, None], fx.shape[0]
    opened = jnp.asarray(slits.opened)[(jnp.arange(frequency.shape[0]) >= count).astype(int)][:, None]

    def averaged(wavelengths_nm: Float[Array, " k"]) -> Float[Array, "orders n"]:
        lag = frequency * (wavelengths_nm * 1e-6 / model.pitch_mm)
        return slit_coefficients(lag, opened, highest) @ triangle

    above = jnp.moveaxis(jax.lax.map(averaged, fine), 0, -1)
    columns, rows = opening_overlaps(model, slits, fx, fy, False)
    return jnp.concatenate([columns, above[:, :count]]), jnp.concatenate([rows, above[:, count:]])


def _fine_count(model: Diffraction) -> int:
    """Return the steps from one wavelength node to the next, for nodes that span about 300 nm."""
    return max(2, int(np.ceil(300.0 / (np.shape(model.wavelengths_nm)[0] - 1) / _FINE_NM)))


def pupil_anchors(model: Diffraction) -> tuple[Float[Array, " a"], Float[Array, "a nodes"]]:
    """Return a few Chebyshev wavelengths in nm, and the weights that interpolate from them to ``model``'s nodes.

    The footprint's autocorrelation varies smoothly with wavelength, so it is computed for these few only.
    """
    nodes = jnp.asarray(model.wavelengths_nm)
    angle = np.pi * (np.arange(PUPIL_NODES) + 0.5) / PUPIL_NODES
    anchors = (nodes[0] + nodes[-1]) / 2.0 + (nodes[-1] - nodes[0]) / 2.0 * jnp.asarray(np.cos(angle))
    # Lagrange's polynomials: one is 1 at its own anchor and 0 at the others.
    own = jnp.eye(PUPIL_NODES, dtype=bool)[:, :, None]
    above, below = nodes - anchors[:, None], anchors[:, None] - anchors
    return anchors, jnp.prod(jnp.where(own, 1.0, above / jnp.where(own, 1.0, below[..., None])), axis=1)


def blur_variance(model: Diffraction, frame: LocalFrame) -> Float[Array, "3 3"]:
    """Return the covariance of each colour's small blur at the source of ``frame``, in px^2: of x, of y, of both."""
    square = jnp.sum(frame.radius**2)
    radial, tangential = 2.0 * jnp.asarray(model.blur_growth) * square
    # Round on the axis, where the radius has no direction.
    further = jnp.where(square > 1e-12, jnp.exp(radial) - jnp.exp(tangential), 0.0) / jnp.maximum(square, 1e-12)
    x, y = frame.radius
    round_part = jnp.exp(tangential) * jnp.array([1.0, 1.0, 0.0])
    own = jnp.exp(2.0 * jnp.asarray(model.blur_colour))[:, None]
    return model.blur_px**2 * own * (round_part + further * jnp.stack([x * x, y * y, x * y]))


def sensor_transfer(
    frame: LocalFrame,
    fx: Float[Array, " half"],
    fy: Float[Array, " rows"],
    variance_px2: Float[Arrayish, "3 3"],
    disc_px: Float[Arrayish, ""],
) -> Float[Array, "3 rows half"]:
    """Return each colour's transfer function of the square pixel, the small blur and the round source together.

    Args:
        frame: geometry around the source.
        fx: cycles per unit direction cosine along x. fy: the same along y.
        variance_px2: of the Gaussian; see ``blur_variance``.
        disc_px: diameter of the source on the sensor; 0 for a point.
    """
    jacobian = frame.jacobian
    nu_x = jacobian[0, 0] * fx + jacobian[1, 0] * fy[:, None]
    nu_y = jacobian[0, 1] * fx + jacobian[1, 1] * fy[:, None]
    blurred = jnp.tensordot(jnp.asarray(variance_px2), jnp.stack([nu_x**2, nu_y**2, 2.0 * nu_x * nu_y]), 1)
    disc = _disc_transfer(jnp.pi * disc_px * jnp.sqrt(nu_x**2 + nu_y**2 + 1e-30))
    return jnp.sinc(nu_x) * jnp.sinc(nu_y) * disc * jnp.exp(-2.0 * jnp.pi**2 * blurred)


def _disc_transfer(z: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Return 2 J1(z) / z by Gauss-Chebyshev quadrature; accurate to 1e-6 for z up to 8."""
    count = 8
    angle = jnp.asarray(np.pi * np.arange(1, count + 1) / (count + 1))
    weights = 2.0 / (count + 1) * jnp.sin(angle) ** 2

    def add(total: Float[Array, "*n"], node: tuple[Array, Array]) -> tuple[Float[Array, "*n"], None]:
        cosine, weight = node
        return total + weight * sine_cosine(z * cosine)[1], None

    # As a loop: unrolled, its cosines take longer to compile than everything else.
    return jax.lax.scan(add, jnp.zeros_like(z), (jnp.cos(angle), weights))[0]
