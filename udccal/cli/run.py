"""``udccal run``: restores the frames of a camera as they come."""

from __future__ import annotations

import enum
from pathlib import Path
from typing import Annotated

import typer

from udccal.cli.bench_options import CameraKind
from udccal.cli.options import FoundProfile, PanelPicturePath, Seed
from udccal.tiers import Tier


class Device(enum.StrEnum):
    """Where frames are restored."""

    cpu = "cpu"
    gpu = "gpu"


def run(
    context: typer.Context,
    profile: FoundProfile,
    sink: Annotated[
        str,
        typer.Option(
            "--sink",
            help="Where frames go: shm:NAME, video:FILE.mp4, images:FOLDER, v4l2:/dev/videoN, "
            "window:TITLE, or window:N to fill monitor N.",
        ),
    ],
    camera: Annotated[
        CameraKind,
        typer.Option("--camera", help="sim: simulated; u3v: USB3 Vision; pylon: Basler's SDK; files: see --files."),
    ] = CameraKind.sim,
    serial: Annotated[str | None, typer.Option("--serial", help="Serial number; needed if there are several.")] = None,
    files: Annotated[Path | None, typer.Option("--files", help="Folder of raw frames, for --camera files.")] = None,
    exposure_s: Annotated[
        float | None, typer.Option("--exposure-s", min=1e-7, help="Exposure of the camera, or of files without one.")
    ] = None,
    fps: Annotated[float, typer.Option("--fps", min=1.0, max=1000.0, help="Frames per second.")] = 30.0,
    tier: Annotated[Tier, typer.Option("--tier", help="How much is done to a frame; see restore.")] = Tier.preview,
    panel_picture: PanelPicturePath = None,
    mirror: Annotated[
        bool,
        typer.Option(
            "--mirror",
            help="The panel shows this run's own pictures, scaled to fill it; the sink gets them with left and right "
            "exchanged, as in a mirror.",
        ),
    ] = False,
    mirror_delay_ms: Annotated[
        float, typer.Option("--mirror-delay-ms", min=0.0, max=500.0, help="How much later the panel shows a picture.")
    ] = 25.0,
    device: Annotated[Device, typer.Option("--device", help="gpu: restore on a GPU that JAX can use.")] = Device.cpu,
    hook: Annotated[
        str | None, typer.Option("--hook", help="module:function of your own that alters each frame before output.")
    ] = None,
    hook_ms: Annotated[
        float, typer.Option("--hook-ms", min=0.1, help="A frame whose hook takes longer goes out unaltered.")
    ] = 10.0,
    frames: Annotated[int | None, typer.Option("--frames", min=1, help="End after so many frames.")] = None,
    seconds: Annotated[float | None, typer.Option("--seconds", min=0.1, help="End after so many seconds.")] = None,
    log: Annotated[Path | None, typer.Option("--log", help="Write the figures of every second, as JSON lines.")] = None,
    seed: Seed = 0,
) -> None:
    """Restore a camera's frames as they come, until Ctrl-C. Only the newest frame counts; others are dropped."""
    from udccal.cli.jobs.live import LiveRun, run_live
    from udccal.cli.jobs.live_cameras import LiveCamera
    from udccal.live.pipeline import Limits

    source = LiveCamera(camera.value, serial, files, exposure_s, fps, seed)
    delay_s = mirror_delay_ms * 1e-3 if mirror else None
    limits = Limits(frames, seconds)
    shown = panel_picture, delay_s
    wanted = LiveRun(profile, tier, source, sink, *shown, device.value, hook, hook_ms * 1e-3, limits, log)
    run_live(context.obj, wanted)
