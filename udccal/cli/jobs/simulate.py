"""Simulates how a rig would see photographs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from udccal.benches.bench import simulated_rig
from udccal.benches.photograph import CapturedScene, capture_photograph
from udccal.cli.jobs.apart import check_folder_apart
from udccal.cli.jobs.panel_picture import read_panel_picture
from udccal.cli.output import Output
from udccal.errors import UdccalError
from udccal.io.out_folder import check_writable, storing_in
from udccal.io.photograph import read_photograph
from udccal.io.png import write_png16
from udccal.reports.pictures import mosaic_preview
from udccal.reports.true_values import true_geometry
from udccal.restoration.sinks import write_picture
from udccal.restoration.tone import Tone, display_exposure
from udccal.restoration.view import inscribed_view
from udccal.rig import RigDescription, load_rig


@dataclass(frozen=True)
class SimulatedFile:
    """One photograph through the rig."""

    source: Path
    mosaic: Path
    preview: Path
    ideal: Path
    exposure_s: float


@dataclass(frozen=True)
class SimulateSummary:
    """Result of ``simulate``."""

    rig: str
    seed: int
    files: tuple[SimulatedFile, ...]


def simulate_files(
    output: Output, images: list[Path], rig_name: str, out: Path, panel_picture: Path | None, seed: int
) -> None:
    """Write a raw mosaic, a preview and the ideal view of every photograph.

    Args:
        output: shows stages and results.
        images: photographs.
        rig_name: name or folder of the rig.
        out: folder of the results.
        panel_picture: picture on the panel, 8-bit RGB PNG; None for a dark panel.
        seed: chooses the specimen of the rig, and its noise.

    Raises:
        RigError: when the rig is not known.
        FileFormatError: when a photograph or the panel's picture cannot be read; this is found before any work.
        UdccalError: when the results of two photographs would have one name, or the name of a photograph.
        UdccalError: when ``out`` cannot be written to, or is in a profile or a session; this is found before any work.
    """
    check_folder_apart(out)
    check_writable(out)
    _check_names(images, out)
    rig = load_rig(rig_name)
    shown = None if panel_picture is None else read_panel_picture(panel_picture, rig)
    for image in images:  # one after another, since all at once may not fit into memory
        read_photograph(image)
    files: list[SimulatedFile] = []
    with output.stage("simulating") as stage:
        world = simulated_rig(rig, seed)
        geometry, camera = true_geometry(world.truth), rig.camera
        view = inscribed_view(geometry, camera.columns, camera.rows, rig.view.columns, rig.view.rows)
        for index, image in enumerate(images):
            stage.update(index, len(images), f"simulating {image.name}")
            scene = capture_photograph(world, _normalised(read_photograph(image)), view, shown)
            with storing_in(out):
                files.append(_write(out, image, scene, rig))
    for item in files:
        output.say(f"{item.source} -> {item.mosaic} (exposure {item.exposure_s:.6f} s)")
    output.result(SimulateSummary(rig.name, seed, tuple(files)))


def _results(out: Path, image: Path) -> tuple[Path, Path, Path]:
    mosaic, preview, ideal = (out / f"{image.stem}-{kind}.png" for kind in ("mosaic", "preview", "ideal"))
    return mosaic, preview, ideal


def _check_names(images: list[Path], out: Path) -> None:
    taken = {image.resolve(): image for image in images}
    for image in images:
        for file in _results(out, image):
            if (other := taken.get(file.resolve())) is not None:
                raise UdccalError(
                    f"Expected names that differ in {out}, found that {file.name} for {image} is taken by {other}. "
                    "Rename a photograph, or choose another folder."
                )
            taken[file.resolve()] = image


def _normalised(radiance: Float[np.ndarray, "rows columns 3"]) -> Float[np.ndarray, "rows columns 3"]:
    """Scale radiance so that its 97th percentile is 1: as bright as white paper in a lit room."""
    return radiance / max(float(np.percentile(radiance, 97.0)), 1e-9)


def _write(out: Path, image: Path, scene: CapturedScene, rig: RigDescription) -> SimulatedFile:
    out.mkdir(parents=True, exist_ok=True)
    mosaic, preview, ideal = _results(out, image)
    write_png16(mosaic, scene.mosaic)
    quick = mosaic_preview(scene.mosaic, rig.camera.cfa, rig.camera.black_DN.value)
    for name, picture in ((preview, quick), (ideal, scene.ideal)):
        write_picture(name, picture, Tone(display_exposure(picture)))
    return SimulatedFile(image, mosaic, preview, ideal, scene.exposure_s)
