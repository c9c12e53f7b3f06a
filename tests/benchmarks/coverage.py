"""Checks error bars on rigs whose truth no model describes, and writes a table into docs/numerics.md.

    python -m tests.benchmarks.coverage [--out DIR] [--rigs N]

Every rig is another specimen of the reduced mirror: wave-optics psf, area-integrated wire, scattered light, a full
sensor. It is captured, fitted, and compared with its truth where no fit has seen it: rays of the panel, the wire at any
pixel, the psf where no LED was, the light of new pictures, and the sensor's numbers. A 95 % interval must hold at least
90 % of them; exits with 1 where it does not.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import final, get_args

import jax
import numpy as np
from jaxtyping import Float

from tests.benchmarks.readme_tables import put_table
from tests.scenes.backscatter import predicted_light
from tests.scenes.psf_wave_optics import held_out_positions
from udccal.benches.bench import simulated_bench
from udccal.benches.capture import capture
from udccal.bins import Bins
from udccal.calibration import Foundation, fit_foundation
from udccal.compilation import keep_compilations
from udccal.displays.pictures import face_picture
from udccal.effort import FitEffort
from udccal.fitting.backscatter.fit import fit_backscatter
from udccal.fitting.backscatter.model import sampled_rays
from udccal.fitting.backscatter.read import read_backscatter
from udccal.fitting.geometry.fit import projection_sigma_px
from udccal.fitting.psf.fit import fit_psf
from udccal.fitting.psf.start import read_psf
from udccal.models.geometry import project_directions
from udccal.models.psf import PsfField, psf_kernels
from udccal.models.wire import wire_values
from udccal.numerics import in_float64
from udccal.planning.state import sensor_samples
from udccal.reports.true_values import true_values
from udccal.rig import load_rig
from udccal.sessions.schema import TermName
from udccal.sessions.store import Session
from udccal.simulation import backscatter, wire
from udccal.simulation.psf import kernels
from udccal.simulation.sensor import Sensor
from udccal.simulation.truth import RigTruth, draw_truth, pixels_to_directions
from udccal.simulation.world import SimulatedWorld

_RIG = "lg55-reduced"
_INSIDE, _LEAST = 1.96, 0.90
_RAYS, _PIXELS = 17, 2000
# Rows and columns of the kernel about its source.
_WINDOW = (33, 17)
_PICTURES = (9101, 9102, 9103)
_PAGE = Path(__file__).resolve().parents[2] / "docs" / "numerics.md"


@final
@dataclass(frozen=True)
class Specimen:
    """A rig as it really is, its session, and the fits that others stand on."""

    truth: RigTruth
    session: Session
    base: Foundation


@final
@dataclass(frozen=True)
class Coverage:
    """z-scores of one quantity over the rigs, and the fraction of them inside the 95 % interval."""

    name: str
    by_rig: tuple[Float[np.ndarray, " n"], ...]

    @property
    def inside(self) -> float:
        """Of all rigs together, each counted alike."""
        return float(np.mean([np.mean(np.abs(z) < _INSIDE) for z in self.by_rig]))

    @property
    def worst(self) -> float:
        """Of the rig that holds least."""
        return float(min(np.mean(np.abs(z) < _INSIDE) for z in self.by_rig))

    @property
    def z_rms(self) -> float:
        """RMS of z; 1 where errors are as large as their sigma."""
        return float(np.sqrt(np.mean([np.mean(z**2) for z in self.by_rig])))

    @property
    def ok(self) -> bool:
        """Whether the interval holds what it should."""
        return self.inside >= _LEAST


def sensor_numbers(rig: Specimen) -> Float[np.ndarray, " n"]:
    """K, dark noise, black level, dark current and the rest; a number without an interval does not count as inside."""
    found = {estimate.name: estimate for estimate in rig.base.noise.estimates if estimate.sigma > 0}
    true = [one for one in true_values(rig.truth) if one.term == "noise" and one.name in found]
    return np.array([one.error_of(found[one.name].value) / found[one.name].sigma for one in true])


@in_float64
def rays(rig: Specimen) -> Float[np.ndarray, " n"]:
    """Where rays of the panel land, by axis."""
    pixels = sensor_samples(rig.session.rig, _RAYS)
    directions = pixels_to_directions(rig.truth.optics, pixels)
    error = np.asarray(project_directions(rig.base.geometry.term, directions)) - pixels
    return (error / projection_sigma_px(rig.base.geometry, pixels)).ravel()


def wire_pixels(rig: Specimen) -> Float[np.ndarray, " n"]:
    """The wire's map at random pixels."""
    true = wire.wire_map(rig.truth)
    y, x = np.divmod(np.random.default_rng(rig.truth.seed).choice(true.size, _PIXELS, replace=False), true.shape[1])
    error = (rig.base.wire_map - true)[y, x]
    pixels = np.stack([x, y], axis=-1).astype(np.float64)
    return error / rig.base.wire.sigma_of(lambda term: _wire_values(term, pixels, *true.shape))


