"""The work `hdr` by udccal: ten exposures merged, through ``merge_bracket``."""

from __future__ import annotations

import numpy as np

import udccal
from tests.benchmarks.peers.works_module import arguments, load, timed
from udccal.fitting.hdr.merge import merge_bracket
from udccal.models.noise import Noise


def main() -> None:
    """Print one line of JSON with both kinds of the work, of the same single picture that the peers merge."""
    parser = arguments(__doc__)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    works = load(options.peers)
    numbers = works.HDR
    sensor = Noise(
        K_DN_per_e=numbers["K"],
        black_DN=numbers["offset"],
        saturation_DN=float(numbers["clip"]),
        sigma_d_e=numbers["read"],
        lambda_read=0.14,
        sigma_row_DN=0.0,
        q_DN=1.0,
        dark_current_e_per_s=0.0,
        DSNU1288_e=0.0,
        PRNU1288=0.0,
    )
    found = {}
    for kind in ("psf256", "full"):
        stack, times, phi = works.hdr_data(kind, options.seed)
        exposures = np.asarray(times, dtype=np.float64)
        run = timed(lambda stack=stack, exposures=exposures: merge_bracket(stack, exposures, sensor))
        metrics = works.hdr_metrics(run.result.rate_e_per_s, phi, fit_scale=False)
        found[kind] = dict(seconds=run.seconds, first_run_s=run.first_s, **metrics)
    works.emit("hdr", "udccal", udccal.__version__, found["full"]["seconds"], **found)


if __name__ == "__main__":
    main()
