"""Lamps beyond the range in drawn frames: what the picture gains where their halos are taken off.

Each frame is a photograph with up to five lamps, windows or lines of light, of 1.2 to 150 times the range, behind a
drawn kernel (a rig's, Moffat, or a core with a streak), on a drawn colour pattern. The kernel that restores is off by
3 %. ``python -m tests.benchmarks.lamps --out DIR`` writes DIR/lamps.json, a list of {name, value, limit, unit, ok}, and
the table of docs/restoration.md; it exits 1 where a limit is missed.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.signal import fftconvolve

from tests.benchmarks.readme_tables import put_table
from tests.benchmarks.rows import Row, at_least, table, write_json
from tests.benchmarks.scenes import linear_photograph
from udccal.cfa import PATTERNS, Cfa
from udccal.profiles.store import load_profile
from udccal.restoration.kernel_grid import KernelGrid
from udccal.restoration.metrics import encode_srgb, psnr
from udccal.restoration.plan import PlanOptions, kernel_grid
from udccal.restoration.sharpen import Sharpener
from udccal.rig import RigDescription, load_rig
from udccal.tiers import Tier

_ROOT = Path(__file__).resolve().parents[2]
_PAGE = _ROOT / "docs" / "restoration.md"
_SIZE = ROWS, COLUMNS = 300, 400
_READ_E, _KERNEL_ERROR = 5.0, 0.03
_RIG = "lg55-reduced"

Rgb = np.ndarray


@dataclass(frozen=True)
class Drawn:
    """A frame: its scene in e-, colour pattern, range, the true kernels, and those that restore it."""

    scene: Rgb
    cfa: Cfa
    range_e: float
    kernels: np.ndarray
    known: np.ndarray
    seed: int

    @property
    def mosaic(self) -> np.ndarray:
        """The frame in e-, with shot noise and read noise, not clipped yet."""
        pad = [(size // 2, size // 2) for size in self.kernels.shape[1:]]
        planes = [
            fftconvolve(np.pad(plane, pad, mode="symmetric"), kernel, "valid")
            for plane, kernel in zip(np.moveaxis(self.scene, 2, 0), self.kernels, strict=True)
        ]
        light = np.take_along_axis(np.array(planes), self.cfa.channel_map(*_SIZE)[None], axis=0)[0]
        rng = np.random.default_rng([0x1A4, self.seed])
        return (rng.poisson(np.maximum(light, 0)) + rng.normal(0, _READ_E, _SIZE)).astype(np.float32)


def draw(seed: int, photographs: list[Path], of_rig: KernelGrid) -> Drawn:
    """Draw a frame."""
    rng = np.random.default_rng([0x1A3, seed])
    kernels = _kernels(rng, of_rig)
    error = gaussian_filter(rng.standard_normal(kernels.shape), (0, 3, 3))
    known = kernels * (1 + _KERNEL_ERROR * error / error.std())
    cfa = PATTERNS[sorted(PATTERNS)[rng.integers(len(PATTERNS))]]
    picture = np.tile(linear_photograph(photographs[rng.integers(len(photographs))]), (2, 2, 1))
    y, x = rng.integers(100, size=2)
    range_e = rng.uniform(5e3, 2e4)
    scene = np.maximum(picture[y : y + ROWS, x : x + COLUMNS] * range_e * rng.uniform(0.3, 1.0), 1.0)
    for _ in range(rng.integers(6)):
        scene[_shape(rng)] = range_e * np.exp(rng.uniform(np.log(1.2), np.log(150)) + rng.normal(0, 0.3, 3))
    return Drawn(scene, cfa, range_e, kernels, known / known.sum(axis=(1, 2), keepdims=True), seed)


def _kernels(rng: np.random.Generator, of_rig: KernelGrid) -> np.ndarray:
    """One kernel per colour: half of them a rig's."""
    kind = rng.integers(4)
    if kind < 2:
        kernels = of_rig.kernels[rng.integers(len(of_rig.y_px)), rng.integers(len(of_rig.x_px))].astype(float)
        return kernels / kernels.sum(axis=(1, 2), keepdims=True)
    y, x = np.mgrid[-50:51, -12:13].astype(float)
    if kind == 2:
        kernel = (1 + (x**2 + y**2) / rng.uniform(0.6, 1.5) ** 2) ** -rng.uniform(2.0, 4.0)
    else:
        across, down = rng.uniform(0.5, 1.2, 2)
        core = np.exp(-(x**2) / across / 2 - y**2 / down / 2)
        tail = np.exp(-(x**2) / across / 2 - np.abs(y) / rng.uniform(4.0, 15.0))
        part = rng.uniform(0.05, 0.4)
        kernel = (1 - part) * core / core.sum() + part * tail / tail.sum()
    return np.stack([kernel / kernel.sum()] * 3)


