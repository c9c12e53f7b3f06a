"""Runs the live pipeline for a person at a terminal."""

from __future__ import annotations

import contextlib
import functools
import json
import signal
import threading
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from types import FrameType
from typing import Final, Literal, final

import jax

from udccal.cli.jobs.apart import check_apart
from udccal.cli.jobs.live_cameras import LiveCamera
from udccal.cli.jobs.log_file import check_log, log_file
from udccal.cli.jobs.panel_picture import read_panel_picture
from udccal.cli.output import Output
from udccal.compilation import keep_compilations
from udccal.errors import LiveError
from udccal.live.durations import Spread
from udccal.live.follow import ProfileFollower
from udccal.live.hook import TimedHook, load_hook
from udccal.live.own_pictures import OwnPictures
from udccal.live.pipeline import Limits, Pipeline, ignored
from udccal.live.restoring import Restoring
from udccal.live.sinks.mirrored import MirroredSink
from udccal.live.sinks.protocol import Sink, make_sink
from udccal.live.tally import Figures, Tally
from udccal.profiles.profile import Profile
from udccal.profiles.store import find_profile, load_profile
from udccal.reports.tables import Table
from udccal.restoration.prepared import prepared_folder
from udccal.restoration.runtime import Restorer
from udccal.tiers import Tier

# Sinks whose target is a file or a folder.
_FILES: Final = ("video", "images")
_ENDING: Final = ("SIGINT", "SIGTERM", "SIGHUP")  # the last one is not on every system


@final
@dataclass(frozen=True)
class LiveRun:
    """What a person asked for; see ``udccal.cli.run``."""

    profile: Path
    tier: Tier
    camera: LiveCamera
    sink: str
    panel_picture: Path | None
    mirror_delay_s: float | None
    device: Literal["cpu", "gpu"]
    hook: str | None
    hook_s: float
    limits: Limits
    log: Path | None

    def __post_init__(self) -> None:
        if self.device == "gpu" and self.tier is Tier.preview:
            raise LiveError(
                "Expected a tier that deblurs with --device gpu, found preview, which takes some milliseconds of a "
                "processor. Choose --tier fast, balanced or accurate."
            )
        if self.mirror_delay_s is None:
            return
        if self.panel_picture is not None:
            raise LiveError("Expected one of --mirror and --panel-picture, found both. Leave one out.")
        if self.camera.kind in ("sim", "files"):
            raise LiveError(
                f"Expected --mirror with a camera that sees the panel, found --camera {self.camera.kind}, whose frames "
                "are made before. Use --camera u3v or pylon."
            )


def run_live(output: Output, wanted: LiveRun) -> None:
    """Run until the limits, the end of the files, or a signal; then show the figures of the whole run.

    Raises:
        UdccalError: when the run cannot begin, or a part of it fails.
    """
    path = find_profile(wanted.profile)
    check_log(wanted.log, path, wanted.camera.files, wanted.panel_picture)
    _check_sink(wanted)
    keep_compilations()
    device = _gpu() if wanted.device == "gpu" else None
    sink = _sink(wanted)
    hook = None if wanted.hook is None else TimedHook(load_hook(wanted.hook), wanted.hook_s)
    stop = threading.Event()

    def prepared(profile: Profile) -> Restorer:
        return Restorer.from_profile(profile, wanted.tier, keep=prepared_folder())

    follower = ProfileFollower(path, lambda: restoring.replace(prepared(load_profile(path))), output.say)
    with contextlib.ExitStack() as open_:
        write = open_.enter_context(_log(output, wanted.log))
        with output.stage("preparing"):
            profile = load_profile(path)
            shown = None if wanted.panel_picture is None else read_panel_picture(wanted.panel_picture, profile.rig)
            # Another camera is refused at once.
            deliver = open_.enter_context(wanted.camera.open(profile.rig, profile.provenance.camera))
            restorer = prepared(profile)
            own = None if wanted.mirror_delay_s is None else OwnPictures(profile.rig.panel, wanted.mirror_delay_s)
            frames, read = deliver(restorer.view, shown, restorer.seen_rows)
            restoring = Restoring(restorer, own or shown, device, read)
        open_.enter_context(_ended_by_signals(stop))
        open_.enter_context(follower)
        output.say("Running; Ctrl-C ends it.")
        with output.stage("running") as stage:

            def show(figures: Figures) -> None:
                stage.update(round(figures.elapsed_s), text=_line(figures))
                write(figures)

            tally = Tally()
            restore = functools.partial(restoring.restore, without_panel_picture=tally.without_panel_picture)
            shape, wrote = restoring.shape, ignored if own is None else own.wrote
            whole = Pipeline(frames, restore, shape, sink, hook, wanted.limits, stop, wrote, tally).run(show)
        write(whole)
    output.table(_table(whole))
    output.result(whole)


