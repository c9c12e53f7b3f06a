"""Use a camera raw file as a source of frames, and write a quick demosaiced preview of it.

python examples/read_dng.py ../shared/data/raw/colorchart.dng --out preview.png
"""

from __future__ import annotations

import argparse
from pathlib import Path

from udccal.cameras.files import FileCamera
from udccal.cameras.picture_files.mosaics import read_raw
from udccal.reports.pictures import mosaic_preview
from udccal.restoration.sinks import write_picture
from udccal.restoration.tone import Tone, display_exposure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("dng", type=Path)
    parser.add_argument("--out", type=Path, default=Path("preview.png"))
    arguments = parser.parse_args()

    about = read_raw(arguments.dng)
    with FileCamera([arguments.dng]) as camera:
        (frame,) = camera.frames(1)
    rows, columns = frame.data.shape
    print(f"{columns} x {rows}, {camera.cfa}, {camera.bits} bits, black {about.black_DN:.0f} DN")

    preview = mosaic_preview(frame.data, camera.cfa, about.black_DN)
    # Grey world: a raw file's colours are the sensor's own, mostly green.
    gains = preview.mean() / preview.mean(axis=(0, 1))
    tone = Tone(display_exposure(preview * gains), (float(gains[0]), float(gains[1]), float(gains[2])))
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    write_picture(arguments.out, preview, tone)
    print(f"wrote {arguments.out}")


if __name__ == "__main__":
    main()
