"""``udccal run``: restores the frames of a camera as they come."""

from __future__ import annotations

import enum
from pathlib import Path
from typing import Annotated

import typer

from udccal.cli.bench_options import CameraKind
from udccal.cli.options import FoundProfile, PanelPicturePath
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
        float | None,
        typer.Option("--exposure-s", min=1e-7, max=86400.0, help="Exposure of the camera, or of files without one."),
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
        float | None,
        typer.Option("--mirror-delay-ms", min=0.0, max=500.0, help="How much later the panel shows a picture: 25."),
    ] = None,
    device: Annotated[Device, typer.Option("--device", help="gpu: restore on a GPU that JAX can use.")] = Device.cpu,
    hook: Annotated[
        str | None, typer.Option("--hook", help="module:function of your own that alters each frame before output.")
    ] = None,
    hook_ms: Annotated[
        float | None,
        typer.Option(
            "--hook-ms", min=0.1, max=60e3, help="A frame whose hook takes longer than this, 10, goes out unaltered."
        ),
    ] = None,
    frames: Annotated[int | None, typer.Option("--frames", min=1, help="End after so many frames.")] = None,
    seconds: Annotated[float | None, typer.Option("--seconds", min=0.1, help="End after so many seconds.")] = None,
    log: Annotated[Path | None, typer.Option("--log", help="Write the figures of every second, as JSON lines.")] = None,
    seed: Annotated[
        int | None, typer.Option("--seed", min=0, help="Specimen of the simulated rig, and its noise: 0.")
    ] = None,
) -> None:
    """Restore a camera's frames as they come, until Ctrl-C. Only the newest frame counts; others are dropped."""
    simulated, read = camera is CameraKind.sim, camera in (CameraKind.u3v, CameraKind.pylon)
    for option, given, matters, needed in (
        ("--serial", serial, read, "--camera u3v or pylon"),
        ("--seed", seed, simulated, "--camera sim"),
        ("--mirror-delay-ms", mirror_delay_ms, mirror, "--mirror"),
        ("--hook-ms", hook_ms, hook is not None, "--hook"),
        ("--panel-picture", panel_picture, simulated or tier is not Tier.preview, "a --tier that takes off its light"),
    ):
        if given is not None and not matters:
            raise typer.BadParameter(f"does nothing without {needed}.", param_hint=f"'{option}'")
    from udccal.cli.jobs.live import LiveRun, run_live
    from udccal.cli.jobs.live_cameras import LiveCamera
    from udccal.live.pipeline import Limits

    source = LiveCamera(camera.value, serial, files, exposure_s, fps, seed or 0)
    delay_s = _or(mirror_delay_ms, 25.0) * 1e-3 if mirror else None
    limits = Limits(frames, seconds)
    shown = panel_picture, delay_s
    wanted = LiveRun(profile, tier, source, sink, *shown, device.value, hook, _or(hook_ms, 10.0) * 1e-3, limits, log)
    run_live(context.obj, wanted)


def _or(given: float | None, default: float) -> float:
    return default if given is None else given
