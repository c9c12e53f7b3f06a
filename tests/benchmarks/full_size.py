"""`make full-size`: time and memory of a full-size frame at each tier. Puts the table into docs/restoration.md.

    python -m tests.benchmarks.full_size

The profile is the shipped one of lg55-reduced with its terms on the sensor of lg55-aca2040, and with the kernels of
that rig's nominal numbers: they are as large as measured ones. The frame is simulated. Each tier runs in a process of
its own, from the raw frame in memory to 8 bits in memory; the first start of the tier fast computes what later ones
read. Exits with 1 where a number misses its limit. Nothing else should run meanwhile.
"""

from __future__ import annotations

import multiprocessing
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from tests.benchmarks.frame_cost import Cost, cost_of
from tests.benchmarks.pareto.restoring import Taken
from tests.benchmarks.readme_tables import put_table
from tests.benchmarks.rows import Row, at_most, table
from udccal.benches.bench import simulated_rig
from udccal.benches.photograph import capture_photograph
from udccal.displays.pictures import face_picture
from udccal.fitting.psf.fit import nominal_psf
from udccal.profiles.profile import Profile
from udccal.profiles.store import load_profile
from udccal.restoration.runtime import Restorer
from udccal.rig import RigDescription, load_rig
from udccal.tiers import Tier

_PAGE: Final = Path(__file__).resolve().parents[2] / "docs" / "restoration.md"
_RIG, _SHIPPED, _SEED = "lg55-aca2040", "lg55-reduced", 3
_LIMITS_MS: Final = {Tier.preview: 33.0, Tier.fast: 150.0, Tier.balanced: 400.0, Tier.accurate: 20e3}
_FAST_MIB, _FIRST_START_S, _START_S = 700.0, 30.0, 4.0


def full_size_profile(rig: RigDescription) -> Profile:
    """The shipped profile on a larger sensor of the same shape, with nominal kernels.

    Args:
        rig: of the larger sensor.
    """
    small = load_profile(_SHIPPED)
    camera, term, light = rig.camera, small.geometry.term, small.backscatter.term
    factor = camera.columns // small.rig.camera.columns
    geometry = replace(
        term,
        focal_px=np.asarray(term.focal_px) * factor,
        principal_point_px=(np.asarray(term.principal_point_px) + 0.5) * factor - 0.5,
    )
    halves = camera.columns // 2, camera.rows // 2
    light = replace(light, geometry=geometry, columns=camera.columns, rows=camera.rows, step=factor * light.step)
    return replace(
        small,
        rig=rig,
        geometry=replace(small.geometry, term=geometry),
        psf=replace(small.psf, term=nominal_psf(rig, geometry, small.wire.term)),
        backscatter=replace(small.backscatter, term=light),
        wire_map=cv2.resize(small.wire_map, (camera.columns, camera.rows)),
        backscatter_mask=cv2.resize(small.backscatter_mask, halves),
    )


def taken_by(profile: Profile) -> Taken:
    """A drawn face in front of the simulated rig."""
    rig = profile.rig
    radiance = (face_picture(_SEED, 1024, 768) / 255.0) ** 2.2
    shown = face_picture(_SEED + 1, rig.panel.columns, rig.panel.rows)
    view = Restorer.from_profile(profile, Tier.preview).view
    shot = capture_photograph(simulated_rig(rig, _SEED), radiance, view, shown)
    return Taken(shot.mosaic, shot.exposure_s, shown)


def rows_of(first: Cost, later: dict[Tier, Cost]) -> list[Row]:
    """Each tier's time, and what starts of the tier fast take, against their limits.

    Args:
        first: of the tier fast, where nothing is prepared.
        later: of each tier, where all is.
    """
    rows = [at_most(f"{tier}, a frame", cost.frame_ms, _LIMITS_MS[tier], "ms") for tier, cost in later.items()]
    fast = later[Tier.fast]
    return [
        *rows,
        at_most("fast, peak memory of a process that does nothing else", fast.peak_MiB, _FAST_MIB, "MiB"),
        at_most("fast, first start to first picture", first.start_s, _FIRST_START_S, "s"),
        at_most("fast, second start to first picture", fast.start_s, _START_S, "s"),
    ]


def main() -> int:
    """Measure each tier; the exit status is 0 when every number keeps its limit."""
    profile = full_size_profile(load_rig(_RIG))
    taken = taken_by(profile)
    with tempfile.TemporaryDirectory() as folder:

        def cost(tier: Tier) -> Cost:
            with multiprocessing.get_context("spawn").Pool(1) as pool:
                return pool.apply(cost_of, (profile, taken, tier, Path(folder)))

        first = cost(Tier.fast)
        cost(Tier.accurate)  # prepares the rest
        rows = rows_of(first, {tier: cost(tier) for tier in Tier})
    print(table(rows))
    put_table(_PAGE, "full size", table(rows))
    return 0 if all(row.ok for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
