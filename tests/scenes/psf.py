"""LED pictures whose kernel is in the class of the psf fit: light by ``udccal.models``, brackets with noise."""

from __future__ import annotations

from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt16

from udccal.cfa import cfa_named
from udccal.fitting.hdr.merge import merge_bracket
from udccal.fitting.nominal import nominal_geometry
from udccal.fitting.psf.data import Shots, joined
from udccal.fitting.psf.kernel import WAVELENGTHS_NM, Evaluator, fit_lattice
from udccal.fitting.psf.start import cut_crop
from udccal.models.diffraction import Diffraction, average_transfer, is_shaped, local_frame
from udccal.models.geometry import Geometry
from udccal.models.interference import (
    footprint_place,
    interference_transfer,
    node_overlaps,
    overlap_tables,
    strengths,
)
from udccal.models.lattice import Lattice, sample, spline_coefficients
from udccal.models.noise import Noise
from udccal.models.psf import lattice_points
from udccal.models.wire import Wire
from udccal.numerics import in_float64
from udccal.rig import RigDescription, load_rig

FLUX = np.array([0.7, 1.0, 0.6])
DISC_PX = 1.0
_SPARE = 4


@dataclass(frozen=True)
class Scene:
    """A rig, and where and how its LED is captured.

    Attributes:
        half: (rows, columns) to either side of the LED.
        level: of saturation, in the brightest sample of the shortest exposure.
        exposures_s, repeats: of one bracket.
    """

    rig: RigDescription
    geometry: Geometry
    wire: Wire
    noise: Noise
    half: tuple[int, int]
    places_px: Float[np.ndarray, "positions 2"]
    shifts: int
    exposures_s: tuple[float, ...]
    level: float = 0.8


def small_scene(positions: tuple[int, int] = (3, 2), shifts: int = 2, half: tuple[int, int] = (16, 8)) -> Scene:
    """A few LEDs in small windows on the reduced rig; a wire that shows, exactly as the rig was built."""
    rig = load_rig("lg55-reduced")
    geometry = nominal_geometry(rig)
    x, y = (np.linspace(80, size - 80, n) for size, n in zip((1024, 768), positions, strict=True))
    return Scene(
        rig=rig,
        geometry=geometry,
        wire=wire_as_built(rig, geometry),
        noise=noise_of(rig),
        half=half,
        places_px=np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2).round(),
        shifts=shifts,
        exposures_s=tuple(1e-3 * 4.0**k for k in range(6)),
    )


def noise_of(rig: RigDescription) -> Noise:
    """Shot noise, 5 e- of read noise and the converter's steps."""
    camera = rig.camera
    zero = np.float64(0.0)
    return Noise(
        K_DN_per_e=np.float64(camera.K_DN_per_e.value),
        black_DN=np.float64(camera.black_DN.value),
        saturation_DN=np.float64(rig.saturation_DN),
        sigma_d_e=np.float64(5.0),
        lambda_read=np.float64(0.14),
        sigma_row_DN=zero,
        q_DN=np.float64(1.0),
        dark_current_e_per_s=zero,
        DSNU1288_e=zero,
        PRNU1288=zero,
    )


def wire_as_built(rig: RigDescription, geometry: Geometry) -> Wire:
    """The wire of a perfect rig: its first harmonic along the rows, and nothing else in the picture."""
    panel, pitch = rig.panel, rig.panel.pitch_mm.value
    fields = np.zeros((1, 2, 2, 1))
    fields[0, 0, 0, 0] = 1.0
    return Wire(
        geometry=geometry,
        rotation_rad=np.zeros(3),
        standoff_per_pitch=np.float64(rig.mounting.standoff_mm.value / pitch),
        offset_periods=np.asarray(geometry.pupil_mm)[:2] / pitch,
        footprint_per_pitch=np.float64(rig.pupil_diameter_mm / pitch),
        row_open=np.float64(panel.row_open.value),
        column_open=np.float64(panel.column_open.value),
        depth_per_pitch=np.float64(panel.depth_mm.value / pitch),
        harmonics=np.array([[0.0, 1.0]]),
        frequency=np.array([[5.0, 1.0]]),
        fields=fields,
        amplitudes=np.zeros((0, 2, 1, 1)),
        baseline=np.zeros((1, 1)),
    )


