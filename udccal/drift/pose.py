"""The camera's pose and focal length by ten flats: the profile's wire, moved until its rows lie where they are seen.

Openings, pupil and shading stay those of the profile. The light in front of the panel is solved for: its level at each
colour site, and a polynomial of second degree. Parts of the sensor that remain far off, such as a smudge, are left out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import final

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import binary_dilation

from udccal.fitting.engine.gaussian import scaled_inverse
from udccal.fitting.wire.data import FlatNoise, Pixels, WireData, flat_noise, sample_pixels, tile_numbers, weighed
from udccal.fitting.wire.jacobian import values_at, wire_derivatives
from udccal.fitting.wire.parameters import shape_vector, with_shape
from udccal.models.wire import Wire
from udccal.numerics import in_float64
from udccal.validation.flats import CELLS, cell_medians, light_design

# Rotation (3), stand-off, offset (2) as in ``shape_vector``, and the focal length.
POSE, _FOCAL = 6, 6
# Pixels of each step: few until the pose is near.
_SAMPLES = (14_000, 14_000, 110_000, 110_000)
# Parts of the sensor are left out that are off by so many sigma and so much.
_ODD_SIGMA, _ODD = 6.0, 0.004
# So many parts around them are left out, too: a smudge has no edge, and what is left of it there moves the pose.
_MARGIN = 2
# Not where as much of the sensor is off: that is no smudge.
_MOST_ODD = 0.5
# Relative step of the derivative by the focal length.
_SMALL = 1e-4


@final
@dataclass(frozen=True)
class PoseChange:
    """Change of the pose since the profile.

    Attributes:
        values: rotation vector in panel coordinates (rad), ln of the stand-off, offset in periods (x, y), and ln of the
            focal length.
        cov: theirs, by the flats' noise.
        wire: the profile's wire at this pose and focal length.
        left: flat over that wire, less 1, median by part of the sensor; ``sigma`` is that of each.
        variance: of the residuals in units of noise; about 1 where the pose explains the flat.
    """

    values: Float[np.ndarray, "7"]
    cov: Float[np.ndarray, "7 7"]
    wire: Wire
    left: Float[np.ndarray, "down across"]
    sigma: Float[np.ndarray, "down across"]
    variance: float


@in_float64
def pose_change(wire: Wire, data: WireData) -> PoseChange:
    """Solve for the pose by Gauss and Newton's method, from the profile's wire on."""
    noise, start = flat_noise(data), wire
    odd = np.zeros(CELLS, dtype=bool)
    for samples in _SAMPLES:
        pixels = sample_pixels(data.balanced, wire.geometry, samples, data.cfa)
        step, cov, light, variance = _step(wire, _without(pixels, odd), noise)
        wire = _moved(wire, step)
        whole, base = values_at(wire, pixels)
        left, sigma = cell_medians(weighed(pixels, whole * base * light, noise), noise)
        with np.errstate(invalid="ignore"):
            odd = (np.abs(left) > _ODD) & (np.abs(left) > _ODD_SIGMA * sigma)
        around = binary_dilation(odd, np.ones((3, 3)), iterations=_MARGIN)
        odd = around if around.mean() < _MOST_ODD else odd
    change = shape_vector(wire)[:POSE] - shape_vector(start)[:POSE]
    focal = np.log(np.asarray(wire.geometry.focal_px)[0] / np.asarray(start.geometry.focal_px)[0])
    return PoseChange(np.append(change, focal), cov, wire, left, sigma, variance)


def _without(pixels: Pixels, odd: Bool[np.ndarray, "down across"]) -> Pixels:
    return replace(pixels, place=np.where(odd.ravel()[tile_numbers(pixels.scaled, CELLS)], -1, pixels.place))


def _step(
    wire: Wire, pixels: Pixels, noise: FlatNoise
) -> tuple[Float[np.ndarray, "7"], Float[np.ndarray, "7 7"], Float[np.ndarray, " n"], float]:
    """The next step, its covariance, the light in front of the panel at the sample's places, and the variance."""
    whole, base, by_shape = wire_derivatives(wire, pixels)
    by_pose = by_shape[:POSE] / whole
    ahead, light_there = values_at(wire, replace(pixels, ideal=pixels.ideal * (1 - _SMALL)))
    by_focal = np.log(ahead * light_there / (whole * base)) / _SMALL
    design = np.column_stack([by_pose.T, by_focal, light_design(pixels.scaled, pixels.site)])
    light = np.ones(len(whole))
    for _ in range(2):
        seen = weighed(pixels, whole * base * light, noise)
        root = np.sqrt(seen.pixels.weight) * whole * base
        tall, right = design * root[:, None], pixels.value / (whole * base) * root
        matrix = scaled_inverse(tall.T @ tall)
        solved = matrix @ (tall.T @ right)
        light = design[:, _FOCAL + 1 :] @ solved[_FOCAL + 1 :]
    used = root > 0
    off = (right - tall @ solved)[used]
    variance = float(off @ off) / max(int(used.sum()) - len(solved), 1)
    return solved[: _FOCAL + 1], max(variance, 1.0) * matrix[: _FOCAL + 1, : _FOCAL + 1], light, variance


def _moved(wire: Wire, step: Float[np.ndarray, "7"]) -> Wire:
    """The wire after a step of pose and focal length."""
    shape = shape_vector(wire)
    shape[:POSE] += step[:POSE]
    focal = np.asarray(wire.geometry.focal_px) * np.exp(step[_FOCAL])
    return with_shape(replace(wire, geometry=replace(wire.geometry, focal_px=focal)), shape)
