"""What each stage of restoration costs: the truth stands in for every stage but one.

    python -m tests.benchmarks.budget [--out DIR] [--rig NAME] [--profile PROFILE] [--seed N] [--every N]

A scene's light passes the simulated panel, and noise is added. The reference knows the true wire, the true backscatter
and the true kernel at every place, has all three colours at every pixel, no limit to its range, and is judged on the
sensor, where the view looks, away from its borders. Then one stage after another becomes what the product has. Noise
stays in all rows but its own, since the filter's strength follows from it. Writes DIR/budget.json and the table of
docs/restoration.md.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float32

from tests.benchmarks.full_blur import BLUR_GRID, FullBlur, build_full_blur
from tests.benchmarks.pictures import DISTANCE_MM, WIDTH_MM, PictureBench, Shot
from tests.benchmarks.readme_tables import put_table
from tests.benchmarks.scenes import Scene, shared_scenes
from udccal.arrangements import Photograph
from udccal.cfa import cfa_named
from udccal.profiles.profile import Profile
from udccal.profiles.store import load_profile
from udccal.restoration.backscatter import PanelLight
from udccal.restoration.colour_tables import THREE_COLOURS, colour_tables
from udccal.restoration.demosaic import demosaic
from udccal.restoration.filter_tables import filter_tables
from udccal.restoration.kernel_grid import KernelGrid, interpolated_kernels
from udccal.restoration.linear import variance_e2
from udccal.restoration.metrics import encode_srgb, least_squares_gain, psnr
from udccal.restoration.mosaic_filter import Pattern, Tables, filtered_and_joined
from udccal.restoration.plan import PlanOptions, kernel_grid
from udccal.restoration.runtime import Restorer
from udccal.restoration.shrink import BandNoise, measured_noise, shrunk
from udccal.restoration.tiles import TileLayout, layout_for
from udccal.rig import load_rig
from udccal.simulation.backscatter import backscatter_rate
from udccal.simulation.scene import WHITE_E_PER_S, render_photograph
from udccal.simulation.truth import RigTruth, draw_truth
from udccal.simulation.wire import wire_map
from udccal.tiers import Tier

_PAGE = Path(__file__).resolve().parents[2] / "docs" / "restoration.md"
_WORKERS, _TILE = 2, PlanOptions.tile_rows
# Samples from the borders that are not judged, but in the row of the borders.
_INNER = 64

Rgb = Float32[np.ndarray, "rows columns 3"]


@dataclass(frozen=True)
class Knowledge:
    """What a restoration knows; the product's where a field is True, the truth's elsewhere."""

    noise: bool = True
    wire: bool = False
    backscatter: bool = False
    kernels: bool = False
    nodes: bool = False
    mosaic: bool = False
    range: bool = False
    borders: bool = False


REFERENCE = Knowledge()
ROWS = {
    "wire": replace(REFERENCE, wire=True),
    "backscatter": replace(REFERENCE, backscatter=True),
    "kernels": replace(REFERENCE, kernels=True),
    "kernels between nodes": replace(REFERENCE, nodes=True),
    "one colour per pixel": replace(REFERENCE, mosaic=True),
    "saturation": replace(REFERENCE, range=True),
    "borders": replace(REFERENCE, borders=True),
}


@dataclass(frozen=True)
class Filter:
    """A tile filter made ready for one set of kernels and one pattern of colours."""

    pattern: Pattern
    layout: TileLayout
    tables: Tables
    noise: BandNoise

    @classmethod
    def of(cls, grid: KernelGrid, pattern: Pattern, rows: int, columns: int) -> Filter:
        layout = layout_for(rows, columns, (pattern.rows, pattern.columns), (_TILE, _TILE), (0, rows))
        whole = pattern is THREE_COLOURS
        tables = colour_tables(grid, layout, _WORKERS) if whole else filter_tables(grid, layout, pattern, _WORKERS)
        return cls(pattern, layout, tables, measured_noise(tables, layout, pattern, _WORKERS))

    def restored(self, light_e: Rgb, variance: Rgb) -> Rgb:
        """The picture in e-; of the light and its variance, only what the pattern samples is used."""
        tiles, spread = (self._cut(each) for each in (light_e, variance))
        noise_e = np.sqrt(np.maximum(spread.mean(axis=(2, 3)), 1e-6)).astype(np.float32)
        if self.pattern.rows > 1:
            channels = np.empty(tiles.shape[2:], dtype=int)
            for site in self.pattern.sites:
                channels[site.samples] = site.channel
            tiles = np.take_along_axis(tiles, channels[None, None], axis=1)[:, 0]
        given = self.tables, self.layout, self.pattern
        picture, strengths = filtered_and_joined(tiles, noise_e, *given)
        local = cv2.blur(variance.mean(axis=2), (16, 16))
        bands = self.noise.of_tiles(strengths)
        return shrunk(picture, noise_e, local, bands, self.layout, _WORKERS)

    def _cut(self, planes: Rgb) -> Float32[np.ndarray, "tiles 3 tile_rows tile_columns"]:
        return np.stack([self.layout.cut(np.ascontiguousarray(plane)) for plane in cv2.split(planes)], axis=1)


@dataclass(frozen=True)
class View:
    """A scene as the sensor's pixels see it, in e- and without wire: sharp, blurred, and the panel's true and stated
    light.

    Attributes:
        white_e: what display white gives.
    """

    ideal_e: Rgb
    seen_e: Rgb
    panel_e: Rgb
    stated_e: Rgb
    white_e: float
    exposure_s: float


class Budget:
    """The rig as it is and as its profile says, and scenes restored with parts of either."""

    def __init__(
        self,
        truth: RigTruth,
        blur: FullBlur,
        restorer: Restorer,
        panel: PanelLight,
        kernels: KernelGrid,
        wire: Float32[np.ndarray, "rows columns"],
    ) -> None:
        camera = truth.description.camera
        self._truth, self._blur, self._restorer, self._panel = truth, blur, restorer, panel
        self._size, self._cfa = (camera.rows, camera.columns), cfa_named(camera.cfa)
        self._wire, self._stated_wire = wire_map(truth).astype(np.float32), wire
        true = true_kernels(blur)
        nodes = np.stack(np.meshgrid(kernels.x_px, kernels.y_px), axis=-1).reshape(-1, 2)
        shape = len(kernels.y_px), len(kernels.x_px)
        at_nodes = interpolated_kernels(true, nodes)
        self._grids = {
            (False, False): true,
            (False, True): KernelGrid(kernels.x_px, kernels.y_px, at_nodes.reshape(*shape, *at_nodes.shape[1:])),
            (True, False): kernels,
        }
        self._filters: dict[tuple[bool, bool, bool], Filter] = {}

    def costs_dB(self, scene: Scene, shot: Shot, bench: PictureBench, room_light: float) -> dict[str, float]:
        """What every stage costs, and the PSNR of the reference."""
        photograph, exposure_s = Photograph(scene.radiance, WIDTH_MM, DISTANCE_MM), bench.exposure_s(shot, room_light)
        blurred = render_photograph(self._truth, photograph, self._blur)
        scale = room_light * exposure_s * float(shot.scene_rate.sum() / (self._mosaic(blurred) * self._wire).sum())
        picture = bench.pictures[shot.picture]
        view = View(
            ideal_e=(scale * render_photograph(self._truth, photograph)).astype(np.float32),
            seen_e=(scale * blurred).astype(np.float32),
            panel_e=self._planes(backscatter_rate(self._truth, picture)) * np.float32(exposure_s),
            stated_e=self._planes(self._panel.rate(picture)) * np.float32(exposure_s),
            white_e=room_light * WHITE_E_PER_S * exposure_s,
            exposure_s=exposure_s,
        )
        sharp = self._restored(view, REFERENCE)
        reference = self._judged(sharp, view, REFERENCE)

        def cost(known: Knowledge) -> float:
            return reference - self._judged(self._restored(view, known), view, known)

        resampled = self._restorer.rectification.apply(sharp)
        return {
            "reference": reference,
            "noise": -cost(replace(REFERENCE, noise=False)),
            **{name: cost(known) for name, known in ROWS.items()},
            "geometry and view": reference - _dB(resampled, shot.ideal * np.float32(view.white_e), view.white_e),
            "all of them": reference - bench.score(shot, room_light).after_dB,
        }

    def _restored(self, view: View, known: Knowledge) -> Rgb:
        own = self._restorer
        signal = (view.seen_e + view.panel_e) * self._wire[..., None]
        variance = np.stack([variance_e2(plane, own.noise, view.exposure_s) for plane in cv2.split(signal)], axis=2)
        rng = np.random.default_rng(0xB0D6E7)
        if known.noise:
            signal = signal + np.sqrt(variance) * rng.standard_normal(signal.shape, dtype=np.float32)
        if known.range:
            signal = np.minimum(signal, np.float32(self._truth.sensor.full_well_e))
        wire = self._stated_wire if known.wire else self._wire
        light = signal / wire[..., None] - (view.stated_e if known.backscatter else view.panel_e)
        return self._filter(known).restored(light, variance / wire[..., None] ** 2)

    def _filter(self, known: Knowledge) -> Filter:
        key = known.kernels, known.nodes, known.mosaic
        if key not in self._filters:
            pattern = self._cfa if known.mosaic else THREE_COLOURS
            self._filters[key] = Filter.of(self._grids[key[:2]], pattern, *self._size)
        return self._filters[key]

    def _judged(self, picture: Rgb, view: View, known: Knowledge) -> float:
        """On the part of the sensor that the product's view looks at."""
        far = 0 if known.borders else _INNER
        at = self._restorer.rectification
        part = tuple(
            slice(max(int(np.min(seen)), far), min(int(np.max(seen)) + 1, most - far))
            for seen, most in zip((at.map_y, at.map_x), self._size, strict=True)
        )
        return _dB(picture[part], view.ideal_e[part], view.white_e)

    def _mosaic(self, light: np.ndarray) -> np.ndarray:
        channels = self._cfa.channel_map(*self._size)
        return np.take_along_axis(light, channels[..., None], axis=2)[..., 0]

    def _planes(self, mosaic: np.ndarray) -> Rgb:
        """Three colours at every sample: the panel's light is smooth."""
        return demosaic(mosaic.astype(np.float32), self._restorer.rig.camera.cfa)


