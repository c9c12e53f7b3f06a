"""The work `deconv` by udccal: a picture deblurred by given kernels, through ``deblur``, with nothing else told."""

from __future__ import annotations

import os
from pathlib import Path
from types import ModuleType

import numpy as np

import udccal
from tests.benchmarks.peers.works_module import arguments, load, peak_MiB, timed
from udccal.tiers import Tier


def main() -> None:
    """Print one line of JSON."""
    parser = arguments(__doc__)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--tier", choices=[tier for tier in Tier if tier is not Tier.preview], default=Tier.balanced)
    parser.add_argument("--size", type=int, nargs=2, metavar=("COLUMNS", "ROWS"), help="of another picture")
    options = parser.parse_args()
    works = load(options.peers)
    if options.size is not None:
        _resize(works, *options.size)
    data = works.deconv_data(options.seed)
    blurred, kernels = data["blurred"], data["psfs"]
    y, x = (np.linspace(0, size - 1, count) for size, count in zip(blurred.shape, kernels.shape[:2], strict=False))
    run = timed(lambda: udccal.deblur(blurred, kernels, x, y, tier=options.tier), repeats=3)
    psnr, ssim = works.psnr_ssim(run.result, data["truth"])
    found = dict(first_run_s=run.first_s, peak_rss_mb=peak_MiB(), psnr=psnr, ssim=ssim)
    works.emit("deconv", f"udccal {options.tier}", udccal.__version__, run.seconds, **found)


def _resize(works: ModuleType, columns: int, rows: int) -> None:
    """Let the work be of another size. Its kept inputs do not say their size, so these go to a folder of their own."""
    works.DEC.update(w=columns, h=rows)
    os.environ["PEERS_OUT"] = str(Path(os.environ["PEERS_OUT"]) / f"{columns}x{rows}")


if __name__ == "__main__":
    main()
