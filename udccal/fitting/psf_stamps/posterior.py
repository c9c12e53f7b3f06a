"""The Gaussian that a step ends at: nodes eliminated colour by colour, then the border that all share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import cholesky, solve_triangular

from udccal.fitting.psf_stamps.bands import Band, factor
from udccal.fitting.psf_stamps.normal import Border, Normal
from udccal.fitting.psf_stamps.stencil import band_of


@dataclass(frozen=True)
class Eliminated:
    """One colour, with its nodes solved for the border.

    Attributes:
        factor: of the nodes. meet, right: U^-T times the nodes' own.
        border, right_border: the colour's part of the border, before what the nodes take of it.
        index: of that part in the whole border.
    """

    factor: Band
    meet: Float[np.ndarray, "nodes own"]
    right: Float[np.ndarray, " nodes"]
    border: Float[np.ndarray, "own own"]
    right_border: Float[np.ndarray, " own"]
    index: Int[np.ndarray, " own"]


@dataclass(frozen=True)
class Posterior:
    """Its mode as a step from where the equations were set up, and its covariance as factors.

    Attributes:
        colours: with nodes eliminated. root: lower Cholesky factor of the border's precision.
        nodes, border: the step.
        gain: of the log posterior that the step promises.
    """

    colours: tuple[Eliminated, ...]
    root: Float[np.ndarray, "border border"]
    nodes: tuple[Float[np.ndarray, "_nodes"], ...]
    border: Float[np.ndarray, " border"]
    gain: float

    @property
    def log_det(self) -> float:
        """Of the precision."""
        return sum(c.factor.log_det for c in self.colours) + float(2 * np.log(np.diag(self.root)).sum())

    def draws(
        self, rng: np.random.Generator, count: int
    ) -> tuple[list[Float[np.ndarray, "_nodes draws"]], Float[np.ndarray, "border draws"]]:
        """Draws about the mode: nodes by colour, and border."""
        border = solve_triangular(self.root, rng.standard_normal((len(self.root), count)), lower=True, trans=1)
        return [
            c.factor.backward(rng.standard_normal((len(c.meet), count)) - c.meet @ border[c.index])
            for c in self.colours
        ], border


def eliminate(normal: Normal, border: Border) -> Eliminated:
    """Solve a colour's nodes for the border; the priors are in ``normal`` already, whose ``meet`` is overwritten.

    Raises:
        numpy.linalg.LinAlgError: when the equations are singular.
    """
    found = factor(band_of(normal.sums))
    right = found.forward(normal.right_nodes[:, None].copy())[:, 0]
    return Eliminated(found, found.forward(normal.meet), right, normal.border, normal.right_border, border.index)


def joined(
    colours: tuple[Eliminated, ...],
    border_prior: Float[np.ndarray, "border border"],
    border_pull: Float[np.ndarray, " border"],
) -> Posterior:
    """Mode and factors.

    Raises:
        numpy.linalg.LinAlgError: when the equations are singular.
    """
    schur, right = border_prior.copy(), border_pull.copy()
    for c in colours:
        schur[np.ix_(c.index, c.index)] += c.border - c.meet.T @ c.meet
        right[c.index] += c.right_border - c.meet.T @ c.right
    root = cholesky(schur, lower=True)
    half = solve_triangular(root, right, lower=True)
    border = solve_triangular(root, half, lower=True, trans=1)
    nodes = tuple(c.factor.backward((c.right - c.meet @ border[c.index])[:, None])[:, 0] for c in colours)
    gain = 0.5 * float(half @ half + sum(c.right @ c.right for c in colours))
    return Posterior(colours, root, nodes, border, gain)
