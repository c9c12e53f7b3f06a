"""A fit's numbers for a report: estimates in their units, and a sample of the residuals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from udccal.quantities import quantity
from udccal.result import Estimate, EstimatePrior, ResidualSample

_MOST_RESIDUALS = 6000


def estimates(
    term: str,
    names: Sequence[str],
    values: Float[np.ndarray, " n"],
    cov: Float[np.ndarray, "n n"],
    priors: Mapping[str, EstimatePrior] | None = None,
) -> tuple[Estimate, ...]:
    """Named quantities with one standard deviation each, in the units of ``quantities.toml``.

    Args:
        term: the term's name.
        names, values: of the quantities. cov: covariance, in the order of the names; further rows are ignored.
        priors: by name, what was known before the data.
    """
    sigma, known = np.sqrt(np.maximum(np.diag(cov), 0.0)), priors or {}
    return tuple(
        Estimate(name, float(value), float(one), quantity(term, name).unit, known.get(name))
        for name, value, one in zip(names, values, sigma[: len(names)], strict=True)
    )


def priors_of(
    names: Sequence[str], mean: Float[np.ndarray, " n"], sigma: Float[np.ndarray, " n"]
) -> dict[str, EstimatePrior]:
    """Return what was known before the data, by name; a sigma of infinity says that nothing was."""
    every = zip(names, mean, sigma, strict=True)
    return {name: EstimatePrior(float(m), float(s)) for name, m, s in every if np.isfinite(s)}


def coarse(values: Float[np.ndarray, "*k rows columns"], most: int) -> Float[np.ndarray, "*k down across"]:
    """Means over the cells of an even grid, of at most ``most`` cells down and across."""
    for axis in (-2, -1):
        edges = np.linspace(0, values.shape[axis], min(values.shape[axis], most) + 1).astype(int)
        sums = np.add.reduceat(values, edges[:-1], axis=axis)
        values = sums / np.diff(edges).reshape(-1, *(1,) * (-1 - axis))
    return values


def residual_sample(positions_px: Float[np.ndarray, "n 2"], z: Float[np.ndarray, " n"]) -> ResidualSample:
    """A few thousand of the residuals at most, drawn evenly in the order given.

    Args:
        positions_px: (x, y) of each residual on the sensor.
        z: residuals in units of their sigma.
    """
    drawn = np.s_[:: max(1, -(-len(z) // _MOST_RESIDUALS))]
    return ResidualSample(np.asarray(positions_px[drawn], dtype=np.float64), np.asarray(z[drawn], dtype=np.float64))
