"""The work `deconv` by udccal: a picture deblurred by given kernels, through ``deblur``, with nothing else told."""

from __future__ import annotations

import numpy as np

import udccal
from tests.benchmarks.peers.works_module import arguments, load, peak_MiB, timed


def main() -> None:
    """Print one line of JSON."""
    parser = arguments(__doc__)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    works = load(options.peers)
    data = works.deconv_data(options.seed)
    blurred, kernels = data["blurred"], data["psfs"]
    y, x = (np.linspace(0, size - 1, count) for size, count in zip(blurred.shape, kernels.shape[:2], strict=False))
    run = timed(lambda: udccal.deblur(blurred, kernels, x, y), repeats=2)
    psnr, ssim = works.psnr_ssim(run.result, data["truth"])
    found = dict(first_run_s=run.first_s, peak_rss_mb=peak_MiB(), psnr=psnr, ssim=ssim)
    works.emit("deconv", "udccal", udccal.__version__, run.seconds, **found)


if __name__ == "__main__":
    main()
