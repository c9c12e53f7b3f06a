"""The wire of a drawn rig: the open area of the pupil's footprint on the panel, times the lens's shading."""

from __future__ import annotations

import itertools

import numpy as np

from tests.benchmarks.drawn_rigs.draw import Rig
from tests.benchmarks.drawn_rigs.openings import area_below, openings
from tests.benchmarks.drawn_rigs.optics import directions, footprint, rotation, sensor_pixels

# Twice as many strips and slopes change the map by less than 0.01 % RMS; coarser ones made it wrong by up to 0.1 %.
_STRIPS, _SLOPE = 100, 0.05


def wire_map(rig: Rig) -> np.ndarray:
    """Relative sensitivity of every pixel to an even field, mean 1."""
    rays = directions(rig, sensor_pixels(rig).reshape(-1, 2))
    seen = (open_part(rig, rays) * shading(rig, rays)).reshape(rig.rows, rig.columns)
    return seen / seen.mean()


def shading(rig: Rig, rays: np.ndarray) -> np.ndarray:
    """cos^4 of the field angle, and the barrel's vignetting."""
    cosine = rays @ rotation(rig)[:, 2]
    corner2 = (np.array([rig.columns, rig.rows]) ** 2 / rig.lens.focal_px**2).sum() / 4
    field2 = (1 / cosine**2 - 1) / corner2
    first, second = rig.lens.shading
    return cosine**4 * (1 - first * field2 - second * field2**2)


def open_part(rig: Rig, rays: np.ndarray) -> np.ndarray:
    """Part of the footprint that is open, for each ray: between openings computed at a few slopes."""
    slope, found = rays[:, :2] / rays[:, 2:], np.zeros(len(rays))
    low, high = np.floor(slope.min(axis=0) / _SLOPE), np.ceil(slope.max(axis=0) / _SLOPE)
    for node in itertools.product(*(np.arange(a, b + 1) for a, b in zip(low, high, strict=True))):
        at = (node[0] * _SLOPE, node[1] * _SLOPE)
        near = np.prod(np.clip(1 - np.abs(slope - at) / _SLOPE, 0.0, 1.0), axis=1)
        chosen = near > 0
        if chosen.any():
            found[chosen] += near[chosen] * _area(rig, rays[chosen], openings(rig.shape, at).table())
    return found


def _area(rig: Rig, rays: np.ndarray, table: np.ndarray) -> np.ndarray:
    """Open part of the ellipse, cut into strips along x; those near its ends are thinner."""
    centre, shape = footprint(rig, rays)
    centre, shape = centre / rig.true("pitch_mm") - rig.shape.offset, shape / rig.true("pitch_mm")
    half = np.linalg.norm(shape[:, 1], axis=1)
    slant = (shape[:, 0] * shape[:, 1]).sum(axis=1) / half
    reach = np.abs(np.linalg.det(shape)) / half
    edges = -np.cos(np.linspace(0, np.pi, _STRIPS + 1))
    total = np.zeros(len(rays))
    for low, high in itertools.pairwise(edges):
        # The chord is that of the strip's own area of the disc.
        chord = (_segment(high) - _segment(low)) / (high - low)
        x = centre[:, 0] + slant * (low + high) / 2
        left, right = x - reach * chord, x + reach * chord
        top, bottom = centre[:, 1] + half * low, centre[:, 1] + half * high
        total += area_below(table, right, bottom) - area_below(table, left, bottom)
        total -= area_below(table, right, top) - area_below(table, left, top)
    return total / (np.pi * half * reach)


def _segment(edge: float) -> float:
    """Half the area of the unit disc from its middle to ``edge``."""
    return float((edge * np.sqrt(max(1 - edge**2, 0.0)) + np.arcsin(edge)) / 2)