_wire_values = jax.jit(wire_values, static_argnums=(2, 3))


def new_pictures(rig: Specimen) -> Float[np.ndarray, " n"]:
    """Light of pictures that were not shown, as a capture of them would read in bins.

    A mask holds the unequal response of its pixels, and rates are in electrons by the fitted gain.
    """
    session, geometry = rig.session, rig.base.geometry.term
    fit = fit_backscatter(
        read_backscatter(session, rig.base.noise.term, geometry, rig.base.wire_map), geometry, session.rig
    ).or_raise()
    panel, camera, step = session.rig.panel, session.rig.camera, fit.term.step
    flat = sampled_rays(geometry, session.rig, step, FitEffort().backscatter_positions)[1]
    pictures = [face_picture(seed, panel.columns, panel.rows) for seed in _PICTURES]
    model_error = next(one.value for one in fit.diagnostics if one.name == "model_error_of_white")
    light = predicted_light(fit.term, fit, model_error, session.rig, pictures, flat)
    scatter, bins = backscatter.backscatterer(rig.truth), Bins(camera.cfa, step)
    gain = rig.truth.sensor.K_DN_per_e / float(np.asarray(rig.base.noise.term.K_DN_per_e))
    response = gain * Sensor(rig.truth).response.astype(np.float64)
    true = np.stack([bins.mean(response * scatter.rate(one)).reshape(3, -1)[:, flat] for one in pictures])
    return ((light.rate - true) / light.sigma).ravel()


@in_float64
def kernel_samples(rig: Specimen) -> Float[np.ndarray, " n"]:
    """The psf where no LED was, fitted from the session as a calibration does; a sample of known value has no sigma."""
    session, base, rules = rig.session, rig.base, FitEffort().psf
    geometry, wire_term = base.geometry.term, base.wire.term
    data = read_psf(session, base.noise.term, base.wire_map, rules)
    fit = fit_psf(data, session.rig, geometry, wire_term, rules).or_raise()
    places = held_out_positions(rig.truth)

    def kernels_of(term: PsfField) -> Float[np.ndarray, "n 3 rows columns"]:
        return np.asarray(psf_kernels(term, places, *_WINDOW))

    error, sigma = kernels_of(fit.term) - kernels(rig.truth, places, *_WINDOW), fit.sigma_of(kernels_of)
    return (error[sigma > 0] / sigma[sigma > 0]).ravel()


QUANTITIES: tuple[tuple[str, Callable[[Specimen], Float[np.ndarray, " n"]]], ...] = (
    ("noise: the sensor's numbers", sensor_numbers),
    ("geometry: where rays of the panel land", rays),
    ("wire: the map at random pixels", wire_pixels),
    ("psf: samples of the kernel where no LED was", kernel_samples),
    ("backscatter: light of new pictures", new_pictures),
)


def specimen(seed: int, folder: Path) -> Specimen:
    """Capture a rig in simulation (what the folder holds already is kept)."""
    rig = load_rig(_RIG)
    truth = draw_truth(rig, seed)
    with simulated_bench(SimulatedWorld(truth, seed=seed)) as bench:
        capture(folder, bench, get_args(TermName))
    session = Session.open(folder)
    return Specimen(truth, session, fit_foundation(session))


def table(found: list[Coverage]) -> str:
    """As Markdown."""
    head = [
        "| quantity | inside the 95 % interval | of the worst rig | z, RMS | rigs | |",
        "| --- | ---: | ---: | ---: | ---: | --- |",
    ]
    body = [
        f"| {one.name} | {one.inside:.1%} | {one.worst:.1%} | {one.z_rms:.2f} | {len(one.by_rig)} | "
        f"{'ok' if one.ok else '**missed**'} |"
        for one in found
    ]
    return "\n".join(head + body)


def main() -> int:
    """The exit status is 0 when every interval holds what it should."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("coverage"), help="folder for sessions")
    parser.add_argument("--rigs", type=int, default=6, help="specimens of the rig")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    keep_compilations()
    scores: list[list[Float[np.ndarray, " n"]]] = [[] for _ in QUANTITIES]
    for seed in range(1, options.rigs + 1):
        one = specimen(seed, options.out / f"rig-{seed}")
        for part, (name, z_of) in zip(scores, QUANTITIES, strict=True):
            part.append(z_of(one))
            print(f"rig {seed}, {name}: {np.mean(np.abs(part[-1]) < _INSIDE):.1%} inside", flush=True)
    found = [Coverage(name, tuple(part)) for (name, _), part in zip(QUANTITIES, scores, strict=True)]
    print(table(found))
    put_table(_PAGE, "coverage", table(found))
    return 0 if all(one.ok for one in found) else 1


if __name__ == "__main__":
    sys.exit(main())