def _check_sink(wanted: LiveRun) -> None:
    """Refuse a video or a folder of images among what the run reads."""
    kind, _, target = wanted.sink.partition(":")
    if kind not in _FILES or not target:
        return
    place, files = Path(target), wanted.camera.files
    check_apart(place, wanted.panel_picture, wanted.log)
    folder = place if kind == "images" else place.parent
    if files is not None and folder.resolve() == files.resolve():
        raise LiveError(f"Expected a sink apart from the frames in {files}, found {place} among them. Choose another.")


def _sink(wanted: LiveRun) -> Sink:
    sink = make_sink(wanted.sink, wanted.camera.rate_hz)
    return sink if wanted.mirror_delay_s is None else MirroredSink(sink)


def _gpu() -> jax.Device:
    found = [device for device in jax.devices() if device.platform != "cpu"]
    if not found:
        raise LiveError(
            "Expected a GPU that JAX can use, found none. Install JAX for it (docs.jax.dev, Installation), or leave "
            "--device out."
        )
    return found[0]


@contextlib.contextmanager
def _ended_by_signals(stop: threading.Event) -> Iterator[None]:
    """Set ``stop`` at Ctrl-C and whatever else asks this process to end; a second time, Ctrl-C is itself again.

    Signals that are ignored stay so, as SIGHUP under ``nohup``; so do handlers that are not Python's.
    """

    def end(number: int, _: FrameType | None) -> None:
        stop.set()
        signal.signal(number, before[signal.Signals(number)])

    numbers = [signal.Signals[name] for name in _ENDING if hasattr(signal, name)]
    ours = [number for number in numbers if signal.getsignal(number) not in (signal.SIG_IGN, None)]
    before = {number: signal.signal(number, end) for number in ours}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def _log(output: Output, path: Path | None) -> Iterator[Callable[[Figures], None]]:
    """Yield what writes figures to a file, a line of JSON each."""
    if path is None:
        yield lambda figures: None
        return
    with log_file(output, path, "figures") as write:
        yield lambda figures: write(json.dumps(asdict(figures)))


def _line(figures: Figures) -> str:
    """Return one second in one line, what matters most first: a narrow terminal cuts its end."""
    return (
        f"{figures.captured} in, {figures.written} out, {figures.dropped} dropped; latency {_ms(figures.latency_ms)}, "
        f"restoration {_ms(figures.restoration_ms)}, output {_ms(figures.output_ms)}, "
        f"acquisition {_ms(figures.acquisition_ms)}"
    )


def _ms(spread: Spread) -> str:
    """Return the 50th, 95th and 99th percentile."""
    return "–" if spread.p50 is None else f"{spread.p50:.0f}/{spread.p95:.0f}/{spread.p99:.0f} ms"


def _table(figures: Figures) -> Table:
    """Return the summary of a run."""
    counts = (
        ("frames from the camera", figures.captured),
        ("written", figures.written),
        ("dropped by the camera", figures.dropped_by_camera),
        ("dropped before restoration", figures.dropped_before_restoration),
        ("dropped before output", figures.dropped_before_output),
        ("hooks that were late", figures.late_hooks),
        ("without the panel's picture", figures.without_panel_picture),
    )
    times = (
        ("acquisition: 50th/95th/99th percentile", figures.acquisition_ms),
        ("restoration", figures.restoration_ms),
        ("output", figures.output_ms),
        ("latency", figures.latency_ms),
    )
    rows = [(name, str(count)) for name, count in counts] + [(name, _ms(spread)) for name, spread in times]
    percent = 100.0 * figures.dropped / max(figures.captured, 1)
    title = f"{figures.elapsed_s:.1f} s, {percent:.1f} % dropped"
    return Table(title, ("", ""), tuple(rows), frozenset({1}))
