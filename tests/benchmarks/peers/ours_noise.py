"""The noise work through the public API on arrays; prints one JSON line like every peer does.

python -m tests.benchmarks.peers.ours_noise --peers DIR [--variant lin|nonlin] [--seeds 0 1 2] [--shape ROWSxCOLUMNS]
    [--small 20]
"""

from __future__ import annotations

from functools import partial
from importlib.metadata import version
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from tests.benchmarks.peers.works_module import arguments, load
from udccal.fitting.noise.data import ExposureLevel, NoiseData, SpatialStack
from udccal.fitting.noise.fit import fit_noise
from udccal.models.noise import Noise
from udccal.result import FitResult

# EMVA 1288 judges linearity from 5 % to 95 % of saturation.
_LEAST, _MOST = 0.05, 0.95
# Small sets of frames, the same that the plain-numpy floor is judged on: a few large ones do not tell an efficiency.
_FIRST_SMALL, _SMALL = 100, (384, 512)


def fit(works: ModuleType, data: dict[str, Any]) -> FitResult[Noise]:
    """Frames from their files, one at a time, to the term."""
    folder = Path(data["dir"])

    def loaders(names: list[str]) -> tuple[partial[np.ndarray], ...]:
        return tuple(partial(np.load, folder / name) for name in names)

    levels = [
        ExposureLevel(float(t), loaders(dark), loaders(bright), float(photons))
        for t, photons, (dark, bright) in zip(data["t"], data["u_p"], data["pairs"], strict=True)
    ]
    middle = works.NOISE["spatial_level"]
    dark, bright = data["spatial"]
    stack = SpatialStack(float(data["t"][middle]), loaders(dark), loaders(bright), float(data["u_p"][middle]))
    return fit_noise(NoiseData(levels, stack)).or_raise()


def metrics(works: ModuleType, data: dict[str, Any], result: FitResult[Noise]) -> dict[str, float]:
    """Relative errors by the work's own rules."""
    term = {name: float(np.asarray(getattr(result.term, name))) for name in result.term.__dataclass_fields__}
    K = term["K_DN_per_e"]
    full_DN = term["saturation_DN"] - term["black_DN"]
    # The fitted response, z - c (z^2 + K z) of the linear signal z (EMVA 1288, clause 6.7).
    numbers = {item.name: item.value for item in result.diagnostics}
    linear = numbers["response_DN_per_light"] * (np.asarray(data["u_p"]) + numbers["light_offset"])
    mean_DN = np.minimum(linear - numbers["curvature"] * (linear**2 + K * linear), full_DN)
    inside = np.flatnonzero((mean_DN >= _LEAST * full_DN * (1 - 1e-2)) & (mean_DN <= _MOST * full_DN))
    low, high = int(inside[0]), int(inside[-1])
    return works.noise_metrics(
        data,
        K=K,
        sigma_d=term["sigma_d_e"],
        prnu=term["PRNU1288"],
        dsnu_dn=term["DSNU1288_e"] * K,
        sat_e=full_DN / K,
        dev=works.linearity_deviation(data["u_p"], mean_DN, low, high),
        dark_current=term["dark_current_e_per_s"],
        lo=low,
        hi=high,
    )


def over_bound(works: ModuleType, sets: int) -> float | None:
    """Root mean square error of K over its bound on so many small sets of frames; None for none."""
    if not sets:
        return None
    errors = []
    for seed in range(_FIRST_SMALL, _FIRST_SMALL + sets):
        data = works.noise_data(seed, "lin", _SMALL)
        errors.append(metrics(works, data, fit(works, data))["K"])
    return float(np.sqrt(np.mean(np.square(errors))) / works.noise_crb_K(_SMALL))


def main() -> None:
    """Run the seeds one by one."""
    parser = arguments(__doc__)
    parser.add_argument("--variant", choices=("lin", "nonlin"), default="lin")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--shape", default="1536x2048", help="rows x columns")
    parser.add_argument("--small", type=int, default=0, help="small sets of frames to compare K with its bound on")
    options = parser.parse_args()
    works = load(options.peers)
    rows, columns = (int(part) for part in options.shape.split("x"))
    seconds, found, orders = [], [], []
    for seed in options.seeds:
        data = works.noise_data(seed, options.variant, (rows, columns))
        result, wall, _ = works.timed(partial(fit, works, data), reps=1)
        seconds.append(wall)
        found.append(metrics(works, data, result))
        orders += [c.name for c in result.candidates if c.chosen and c.name.startswith("response")]
    rms = {key: float(np.sqrt(np.mean([one[key] ** 2 for one in found]))) for key in found[0]}
    bound = works.noise_crb_K((rows, columns))
    works.emit(
        "noise",
        "udccal",
        version("udccal"),
        float(np.median(seconds)),
        first_run_s=seconds[0],
        variant=options.variant,
        shape=[rows, columns],
        rel_err_rms=rms,
        K_err_over_crb=rms["K"] / bound,
        K_rmse_over_crb_20small=over_bound(works, options.small),
        crb_K_rel=bound,
        crb_K_rel_to90pct=works.noise_crb_K((rows, columns), max_frac=0.9),
        orders=sorted(set(orders)),
        runs=len(found),
    )


if __name__ == "__main__":
    main()
