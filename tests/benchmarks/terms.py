"""The fitted terms of a profile against the truth of a simulated rig, in the quantities of the accuracy table."""

from __future__ import annotations

import numpy as np

from tests.benchmarks.rows import Row, at_most
from tests.scenes.psf_wave_optics import held_out_positions
from udccal.benches.capture import TERMS
from udccal.displays.pictures import face_picture
from udccal.models.backscatter import backscatter_rate as fitted_backscatter
from udccal.models.geometry import project_directions, tilt_rad
from udccal.models.psf import psf_kernels
from udccal.models.wire import wire_map as fitted_wire
from udccal.numerics import in_float64
from udccal.profiles.profile import Profile
from udccal.result import FitStatus
from udccal.simulation import backscatter, psf, wire
from udccal.simulation.truth import RigTruth, pixels_to_directions

_VISIBLE = 1e-4
_BACKSCATTER_SEEDS = (7001, 7002, 7003, 7004, 7005)


@in_float64
def term_rows(profile: Profile, truth: RigTruth) -> list[Row]:
    """All rows of the table that concern the terms."""
    stopped = sum(profile.result(term).status is not FitStatus.CONVERGED for term in TERMS)
    return [
        at_most("terms whose fit has not converged", stopped, 0, ""),
        *_wire_rows(profile, truth),
        *_psf_rows(profile, truth),
        *_backscatter_rows(profile, truth),
        *_noise_rows(profile, truth),
        *_geometry_rows(profile, truth),
    ]


def _wire_rows(profile: Profile, truth: RigTruth) -> list[Row]:
    true = wire.wire_map(truth)
    ratio = np.asarray(fitted_wire(profile.wire.term, *true.shape)) / true
    return [at_most("wire map, RMS", 100 * float(np.sqrt(np.mean((ratio - 1) ** 2))), 0.05, "%")]


def _psf_rows(profile: Profile, truth: RigTruth) -> list[Row]:
    captures = truth.description.captures
    rows, columns = captures.psf_region_rows - 1, captures.psf_region_columns - 1
    places = held_out_positions(truth)
    true = psf.kernels(truth, places, rows, columns)
    fitted = np.asarray(psf_kernels(profile.psf.term, places, rows, columns))
    relative = 100 * np.sqrt(np.sum((fitted - true) ** 2, axis=(2, 3)) / np.sum(true**2, axis=(2, 3)))
    made = [
        at_most(f"psf relative L2, {name}, worst of {len(places)} places not captured", relative[:, c].max(), 3.0, "%")
        for c, name in enumerate(("red", "green", "blue"))
    ]
    visible = true > _VISIBLE * true.max(axis=(2, 3), keepdims=True)
    error = np.where(visible, (fitted - true) / np.where(visible, true, 1.0), 0.0)
    tail = 100 * float(np.sqrt(np.sum(error**2) / visible.sum()))
    made.append(at_most("psf where above 1e-4 of its peak, RMS of the relative error", tail, 15.0, "%"))
    return made


def _backscatter_rows(profile: Profile, truth: RigTruth) -> list[Row]:
    panel = truth.description.panel
    worst = 0.0
    for seed in _BACKSCATTER_SEEDS:
        picture = face_picture(seed, panel.columns, panel.rows)
        true = backscatter.backscatter_rate(truth, picture)
        fitted = np.asarray(fitted_backscatter(profile.backscatter.term, picture))
        worst = max(worst, 100 * float(np.sqrt(np.mean((fitted - true) ** 2)) / true.max()))
    name = f"backscatter of {len(_BACKSCATTER_SEEDS)} new pictures, RMS, share of its peak, worst"
    return [at_most(name, worst, 2.0, "%")]


def _noise_rows(profile: Profile, truth: RigTruth) -> list[Row]:
    noise, sensor = profile.noise.term, truth.sensor
    sigma_d = np.hypot(sensor.sigma_read_e, sensor.sigma_row_DN / sensor.K_DN_per_e)
    return [
        at_most("K", 100 * abs(float(noise.K_DN_per_e) / sensor.K_DN_per_e - 1), 1.0, "%"),
        at_most("sigma_d", 100 * abs(float(noise.sigma_d_e) / float(sigma_d) - 1), 3.0, "%"),
        at_most("PRNU", 100 * abs(float(noise.PRNU1288) / sensor.PRNU1288 - 1), 5.0, "%"),
    ]


def _geometry_rows(profile: Profile, truth: RigTruth) -> list[Row]:
    camera = truth.description.camera
    x, y = np.meshgrid(np.linspace(0, camera.columns - 1, 33), np.linspace(0, camera.rows - 1, 25))
    pixels = np.stack([x.ravel(), y.ravel()], axis=-1)
    rays = pixels_to_directions(truth.optics, pixels)
    distance = np.linalg.norm(np.asarray(project_directions(profile.geometry.term, rays)) - pixels, axis=1)
    tilt = abs(float(np.rad2deg(tilt_rad(profile.geometry.term))) - truth.optics.tilt_deg)
    name = "projection of rays in the panel's frame, 95th percentile"
    return [at_most(name, float(np.percentile(distance, 95)), 0.15, "px"), at_most("tilt", tilt, 0.05, "deg")]
