"""Many fits of one quantity against the truth: efficiency, and whether sigma is right."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

# Mean squared error over the Cramér–Rao bound: not above this, within two standard errors.
MOST_OVER_BOUND = 1.10
# z-scores: mean 0 and standard deviation 1 within three standard errors, and never outside these.
MEAN_BAND, STD_BAND = 0.15, 0.10
# Offsets that only very many realisations resolve and that nobody can notice: a fifth of the bands.
_UNNOTICED = 0.2


@dataclass(frozen=True)
class Trials:
    """Realisations of one quantity at one or more places.

    Attributes:
        name: term and quantity, such as ``noise/K``.
        error: estimate minus truth.
        sigma: standard deviation from the fit.
        bound: the Cramér–Rao bound on the standard deviation, at the truth.
    """

    name: str
    error: Float[np.ndarray, "realisations places"]
    sigma: Float[np.ndarray, "realisations places"]
    bound: Float[np.ndarray, "realisations places"]


@dataclass(frozen=True)
class Figure:
    """One line of ``efficiency.json``.

    ``efficiency`` is the bound over the mean squared error (1: all information used), with its standard error;
    ``z_mean`` and ``z_std`` are of (estimate - truth) / sigma.
    """

    name: str
    efficiency: float
    efficiency_error: float
    z_mean: float
    z_std: float
    realisations: int
    ok: bool


def column(name: str, error: list[float], sigma: list[float], bound: float | list[float]) -> Trials:
    """Trials of a single number."""
    shape = (len(error), 1)
    wide = np.broadcast_to(np.asarray(bound, dtype=np.float64).reshape(-1, 1), shape)
    return Trials(name, np.reshape(error, shape).astype(float), np.reshape(sigma, shape).astype(float), wide)


def figure(trials: Trials) -> Figure:
    """Evaluate the trials. Standard errors come from whole realisations, whose places have the same noise."""
    count = len(trials.error)
    ratio = ((trials.error / trials.bound) ** 2).mean(axis=1)
    over, over_error = float(ratio.mean()), float(ratio.std(ddof=1) / np.sqrt(count))
    z = trials.error / trials.sigma
    mean, square = z.mean(axis=1), (z**2).mean(axis=1)
    z_mean, mean_error = float(mean.mean()), float(mean.std(ddof=1) / np.sqrt(count))
    z_std = float(np.sqrt(max(square.mean() - z_mean**2, 0.0)))
    std_error = float(square.std(ddof=1) / np.sqrt(count) / (2 * max(z_std, 1e-9)))
    ok = (
        bool(np.isfinite([over, z_mean, z_std]).all())
        and over - 2 * over_error <= MOST_OVER_BOUND
        and _near(z_mean, 0.0, mean_error, MEAN_BAND)
        and _near(z_std, 1.0, std_error, STD_BAND)
    )
    return Figure(trials.name, 1 / over, over_error / over**2, z_mean, z_std, count, ok)


def _near(value: float, wanted: float, error: float, band: float) -> bool:
    off = abs(value - wanted)
    # The band binds where the realisations suffice to tell, that is where it is wider than three standard errors.
    return off <= max(3 * error, _UNNOTICED * band) and (off <= band or band < 3 * error)


def table(figures: list[Figure]) -> str:
    """The figures as a Markdown table."""
    head = [
        "| quantity | efficiency | z mean | z std | realisations | |",
        "| --- | ---: | ---: | ---: | ---: | --- |",
    ]
    body = [
        f"| {f.name} | {f.efficiency:.3f} ± {f.efficiency_error:.3f} | {f.z_mean:+.3f} | {f.z_std:.3f} | "
        f"{f.realisations} | {'ok' if f.ok else '**missed**'} |"
        for f in figures
    ]
    return "\n".join(head + body)


def write_json(figures: list[Figure], path: Path) -> None:
    """``efficiency.json``: a list of {name, efficiency, efficiency_error, z_mean, z_std, realisations, ok}."""
    path.write_text(json.dumps([asdict(f) for f in figures], indent=1) + "\n", encoding="utf-8")
