"""Real benches: a camera, a display, and the person who puts things in front of the camera."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from udccal.benches.bench import CaptureBench
from udccal.cameras.choice import mode_for
from udccal.cameras.protocol import Camera
from udccal.cameras.step_folders import StepFolders
from udccal.cli.jobs.guided import show_on_panel
from udccal.cli.output import Output
from udccal.displays.manual import ManualDisplay
from udccal.displays.mirrored import MirroredDisplay
from udccal.displays.protocol import Display, PanelSize
from udccal.guide.events import Person
from udccal.guide.people import ByHand
from udccal.rig import RigDescription
from udccal.sessions.writer import utc_now


@contextmanager
def real_bench(rig: RigDescription, camera: Camera, display: Display) -> Iterator[CaptureBench]:
    """Open a real camera and display; the person who is led sets everything else up.

    Raises:
        CameraError: when the camera cannot be opened, or has no pixel format that fits the rig.
        DisplayError: when the display cannot be opened.
    """
    with camera, display:
        camera.set_mode(mode_for(camera.features, camera.sensor, rig.camera.cfa, rig.camera.bits))
        yield CaptureBench(rig, camera, MirroredDisplay(display), ByHand(), utc_now)


@contextmanager
def files_bench(output: Output, rig: RigDescription, root: Path, pictures: Path) -> Iterator[CaptureBench]:
    """Open a bench on pictures that any camera took, in one folder per step.

    Args:
        output: asks and informs the person at the rig.
        rig: the rig's description.
        root: holds one folder of pictures per step.
        pictures: folder that receives the panel's pictures.

    Raises:
        CameraError: when there are no pictures, or they do not contain an exposure.
        FileFormatError: when the first one cannot be read.
    """
    folders = StepFolders(root, rig.camera.cfa, rig.camera.bits)
    display = MirroredDisplay(ManualDisplay(pictures, panel_size(rig), output.say, lambda question: True))
    with folders.camera as camera, display:
        yield CaptureBench(rig, camera, display, folders, utc_now)


def u3v_camera(serial: str | None) -> Camera:
    """Return the USB3 Vision camera with that serial number, or the only one."""
    from udccal.cameras.u3v.camera import U3vCamera

    return U3vCamera(serial)


def pylon_camera(serial: str | None) -> Camera:
    """Return the camera with that serial number among those that Basler's SDK sees, or the only one."""
    from udccal.cameras.pylon import PylonCamera

    return PylonCamera(serial)


def panel_size(rig: RigDescription) -> PanelSize:
    """Return the resolution of a rig's panel."""
    return PanelSize(rig.panel.columns, rig.panel.rows)


def window_display(rig: RigDescription, monitor: int) -> Display:
    """Return a full-screen window on the monitor with that number."""
    from udccal.displays.window import WindowDisplay

    return WindowDisplay(monitor, panel_size(rig))


def manual_display(rig: RigDescription, folder: Path, person: Person) -> Display:
    """Return a panel that the person who is led operates, with its pictures in a folder."""
    asked: list[str] = []
    return ManualDisplay(folder, panel_size(rig), asked.append, lambda question: show_on_panel(person, asked[-1]))
