"""Frames restored on a device of JAX, from raw to 8 bit, beside the numpy path.

    python -m tests.benchmarks.device [--device gpu|cpu] [--rig NAME] [--frames N] [--every N]

Prints milliseconds of a frame with transfers (median of warm frames), seconds of compilation, the difference from the
numpy path in codes of 8 bits, and the bytes of the filters' tables; also with tables that are rounded to 16 bits, whose
bytes are those that they would take. On a GPU it writes the table into docs/restoration.md.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex64

from tests.benchmarks.pictures import PictureBench
from tests.benchmarks.readme_tables import put_table
from tests.benchmarks.scenes import shared_scenes
from udccal.profiles.store import load_profile
from udccal.restoration.device.restorer import DeviceRestorer
from udccal.restoration.prepared import prepared_folder
from udccal.restoration.runtime import Restorer
from udccal.restoration.tone import Tone
from udccal.rig import load_rig
from udccal.simulation.blur import build_blur
from udccal.simulation.scene import WHITE_E_PER_S
from udccal.simulation.truth import draw_truth
from udccal.tiers import Tier

_PAGE = Path(__file__).resolve().parents[2] / "docs" / "restoration.md"
_TIERS = (Tier.fast, Tier.balanced, Tier.accurate)
_KINDS = ("float32", "bfloat16", "float16")
# Of the room: about that at which the scenes of `make accuracy` have 21.5 dB before restoration.
_LIGHT = 0.2
# Columns and rows of the grid of kernels, and their size: the blur of the scene need not be exact.
_BLUR = (3, 2, 129, 33)


@dataclass(frozen=True)
class Frame:
    """A raw frame, and what it is restored with."""

    mosaic: np.ndarray
    exposure_s: float
    tone: Tone
    panel_picture: np.ndarray


def main() -> int:
    """Measure as the command line says."""
    options = _options()
    return measure(options.device, options.rig, options.rig, options.frames, options.every)


def measure(backend: str, rig: str, profile_name: str, frames_timed: int = 20, every: int = 6) -> int:
    """Measure on a backend of JAX; the exit status is 0 also where there is no device to measure on.

    Args:
        backend: gpu or cpu. rig: a rig's name. profile_name: name or folder of its profile.
        frames_timed: warm frames that are timed. every: use each n-th scene only.
    """
    try:
        device = jax.devices(backend)[0]
    except RuntimeError:
        print(f"JAX finds no device '{backend}' here, so nothing is measured.")
        return 0
    data = Path(__file__).resolve().parents[3] / "shared" / "data"
    if not data.is_dir():
        print("The shared photographs (../shared/data) are absent: there is nothing to restore.", file=sys.stderr)
        return 1
    truth, profile = draw_truth(load_rig(rig), 0), load_profile(profile_name)
    keep = prepared_folder()
    restorers = [Restorer.from_profile(profile, tier, keep=keep) for tier in _TIERS]
    bench = PictureBench(truth, build_blur(truth, *_BLUR), restorers[0])
    frames = [
        Frame(
            bench.frame(shot, _LIGHT),
            bench.exposure_s(shot, _LIGHT),
            Tone(1 / (_LIGHT * WHITE_E_PER_S)),
            bench.pictures[shot.picture],
        )
        for shot in bench.shots(shared_scenes(data, every))
    ]
    lines = [
        "| tier | tables | frame ms | frame CPU ms | first frame s | most codes off | RMS codes off | tables MB |",
        "| --- | --- | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    for restorer in restorers:
        lines += _measured(restorer, device, frames, frames_timed)
    print("\n".join(lines))
    if device.platform == "gpu":
        put_table(_PAGE, f"device {rig}", f"{device.device_kind}:\n\n" + "\n".join(lines))
    return 0


def _measured(restorer: Restorer, device: jax.Device, frames: list[Frame], count: int) -> list[str]:
    wall, cpu, _, expected = _timed(restorer.display, frames, count)
    size = sum(table.nbytes for table in vars(restorer.sharpener.tables).values()) if restorer.sharpener else 0
    lines = [f"| {restorer.tier} | numpy | {wall:.1f} | {cpu:.1f} | – | – | – | {size / 1e6:.1f} |"]
    whole = DeviceRestorer.of(restorer, device)
    for kind in _KINDS:
        found = whole if kind == "float32" else _rounded(whole, jnp.dtype(kind))
        wall, cpu, first, shown = _timed(found.display, frames, count)
        off = np.abs(np.array(shown, dtype=int) - np.array(expected, dtype=int))
        tables = found.stages.tiles
        saved = 0 if kind == "float32" else (tables.matched.nbytes + tables.vectors.nbytes) // 2
        lines.append(
            f"| {restorer.tier} | {kind} | {wall:.1f} | {cpu:.1f} | {first:.1f} | {off.max()} | "
            f"{np.sqrt(np.mean(off**2)):.3f} | {(_table_bytes(found) - saved) / 1e6:.1f} |"
        )
    return lines


def _table_bytes(found: DeviceRestorer) -> int:
    return sum(table.nbytes for table in jax.tree_util.tree_leaves(found.stages.tiles))


def _timed(
    display: Callable[..., np.ndarray], frames: list[Frame], count: int
) -> tuple[float, float, float, list[np.ndarray]]:
    """Return median wall and CPU ms of a warm frame, seconds of the first one, and a picture of each frame."""
    start = time.perf_counter()
    display(*vars(frames[0]).values())
    first = time.perf_counter() - start
    shown = [display(*vars(frame).values()) for frame in frames]
    # One panel picture: what a frame costs while the panel stands still.
    still = [replace(frame, panel_picture=frames[0].panel_picture) for frame in frames]
    display(*vars(still[0]).values())
    wall, cpu = [], []
    for index in range(count):
        start, busy = time.perf_counter(), time.process_time()
        display(*vars(still[index % len(still)]).values())
        wall.append(time.perf_counter() - start)
        cpu.append(time.process_time() - busy)
    return 1e3 * statistics.median(wall), 1e3 * statistics.median(cpu), first, shown


def _rounded(found: DeviceRestorer, kind: jnp.dtype) -> DeviceRestorer:
    """Round the complex tables to numbers of 16 bits; at each frequency, ``matched`` in units of its largest number."""

    def round_(table: Complex64[Array, "tiles to of y x"]) -> Complex64[Array, "tiles to of y x"]:
        most = jnp.abs(table).max(axis=(0, 1, 2))
        parts = (part.astype(kind).astype(jnp.float32) for part in ((table / most).real, (table / most).imag))
        return jax.lax.complex(*parts) * most

    stages = eqx.tree_at(lambda s: (s.tiles.matched, s.tiles.vectors), found.stages, replace_fn=round_)
    return replace(found, stages=stages)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", choices=("gpu", "cpu"), default="gpu", help="backend of JAX")
    parser.add_argument("--rig", default="lg55-reduced", help="a rig's name; its profile is the one that ships with it")
    parser.add_argument("--frames", type=int, default=20, help="warm frames that are timed")
    parser.add_argument("--every", type=int, default=6, help="use each n-th scene only")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
