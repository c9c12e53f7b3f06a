"""The work `hdr` by udccal: ten exposures merged, through ``merge_bracket``."""

from __future__ import annotations

import numpy as np

import udccal
from tests.benchmarks.peers.works_module import arguments, load, timed
from udccal.fitting.hdr.merge import merge_bracket
from udccal.models.noise import Noise

_PICTURES = 24


def main() -> None:
    """Print one line of JSON: both kinds of the work, and the ratios to the bound over many pictures."""
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
    # The brightest decade of one picture is some thirty pixels: many pictures tell its ratio.
    many = np.array([_ratios(works, sensor, options.seed + 1 + k) for k in range(_PICTURES)])
    ratios = np.sqrt(np.mean(many**2, axis=0))
    works.emit(
        "hdr", "udccal", udccal.__version__, found["full"]["seconds"], **found, ratio_many_pictures=ratios.tolist()
    )


def _ratios(works, sensor: Noise, seed: int) -> list[float]:  # type: ignore[no-untyped-def]
    _, times, phi = works.hdr_data("psf256")
    rng = np.random.default_rng([77, seed])
    electrons = rng.poisson(phi * times[:, None, None, None]) + works.HDR["read"] * rng.standard_normal(
        (len(times), *phi.shape)
    )
    codes = np.rint(works.HDR["K"] * electrons + works.HDR["offset"])
    stack = np.clip(codes, 0, works.HDR["clip"]).astype(np.uint16)
    merged = merge_bracket(stack, np.asarray(times, dtype=np.float64), sensor)
    return works.hdr_metrics(merged.rate_e_per_s, phi, fit_scale=False)["ratio"]


if __name__ == "__main__":
    main()
