"""LED shots whose right order is known."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, final

import numpy as np
from jaxtyping import Float

from tests.scenes.psf import DISC_PX, Picture, Scene, pictures, shots_of, small_scene
from udccal.cfa import cfa_named
from udccal.fitting.psf.data import PsfRules, Shots
from udccal.fitting.psf.image import Sources, prior_sigma, shifts
from udccal.fitting.psf.orders import select_field
from udccal.fitting.psf.start import start_model, start_prior
from udccal.models.fields import polynomial_basis, polynomial_terms
from udccal.numerics import in_float64

ENOUGH: Final = 0.95


_HALF: Final = (10, 6)


# A residual is so much of the kernel, and turns over about three times as many rows.
_BENT: Final = 0.03


_ROWS_PX: Final = 1.5


_PLACE_SIGMA_PX: Final = 0.002


@final
@dataclass(frozen=True, order=True)
class Kind:
    """A residual: degree of its polynomials, -1 for none, and (rows, columns) to either side of the source it has."""

    degree: int
    half_px: tuple[int, int]


KINDS: Final = (Kind(-1, (0, 0)), Kind(0, _HALF), Kind(0, (5, 3)), Kind(1, _HALF))


@final
@dataclass(frozen=True)
class World:
    """A scene, its LEDs without noise and without a residual: those of diffraction alone, and what
    size a residual may have."""

    scene: Scene
    pictures: tuple[Picture, ...]
    room: Float[np.ndarray, "rows columns"]


@in_float64
def world() -> World:
    """LEDs at 4 x 3 positions of the rig as built."""
    scene = small_scene(positions=(4, 3), shifts=3, half=_HALF)
    theta = start_prior(scene.rig, start_model(scene.rig, scene.geometry, scene.wire)).mean
    made = pictures(scene, theta, np.random.default_rng(5))
    return World(scene, tuple(made), _room(scene, made))


@in_float64
def chosen(known: World, kind: Kind, seed: int) -> Kind:
    """What is chosen where the residual is of a ``kind``, its coefficients drawn and the pictures noisy."""
    scene, rng = known.scene, np.random.default_rng([seed, kind.degree + 1, kind.half_px[0]])
    # So much more light in the mean that there is nowhere less than none.
    drawn = _BENT * np.array([1.0, *rng.choice([-0.5, 0.5], 2)])[: polynomial_terms(kind.degree)]
    phase = rng.uniform(-np.pi, np.pi)
    shots = shots_of(scene, [_bent(picture, known, drawn, phase, kind) for picture in known.pictures], rng)
    explained = np.stack([_explained(p, shots, i) for i, p in enumerate(known.pictures)])
    place = np.stack([p.source_px for p in known.pictures])
    place = place + _PLACE_SIGMA_PX * rng.standard_normal(place.shape)
    light = np.stack([p.flux for p in known.pictures])
    sources = Sources(place, light, np.zeros(shots.count)).with_light_of_peak(shots, explained)
    half = _half_sensor(scene)
    positions = (shots.positions_px() - half) / half
    found = select_field(shots, sources, explained, positions, 0.0, PsfRules())
    rows, columns = found.image.shape[2:]
    return Kind(found.trial.order.degree, (rows // 2, columns // 2))


def _half_sensor(scene: Scene) -> Float[np.ndarray, "2"]:
    camera = scene.rig.camera
    return (np.array([camera.columns, camera.rows]) - 1) / 2


def _bent(picture: Picture, known: World, drawn: Float[np.ndarray, " terms"], phase: float, kind: Kind) -> Picture:
    """The picture with a residual that goes up and down along columns."""
    if not drawn.size:
        return picture
    rows, columns = picture.rate.shape
    half = _half_sensor(known.scene)
    basis = np.asarray(polynomial_basis(((picture.source_px - half) / half)[None], kind.degree))[0]
    image = (basis @ drawn) * known.room * (1.0 + np.sin(np.arange(rows) / _ROWS_PX + phase)[:, None])
    if kind.half_px != _HALF:
        down, across = (np.abs(np.arange(size) - size // 2) for size in (rows, columns))
        room = known.room * ((down <= kind.half_px[0])[:, None] & (across <= kind.half_px[1]))
        image = image * (room > 0)
        # An LED that looked brighter by it would look as if it lacked light all around.
        image = image - room * (image * known.room).sum() / (room * known.room).sum()
    x, y = picture.source_px - picture.corner_px - [columns // 2, rows // 2]
    disc = np.array([DISC_PX])
    light = shifts(np.array([y]), disc, rows)[0] @ image @ shifts(np.array([x]), disc, columns)[0].T
    flux = picture.flux[cfa_named(known.scene.rig.camera.cfa).channel_map(rows, columns)]
    return replace(picture, rate=np.maximum(picture.rate + flux * light, 0.0))


def _room(scene: Scene, made: list[Picture]) -> Float[np.ndarray, "rows columns"]:
    """The residual's standard deviation beforehand where it may be all of the kernel, on whole pixels."""
    total = np.zeros_like(made[0].rate)
    for picture in made:
        rows, columns = picture.rate.shape
        unit = picture.rate / picture.flux[cfa_named(scene.rig.camera.cfa).channel_map(rows, columns)]
        off = np.round(picture.source_px - picture.corner_px - [columns // 2, rows // 2]).astype(int)
        total += np.roll(unit, (-off[1], -off[0]), axis=(0, 1)) / len(made)
    return prior_sigma(np.stack([total] * 3), 1.0)[1]


def _explained(picture: Picture, shots: Shots, index: int) -> Float[np.ndarray, "rows columns"]:
    """What diffraction brings to the samples of a crop per unit of light."""
    rows, columns = shots.rate.shape[1:]
    first = shots.origin_px[index] - picture.corner_px - [columns // 2, rows // 2]
    part = picture.rate[first[1] : first[1] + rows, first[0] : first[0] + columns]
    return np.asarray(part / picture.flux[shots.channel[index]])