@eqx.filter_jit
def light_on_lattice(
    model: Diffraction,
    geometry: Geometry,
    place: Float[Array, "2"],
    offsets: Float[Array, "n 2"],
    grid: Lattice,
    shaped: bool,
    disc_px: float = DISC_PX,
) -> Float[Array, "n 3"]:
    """Light per unit of a source at ``place``, a disc on the sensor."""
    frame = local_frame(geometry, place)
    spectra = jnp.asarray(model.spectrum)
    overlaps = node_overlaps(model, frame, grid, overlap_tables(model, frame))
    transfer = average_transfer(model, frame, grid, spectra, disc_px, shaped=shaped)
    strength = strengths(model, footprint_place(model, frame))
    transfer = transfer + interference_transfer(model, frame, grid, spectra, overlaps, strength, disc_px)
    points, density = lattice_points(geometry, frame, place, offsets)
    return sample(grid, spline_coefficients(grid, transfer), points) * density[:, None]


@dataclass(frozen=True)
class Picture:
    """Noise-free rate of one LED in e-/s on Bayer sites, where it is, and its light per colour in e-/s."""

    rate: Float[np.ndarray, "rows columns"]
    corner_px: tuple[int, int]
    aim_px: tuple[float, float]
    source_px: Float[np.ndarray, "2"]
    flux: Float[np.ndarray, "3"]


@in_float64
def pictures(
    scene: Scene, theta: Float[np.ndarray, " p"], rng: np.random.Generator, interference: bool = True
) -> list[Picture]:
    """All LEDs of a scene under the model that ``theta`` packs, with the wire's phase or averaged over it."""
    rows, columns = (2 * (h + _SPARE) + 1 for h in scene.half)
    # That of the fit: what a lattice of this size leaves out is no matter of efficiency.
    lattice = fit_lattice(scene.half)
    model, made = Evaluator(WAVELENGTHS_NM, lattice, interference, shaped=True).model(theta), []
    for place in scene.places_px:
        for _ in range(scene.shifts):
            aim = place + rng.uniform(0, 2, 2)
            source = aim + rng.uniform(-1, 1, 2)
            corner = (np.round(aim).astype(int) - [columns // 2, rows // 2]) // 2 * 2
            y, x = np.mgrid[:rows, :columns]
            offsets = np.stack([x.ravel(), y.ravel()], axis=-1) + corner - source
            light = np.asarray(light_on_lattice(model, scene.geometry, source, offsets, lattice, is_shaped(model)))
            light = light.reshape(rows, columns, 3) * FLUX
            rate = np.take_along_axis(light, cfa_named(scene.rig.camera.cfa).channel_map(rows, columns)[..., None], 2)[
                ..., 0
            ]
            top = scene.level * (scene.rig.saturation_DN - float(scene.noise.black_DN)) / float(scene.noise.K_DN_per_e)
            full = top / scene.exposures_s[0] / rate.max()
            aimed, at = (float(aim[0]), float(aim[1])), (int(corner[0]), int(corner[1]))
            made.append(Picture(rate * full, at, aimed, source, FLUX * full))
    return made


def frames_of(
    scene: Scene, rate: Float[np.ndarray, "rows columns"], rng: np.random.Generator
) -> UInt16[np.ndarray, "n rows columns"]:
    """A bracket as the sensor makes it: Poisson, read noise, quantised, clipped."""
    noise = scene.noise
    electrons = np.stack([rng.poisson(np.maximum(rate, 0) * t) for t in scene.exposures_s])
    electrons = electrons + float(noise.sigma_d_e) * rng.standard_normal(electrons.shape)
    counts = np.round(electrons * float(noise.K_DN_per_e) + float(noise.black_DN))
    return np.clip(counts, 0, scene.rig.saturation_DN).astype(np.uint16)


def shots_of(scene: Scene, made: list[Picture], rng: np.random.Generator) -> Shots:
    """What the psf fit works on, from brackets of these pictures."""
    crops = []
    for picture in made:
        merged = merge_bracket(frames_of(scene, picture.rate, rng), np.array(scene.exposures_s), scene.noise)
        crop = cut_crop(merged, picture.corner_px, picture.aim_px, scene.rig.camera.cfa, scene.half, DISC_PX)
        assert crop is not None
        crops.append(crop)
    return joined(crops, np.array([p.aim_px for p in made]))
