"""What a user would take instead of a tier: the same frames, profile and view, by other libraries.

Each is given more than it would have: the profile's black level, wire map and view, and those that deblur also the
exact light of the panel and the kernels of each tile. A strength that has to be chosen is the one that is best for the
mean of all scenes, which a user could not know.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32
from skimage import restoration as skimage

from tests.benchmarks.pareto.groups import Group
from tests.benchmarks.pareto.restoring import Taken
from tests.benchmarks.pareto.runs import Run, Sight, mean_dB, of_group
from tests.benchmarks.rows import Row, at_least
from udccal.restoration.kernel_grid import interpolated_kernels
from udccal.restoration.linear import to_electrons
from udccal.restoration.metrics import psnr
from udccal.restoration.runtime import Restorer
from udccal.tiers import Tier

Rgb = Float32[np.ndarray, "rows columns 3"]
Plane = Float32[np.ndarray, "rows columns"]
_EDGE_AWARE = {
    "RGGB": cv2.COLOR_BayerBG2RGB_EA,
    "BGGR": cv2.COLOR_BayerRG2RGB_EA,
    "GRBG": cv2.COLOR_BayerGB2RGB_EA,
    "GBRG": cv2.COLOR_BayerGR2RGB_EA,
}
# Of He, Sun and Tang, "Single image haze removal using dark channel prior", CVPR 2009.
_PATCH_PX, _KEPT_HAZE, _LEAST_TRANSMISSION, _BRIGHTEST = 15, 0.95, 0.1, 0.001
_BALANCES, _ITERATIONS = (0.003, 0.01, 0.03, 0.1), (5, 10)


@dataclass(frozen=True)
class Instead:
    """One way, and how strongly it works; ways of one name differ in strength alone."""

    name: str
    restore: Callable[[Restorer, Taken], Rgb]


@dataclass(frozen=True)
class Peer:
    """What a way gives: dB of each scene, and its median time; no scenes where it was not run.

    Attributes:
        name: of the way.
        dB: by scene.
        ms: of a frame, from raw to linear light.
    """

    name: str
    dB: tuple[float, ...]
    ms: float


def ways() -> list[Instead]:
    """All of them."""
    return [
        Instead("OpenCV: demosaic, divide by the wire, remap", _divided),
        Instead("the same, and dark-channel dehazing", lambda restorer, taken: _dehazed(_divided(restorer, taken))),
        *(Instead("scikit-image: Wiener per tile", _by_tiles(_wiener(balance))) for balance in _BALANCES),
        *(Instead("scikit-image: Richardson–Lucy per tile", _by_tiles(_richardson_lucy(n))) for n in _ITERATIONS),
    ]


def peers_of(restorer: Restorer, sights: Sequence[Sight]) -> list[Peer]:
    """Measure every way on some sights; of those that differ in strength, the best is kept.

    Args:
        restorer: of the tier fast: it has the view, the wire, the panel's light and the kernels.
        sights: of the nineteen, the panel's picture known.
    """
    best: dict[str, Peer] = {}
    for way in ways():
        dB, ms = [], []
        for sight in sights:
            start = time.perf_counter()
            linear = way.restore(restorer, sight.taken)
            ms.append(1e3 * (time.perf_counter() - start))
            dB.append(psnr(sight.after(linear), sight.truth))
        found = Peer(way.name, tuple(dB), statistics.median(ms))
        if way.name not in best or np.mean(dB) > np.mean(best[way.name].dB):
            best[way.name] = found
    return list(best.values())


def peer_rows(peers: Iterable[Peer], runs: Sequence[Run], scenes: Iterable[str]) -> list[Row]:
    """For every peer: how many dB the best tier that is no slower gains on it; one that was not run has lost nothing.

    Args:
        peers: measured on some scenes of the nineteen.
        runs: of every tier.
        scenes: names of these scenes.
    """
    some = set(scenes)
    of_tier = {tier: [run for run in of_group(runs, Group.nineteen, tier) if run.scene in some] for tier in Tier}
    rows = []
    for peer in peers:
        if not peer.dB:
            rows.append(Row(f"'{peer.name}' was not run", float("nan"), 0.0, "dB", True))
            continue
        quicker = [own for own in of_tier.values() if statistics.median(run.ms for run in own) <= peer.ms]
        gain = max((mean_dB(own) for own in quicker), default=-np.inf) - float(np.mean(peer.dB))
        rows.append(at_least(f"a tier no slower than '{peer.name}' is better by", gain, 0.0, "dB"))
    return rows


def peer_table(peers: Iterable[Peer]) -> str:
    """As Markdown."""
    lines = ["| instead | dB | worst scene | ms |", "| --- | ---: | ---: | ---: |"]
    for peer in peers:
        numbers = f"{np.mean(peer.dB):.2f} | {min(peer.dB):.2f} | {peer.ms:.0f}" if peer.dB else "not run | | "
        lines.append(f"| {peer.name} | {numbers} |")
    return "\n".join(lines)


def _divided(restorer: Restorer, taken: Taken) -> Rgb:
    """The frame over the wire, demosaiced by OpenCV, on the view."""
    signal = to_electrons(taken.frame[restorer.rows], restorer.noise, taken.exposure_s)
    if restorer.wire is not None:
        signal /= restorer.wire
    picture = demosaiced(signal, restorer.rig.camera.cfa) / np.float32(taken.exposure_s)
    return restorer.rectification.from_row(restorer.rows.start).apply(picture)


def demosaiced(signal: Plane, cfa: str) -> Rgb:
    """By OpenCV in 16 bits; its edge-aware way leaves the outermost samples black, so there are more of them."""
    most = max(float(signal.max()), 1.0)
    codes = np.clip(signal * (65535 / most), 0, 65535).astype(np.uint16)
    wide = cv2.copyMakeBorder(codes, 2, 2, 2, 2, cv2.BORDER_REFLECT_101)
    return cv2.cvtColor(wide, _EDGE_AWARE[cfa])[2:-2, 2:-2] * np.float32(most / 65535)


def _dehazed(picture: Rgb) -> Rgb:
    """A picture less its haze, by the dark channel; the transmission is refined by a guided filter."""
    patch = np.ones((_PATCH_PX, _PATCH_PX), np.uint8)
    darkest = cv2.erode(picture.min(axis=2), patch)
    hazy = picture[darkest >= np.quantile(darkest, 1 - _BRIGHTEST)]
    airlight = np.maximum(hazy[hazy.sum(axis=1).argmax()], np.float32(1e-6))
    rough = 1 - np.float32(_KEPT_HAZE) * cv2.erode((picture / airlight).min(axis=2), patch)
    guide = picture.mean(axis=2) / np.float32(picture.max())
    fine = cv2.ximgproc.guidedFilter(guide, rough, 4 * _PATCH_PX, 1e-3)
    return (picture - airlight) / np.maximum(fine, np.float32(_LEAST_TRANSMISSION))[..., None] + airlight


def _wiener(balance: float) -> Callable[[Plane, Plane], Plane]:
    return lambda tile, kernel: skimage.wiener(tile, kernel, balance, clip=False)


def _richardson_lucy(iterations: int) -> Callable[[Plane, Plane], Plane]:
    return lambda tile, kernel: skimage.richardson_lucy(
        np.maximum(tile, 1e-4), np.maximum(kernel, 0), iterations, clip=False, filter_epsilon=1e-6
    )


def _by_tiles(deblur: Callable[[Plane, Plane], Plane]) -> Callable[[Restorer, Taken], Rgb]:
    """Deblur each colour of each tile by its own kernel, after the panel's light is taken off."""

    def restore(restorer: Restorer, taken: Taken) -> Rgb:
        assert restorer.sharpener is not None
        layout = restorer.sharpener.layout
        signal = restorer.scene_light(taken.frame, taken.exposure_s, taken.panel_picture).signal_e
        most = float(signal.max())
        planes = cv2.split(demosaiced(signal, restorer.rig.camera.cfa) / np.float32(most))
        kernels = interpolated_kernels(restorer.sharpener.grid, layout.centres_px)
        tiles = np.empty((layout.count, layout.rows, layout.columns, len(planes)), dtype=np.float32)
        for colour, plane in enumerate(planes):
            for index, (tile, kernel) in enumerate(zip(layout.tiles(plane), kernels[:, colour], strict=True)):
                tiles[index, ..., colour] = deblur(tile, kernel)
        picture = layout.join(tiles) * np.float32(most / taken.exposure_s)
        return restorer.rectification.from_row(restorer.sharpener.rows.start).apply(picture)

    return restore
