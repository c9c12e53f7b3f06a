"""Many fits of one quantity against the truth: efficiency, and whether sigma is right."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

# Mean squared error over the Cramér–Rao bound: not above this, within two standard errors.
MOST_OVER_BOUND = 1.10
# z-scores: mean 0 and standard deviation 1 within three standard errors, and never outside these.
MEAN_BAND, STD_BAND = 0.15, 0.10
# Offsets that only very many realisations resolve and that nobody can notice: a fifth of the bands.
_UNNOTICED = 0.2
# No z-score is beyond this: one fit that is far off widens the standard errors above, in which it hides.
WORST_Z = 6.0


@dataclass(frozen=True)
class Trials:
    """Realisations of one quantity at one or more places.

    Attributes:
        name: term and quantity, such as ``noise/K``.
        error: estimate minus truth.
        sigma: standard deviation from the fit.
        bound: the Cramér–Rao bound on the standard deviation, at the truth, of the data that the fit used.
        truth: number of each realisation's truth; None where each has its own.
        bound_of_all: the same of all captured data; None where the fit used all, NaN where nobody has computed it.
    """

    name: str
    error: Float[np.ndarray, "realisations places"]
    sigma: Float[np.ndarray, "realisations places"]
    bound: Float[np.ndarray, "realisations places"]
    truth: Int[np.ndarray, " realisations"] | None = None
    bound_of_all: Float[np.ndarray, "realisations places"] | None = None


@dataclass(frozen=True)
class Figure:
    """One line of ``efficiency.json``.

    ``efficiency`` is the bound over the mean squared error (1: all information in the used data), with its standard
    error; ``of_all`` the same with the bound of all captured data, which is what users get; None where it is not known.
    ``z_mean``, ``z_std`` and the largest size ``z_worst`` are of (estimate - truth) / sigma.
    """

    name: str
    efficiency: float
    efficiency_error: float
    of_all: float | None
    z_mean: float
    z_std: float
    z_worst: float
    truths: int
    ok: bool


def column(
    name: str,
    error: list[float],
    sigma: list[float],
    bound: float | list[float],
    truth: Int[np.ndarray, " realisations"] | None = None,
) -> Trials:
    """Trials of a single number."""
    shape = (len(error), 1)
    wide = np.broadcast_to(np.asarray(bound, dtype=np.float64).reshape(-1, 1), shape)
    return Trials(name, np.reshape(error, shape).astype(float), np.reshape(sigma, shape).astype(float), wide, truth)


def figure(trials: Trials) -> Figure:
    """Evaluate the trials. Standard errors come from truths: realisations and places of one have errors in common.

    Raises:
        ValueError: with fewer than two truths, which tell no standard error.
    """
    ratio = _by_truth(trials, (trials.error / trials.bound) ** 2)
    if (count := len(ratio)) < 2:
        raise ValueError(f"Expected {trials.name} of several truths, found {count}. Draw more.")
    over, over_error = float(ratio.mean()), float(ratio.std(ddof=1) / np.sqrt(count))
    whole = trials.bound if trials.bound_of_all is None else trials.bound_of_all
    over_all = float(_by_truth(trials, (trials.error / whole) ** 2).mean())
    z = trials.error / trials.sigma
    mean, square = _by_truth(trials, z), _by_truth(trials, z**2)
    z_mean, mean_error = float(mean.mean()), float(mean.std(ddof=1) / np.sqrt(count))
    z_std = float(np.sqrt(max(square.mean() - z_mean**2, 0.0)))
    z_worst = float(np.abs(z).max())
    std_error = float(square.std(ddof=1) / np.sqrt(count) / (2 * max(z_std, 1e-9)))
    ok = (
        bool(np.isfinite([over, z_mean, z_std]).all())
        and z_worst <= WORST_Z
        and over - 2 * over_error <= MOST_OVER_BOUND
        and _near(z_mean, 0.0, mean_error, MEAN_BAND)
        and _near(z_std, 1.0, std_error, STD_BAND)
    )
    of_all = 1 / over_all if np.isfinite(over_all) else None
    return Figure(trials.name, 1 / over, over_error / over**2, of_all, z_mean, z_std, z_worst, count, ok)


def _by_truth(trials: Trials, of: Float[np.ndarray, "realisations places"]) -> Float[np.ndarray, " truths"]:
    """Mean over the realisations and places of each truth."""
    whole = of.mean(axis=1)
    if trials.truth is None:
        return whole
    return np.array([whole[trials.truth == one].mean() for one in np.unique(trials.truth)])


def _near(value: float, wanted: float, error: float, band: float) -> bool:
    off = abs(value - wanted)
    # The band binds where the realisations suffice to tell, that is where it is wider than three standard errors.
    return off <= max(3 * error, _UNNOTICED * band) and (off <= band or band < 3 * error)


def table(figures: list[Figure]) -> str:
    """The figures as a Markdown table."""
    head = [
        "| quantity | efficiency | of all data | z mean | z std | worst z | truths | |",
        "| --- | ---: | ---: | ---: | ---: | ---: | ---: | --- |",
    ]
    body = [
        f"| {f.name} | {f.efficiency:.3f} ± {f.efficiency_error:.3f} | "
        f"{'–' if f.of_all is None else f'{f.of_all:.3f}'} | {f.z_mean:+.3f} | "
        f"{f.z_std:.3f} | {f.z_worst:.1f} | {f.truths} | {'ok' if f.ok else '**missed**'} |"
        for f in figures
    ]
    return "\n".join(head + body)


def write_json(figures: list[Figure], path: Path) -> None:
    """``efficiency.json``: a list of the figures, each as its fields by name."""
    path.write_text(json.dumps([asdict(f) for f in figures], indent=1) + "\n", encoding="utf-8")