def _dB(linear: Rgb, ideal: Rgb, white: float) -> float:
    """PSNR as displayed, with the least-squares gain per channel as every table has it."""
    gain = least_squares_gain(np.clip(linear, 0.0, white), np.minimum(ideal, white))
    return psnr(encode_srgb(linear * gain / white), encode_srgb(ideal / white))


def true_kernels(blur: FullBlur) -> KernelGrid:
    """The kernels of the simulated blur at its own nodes; the ripple of interference is left out."""
    mean = blur.mean
    kernels = np.einsum("crij,ryx->yxcij", mean.components, mean.coefficients, optimize=True)
    return KernelGrid(mean.grid_x_px, mean.grid_y_px, kernels / kernels.sum(axis=(3, 4), keepdims=True))


def main() -> int:
    """Run the benchmark and write its table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("budget"), help="folder for budget.json")
    parser.add_argument("--rig", default="lg55-reduced")
    parser.add_argument("--profile", help="default: the rig's")
    parser.add_argument("--seed", type=int, default=0, help="specimen of the rig, which the profile is of")
    parser.add_argument("--every", type=int, default=1, help="every n-th scene")
    options = parser.parse_args()
    data = Path(__file__).resolve().parents[3] / "shared" / "data"
    if not data.is_dir():
        print("The shared photographs (../shared/data) are absent: there is nothing to restore.", file=sys.stderr)
        return 1
    truth, profile = draw_truth(load_rig(options.rig), options.seed), load_profile(options.profile or options.rig)
    captures = truth.description.captures
    blur = build_full_blur(truth, *BLUR_GRID, captures.psf_region_rows + 1, captures.psf_region_columns + 1)
    found = measured(truth, blur, profile, list(shared_scenes(data, options.every)))
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "budget.json").write_text(json.dumps(found, indent=1))
    put_table(_PAGE, f"budget {options.rig}", summary(found))
    return 0


def measured(truth: RigTruth, blur: FullBlur, profile: Profile, scenes: list[Scene]) -> dict[str, dict[str, float]]:
    """What every stage costs in dB, and the PSNR of the reference, by scene."""
    restorer = Restorer.from_profile(profile, Tier.balanced)
    panel = PanelLight.of(profile.backscatter.term, profile.rig)
    kernels, wire = kernel_grid(profile.psf.term, profile.rig, PlanOptions()), profile.wire_map
    budget = Budget(truth, blur, restorer, panel, kernels, np.asarray(wire, dtype=np.float32))
    bench = PictureBench(truth, blur, restorer)
    shots = bench.shots(scenes)
    light, found = bench.matched_room_light(shots), dict[str, dict[str, float]]()
    for scene, shot in zip(scenes, shots, strict=True):
        found[shot.name] = budget.costs_dB(scene, shot, bench, light)
        print(shot.name, {name: round(value, 2) for name, value in found[shot.name].items()}, flush=True)
    return found


def summary(found: dict[str, dict[str, float]]) -> str:
    """The table: every stage's median and worst cost."""
    lines = [f"Of {len(found)} scenes:", "", "| stage | median dB | worst dB | scene |", "| --- | ---: | ---: | --- |"]
    for name in next(iter(found.values())):
        values = {scene: costs[name] for scene, costs in found.items()}
        worst = min(values, key=values.__getitem__) if name == "reference" else max(values, key=values.__getitem__)
        lines.append(f"| {name} | {np.median(list(values.values())):.2f} | {values[worst]:.2f} | {worst} |")
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
