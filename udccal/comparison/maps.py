"""Arrays of what two profiles say is seen: rays, wire, kernels, and the panel's light, at the same places."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8
from scipy.ndimage import map_coordinates
from scipy.optimize import least_squares

from udccal.comparison.comparable import check_finite
from udccal.comparison.grid import kernel_places, light_step, sensor_grid
from udccal.comparison.shared import STEPS
from udccal.fitting.geometry.fit import term_at
from udccal.kernels import fitted_size, kernels_at
from udccal.models.backscatter import Backscatter, PanelResponse, grid_positions, panel_response, response_grid
from udccal.models.geometry import Geometry, panel_directions, project_directions
from udccal.mounting import angles_deg
from udccal.numerics import in_float64
from udccal.profiles.profile import Profile
from udccal.result import FitResult
from udccal.rig import RigDescription

# Size of a panel picture's blocks, in panel pixels.
_BLOCK = 6


@final
@dataclass(frozen=True)
class DifferenceMaps:
    """What both profiles say is seen, and how it differs. ``rays`` are of the places of ``sensor_grid``.

    Attributes:
        rays_px: from where A images a ray of the panel's frame to where B does.
        lens_px: the same after the turn of the camera that brings the rays closest: the lenses alone.
        rays_sigma_px: one standard deviation of ``rays_px``, RMS of x and y, by both covariances of the geometry; None
            where one profile has no such covariance.
        wire: ln of B's wire map over A's; its mean is about 0.
        kernels_a, kernels_b: at the places of ``kernel_places``, of one size.
        light_a, light_b: of the panel in e-/s before the wire, by panel picture and camera colour.
    """

    rays_px: Float[np.ndarray, "n 2"]
    lens_px: Float[np.ndarray, "n 2"]
    rays_sigma_px: Float[np.ndarray, " n"] | None
    wire: Float[np.ndarray, "rows columns"]
    kernels_a: Float[np.ndarray, "places 3 ky kx"]
    kernels_b: Float[np.ndarray, "places 3 ky kx"]
    light_a: Float[np.ndarray, "pictures 3 grid_rows grid_columns"]
    light_b: Float[np.ndarray, "pictures 3 grid_rows grid_columns"]


def difference_maps(a: Profile, b: Profile) -> DifferenceMaps:
    """Return the maps of two comparable profiles. The psf's kernels take most of the time.

    Raises:
        ProfileError: when the terms give numbers that are not finite.
    """
    rays, lens, sigma = _rays(a, b)
    # What follows from the same finite numbers is computed once.
    same_rig = a.rig == b.rig
    same_light = same_rig and bool(eqx.tree_equal(a.backscatter.term, b.backscatter.term))
    kernels_a, kernels_b = _kernels(a, b, same_rig and bool(eqx.tree_equal(a.psf.term, b.psf.term)))
    pictures = panel_pictures(a.rig)
    light_a = _light(a, pictures)
    with np.errstate(divide="ignore", invalid="ignore"):
        wire = np.log(b.wire_map.astype(np.float64) / a.wire_map)
    maps = DifferenceMaps(
        rays_px=rays,
        lens_px=lens,
        rays_sigma_px=sigma,
        wire=wire,
        kernels_a=kernels_a,
        kernels_b=kernels_b,
        light_a=light_a,
        light_b=light_a if same_light else _light(b, pictures),
    )
    check_finite(maps.wire, maps.kernels_a, maps.kernels_b, maps.light_a, maps.light_b)
    return maps


@in_float64
def _rays(
    a: Profile, b: Profile
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"], Float[np.ndarray, " n"] | None]:
    pixels, see, image = sensor_grid(a.rig), jax.jit(panel_directions), jax.jit(project_directions)
    one, other = _numpy(a.geometry.term), _numpy(b.geometry.term)
    seen_a, seen_b = np.asarray(see(one, pixels)), np.asarray(see(other, pixels))
    # Half of there and back: exactly the negative when the profiles change places.
    rays = 0.5 * (np.asarray(image(other, seen_a)) - np.asarray(image(one, seen_b)))
    slopes = [_slopes(term, seen, image) for term, seen in ((one, seen_a), (other, seen_b))]
    turns = (0.5 * (slopes[0] + slopes[1]))[:, :, -3:].reshape(-1, 3)
    angles = 0.5 * (_angles_per_px(one, pixels) + _angles_per_px(other, pixels))
    check_finite(rays, turns, angles)
    lens = _without_turn(rays, turns.reshape(-1, 2, 3), angles)
    check_finite(lens)
    if not (_of_lens_and_pose(a.geometry) and _of_lens_and_pose(b.geometry)):
        return rays, lens, None
    variance = sum(
        np.einsum("nip,pq,niq->n", s, r.cov, s) for s, r in zip(slopes, (a.geometry, b.geometry), strict=True)
    )
    return rays, lens, np.sqrt(np.maximum(variance, 0.0) / 2)


def _angles_per_px(term: Geometry, pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3 2"]:
    """By how much a direction turns, as a vector in rad, from a pixel to the next across and down."""
    see, half = jax.jit(panel_directions), 0.5 * np.eye(2)
    return np.stack([np.asarray(see(term, pixels + e)) - np.asarray(see(term, pixels - e)) for e in half], axis=-1)


def _without_turn(
    rays: Float[np.ndarray, "n 2"], turns: Float[np.ndarray, "n 2 3"], angles_per_px: Float[np.ndarray, "n 3 2"]
) -> Float[np.ndarray, "n 2"]:
    """The rays' differences after the turn that leaves the least sum of fourth powers of angles, which mrcal takes."""
    unit = np.sqrt((rays**2).mean()) or 1.0
    seen, by_turn = angles_per_px @ (rays / unit)[..., None], angles_per_px @ turns
    # Angles in pixels of the picture's middle, of about 1.
    scale = np.sqrt(len(seen) / (angles_per_px**2).sum())

    def squares(turn: Float[np.ndarray, "3"]) -> Float[np.ndarray, " n"]:
        return np.asarray(((scale * (seen[..., 0] - by_turn @ turn)) ** 2).sum(axis=-1))

    start = np.linalg.lstsq(turns.reshape(-1, 3), rays.ravel() / unit, rcond=None)[0]
    with np.errstate(all="ignore"):
        check_finite(squares(start) ** 2)
        return rays - unit * (turns @ least_squares(squares, start, x_scale="jac").x)