def _shape(rng: np.random.Generator) -> np.ndarray:
    """Pixels of an ellipse or a rectangle."""
    y, x = np.mgrid[:ROWS, :COLUMNS]
    centre = rng.integers(10, ROWS - 10), rng.integers(10, COLUMNS - 10)
    high, wide = np.exp(rng.uniform(np.log(1.5), np.log(20.0), 2))
    down, across = (y - centre[0]) / high, (x - centre[1]) / wide
    inside: np.ndarray = np.hypot(down, across) < 1 if rng.random() < 0.6 else (abs(down) < 1) & (abs(across) < 1)
    return inside


@dataclass(frozen=True)
class Gained:
    """What became of a frame: dB with halos left and taken off, the same where no lamp was found."""

    left_dB: float
    off_dB: float
    found: bool


def gained(drawn: Drawn, rig: RigDescription) -> Gained:
    """Restore a frame twice with the filters of the tier ``balanced``."""
    camera = rig.camera.model_copy(update={"rows": ROWS, "columns": COLUMNS, "cfa": drawn.cfa.name})
    grid = KernelGrid(np.zeros(1), np.zeros(1), drawn.known[None, None].astype(np.float32))
    rig = rig.model_copy(update={"camera": camera})
    sharpener = Sharpener.of(grid, rig, (0, ROWS), Tier.balanced, PlanOptions())
    seen = np.minimum(drawn.mosaic, np.float32(drawn.range_e))
    variance, clipped = np.maximum(seen, 0) + np.float32(_READ_E**2), seen >= drawn.range_e
    found = sharpener.without_lamps(seen, variance, clipped)
    left = sharpener.apply(seen, variance, clipped)
    if found.white_e is None:
        return Gained(_dB(left, drawn), _dB(left, drawn), False)
    off = found.put_back(sharpener.apply(found.signal_e, variance, found.clipped), sharpener.layout.inner)
    return Gained(_dB(left, drawn), _dB(off, drawn), True)


def _dB(picture: Rgb, drawn: Drawn) -> float:
    """PSNR as displayed; white is the scene's 97th percentile, or the range."""
    white = min(float(np.percentile(drawn.scene, 97)), drawn.range_e)
    colours = list(drawn.cfa.colours)
    return psnr(encode_srgb(picture[..., colours] / white), encode_srgb(drawn.scene[..., colours] / white))


def rows_of(results: list[Gained]) -> list[Row]:
    """The rows of the table."""
    gains = np.array([each.off_dB - each.left_dB for each in results if each.found])
    some = gains.size > 0
    return [
        at_least("frames with a lamp found", gains.size, 1, "frames"),
        at_least("median gain of these", float(np.median(gains)) if some else np.nan, 0.3, "dB"),
        at_least("worst gain of these", float(gains.min()) if some else np.nan, -0.5, "dB"),
        at_least("part of these that gain", float(np.mean(gains > 0)) if some else np.nan, 0.9, ""),
    ]


def main() -> int:
    """Run the benchmark and write its table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("lamps"), help="folder for lamps.json")
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0, help="of the first frame")
    options = parser.parse_args()
    photographs = sorted((_ROOT.parent / "shared" / "data" / "photos").glob("*.png"))
    if not photographs:
        print("The shared photographs (../shared/data) are absent: there is nothing to restore.", file=sys.stderr)
        return 1
    rig, results = load_rig(_RIG), []
    of_rig = kernel_grid(load_profile(_RIG).psf.term, rig, PlanOptions())
    for seed in range(options.seed, options.seed + options.frames):
        results.append(gained(draw(seed, photographs, of_rig), rig))
        print(seed, results[-1], flush=True)
    rows = rows_of(results)
    options.out.mkdir(parents=True, exist_ok=True)
    write_json(rows, options.out / "lamps.json")
    about = f"Of {len(results)} drawn frames, seeds {options.seed} to {options.seed + len(results) - 1}:"
    put_table(_PAGE, "lamps", f"{about}\n\n{table(rows)}")
    return 0 if all(row.ok for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