def _of_lens_and_pose(result: FitResult[Geometry]) -> bool:
    return len(result.cov) == len(STEPS)


def _slopes(
    term: Geometry, directions: Float[np.ndarray, "n 3"], image: Callable[[Geometry, Float[np.ndarray, "n 3"]], Array]
) -> Float[np.ndarray, "n 2 12"]:
    """Derivatives of the places in px of fixed ``directions`` by lens and angles, in the order of the estimates."""
    x = np.concatenate(
        [term.focal_px, term.principal_point_px, term.distortion, angles_deg(np.asarray(term.rotation_rad))]
    )
    pupil = np.asarray(term.pupil_mm)
    above, below = (
        np.stack([np.asarray(image(term_at(x + sign * e, pupil), directions)) for e in np.diag(STEPS)])
        for sign in (1, -1)
    )
    return np.moveaxis((above - below) / (2 * STEPS[:, None, None]), 0, -1)


def _numpy(term: Geometry) -> Geometry:
    """The same numbers as float64, so that one compilation serves a fitted term and one that was read."""
    return jax.tree.map(lambda leaf: np.asarray(leaf, dtype=np.float64), term)


def _kernels(
    a: Profile, b: Profile, same: bool
) -> tuple[Float[np.ndarray, "places 3 ky kx"], Float[np.ndarray, "places 3 ky kx"]]:
    """Kernels of both at their fitted sizes, for which they are compiled since the fit, in frames of one size."""
    places, sizes = kernel_places(a.rig), [fitted_size(p.psf.term, p.rig) for p in (a, b)]
    rows, columns = np.max(sizes, axis=0)
    framed = []
    for profile, (down, across) in zip((a,) if same else (a, b), sizes, strict=False):
        margin = [(0, 0), (0, 0), *(((whole - part) // 2,) * 2 for whole, part in ((rows, down), (columns, across)))]
        framed.append(np.pad(kernels_at(profile.psf.term, places, down, across).astype(np.float64), margin))
    return framed[0], framed[-1]


def panel_pictures(rig: RigDescription) -> UInt8[np.ndarray, "2 panel_rows panel_columns 3"]:
    """Return the pictures whose light is compared: white, and blocks of seeded colours about as wide as the pupil."""
    shape = -(-rig.panel.rows // _BLOCK), -(-rig.panel.columns // _BLOCK), 3
    blocks = np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8)
    blocks = blocks.repeat(_BLOCK, axis=0).repeat(_BLOCK, axis=1)[: rig.panel.rows, : rig.panel.columns]
    return np.stack([np.full_like(blocks, 255), blocks])


@in_float64
def _light(
    profile: Profile, pictures: UInt8[np.ndarray, "pictures panel_rows panel_columns 3"]
) -> Float[np.ndarray, "pictures 3 grid_rows grid_columns"]:
    term = _coarse(profile.backscatter.term, light_step(profile.rig))
    response = panel_response(term, profile.rig.panel.rows, profile.rig.panel.columns)
    return np.stack([np.asarray(_response_grid(response, picture)) for picture in pictures])


@jax.jit
def _response_grid(
    response: PanelResponse, picture: UInt8[Array, "panel_rows panel_columns 3"]
) -> Float[Array, "3 grid_rows grid_columns"]:
    return response_grid(response, picture)


def _coarse(term: Backscatter, step: int) -> Backscatter:
    """The term on a grid of this spacing, which both profiles share."""
    x, y = (np.asarray(some) for some in grid_positions(term.columns, term.rows, step))
    at = np.meshgrid((y + 0.5) / term.step - 0.5, (x + 0.5) / term.step - 0.5, indexing="ij")
    mask = [map_coordinates(np.asarray(one, np.float64), at, order=1, mode="nearest") for one in np.asarray(term.mask)]
    coarse = replace(term, mask=np.stack(mask), step=step)
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype=float), coarse)
