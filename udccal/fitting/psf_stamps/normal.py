"""The normal equations of one colour of a psf field in stamps: nodes, and a border of what stars and colours share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse
from jaxtyping import Float, Int

from udccal.fitting.psf_stamps.field import OWN, TAPS, PlaneField, polynomials
from udccal.fitting.psf_stamps.likelihood import Weighted
from udccal.fitting.psf_stamps.stencil import node_sums


@dataclass(frozen=True)
class Border:
    """How stars' own changes follow from what of the border a colour listens to.

    Attributes:
        index: of those unknowns in the whole border: (x, y, light by colour) by star; then maps and lateral by colour.
        matrix: from these to the stars' own changes.
        size: of the whole border.
    """

    index: Int[np.ndarray, " own"]
    matrix: scipy.sparse.csr_array
    size: int


@dataclass(frozen=True)
class Normal:
    """H x = g of one colour; nodes come node by node, the images of a node together.

    Attributes:
        sums: of nodes with their neighbours, as ``stencil.node_sums`` gives them.
        meet, border: of nodes with the colour's part of the border, and of that part with itself.
    """

    sums: Float[np.ndarray, "rows 4 columns 7 terms terms"]
    meet: Float[np.ndarray, "nodes own"]
    border: Float[np.ndarray, "own own"]
    right_nodes: Float[np.ndarray, " nodes"]
    right_border: Float[np.ndarray, " own"]


def borders(fields: tuple[PlaneField, ...], unit: Float[np.ndarray, "stars 2"]) -> tuple[Border, ...]:
    """By colour."""
    stars, planes = len(unit), len(fields)
    star, start = OWN * np.arange(stars), stars * (2 + planes)
    width = start + sum(np.size(f.warp) + np.size(f.lateral) for f in fields)
    one, first = np.ones(stars), np.arange(stars) * (2 + planes)
    out = []
    for plane, field in enumerate(fields):
        parts = [(star, first + 2 + plane, one), (star + 1, first, one), (star + 2, first + 1, one)]
        for degree, numbers, own in ((field.warp_degree, 4, 3), (field.lateral_degree, 2, 1)):
            for column in polynomials(unit, degree)[:, 1:].T:
                parts += [(star + own + i, np.full(stars, start + i), column) for i in range(numbers)]
                start += numbers
        rows, columns, values = (np.concatenate(part) for part in zip(*parts, strict=True))
        index, columns = np.unique(columns, return_inverse=True)
        shape = (OWN * stars, len(index))
        out.append(Border(index, scipy.sparse.csr_array((values, (rows, columns)), shape=shape), width))
    return tuple(out)


def normal_equations(
    field: PlaneField, unit: Float[np.ndarray, "stars 2"], seen: Weighted, border: scipy.sparse.csr_array
) -> Normal:
    """Of one colour, without priors."""
    basis = polynomials(unit, field.image_degree)
    rows, columns = field.nodes.shape[1:]
    weighted = np.concatenate([seen.slopes, seen.residual[..., None]], axis=2) * seen.weight[..., None]
    onto = _onto_nodes(seen, weighted, (rows, columns))
    own = seen.slopes.transpose(0, 2, 1) @ weighted
    return Normal(
        sums=node_sums(basis, seen, (rows, columns)),
        meet=_meet(basis, onto[..., :OWN], border),
        border=(border.T @ scipy.sparse.block_diag(list(own[..., :OWN]), format="csr") @ border).toarray(),
        right_nodes=(onto[..., OWN] @ basis).ravel(),
        right_border=border.T @ own[..., OWN].ravel(),
    )


def _meet(
    basis: Float[np.ndarray, "stars terms"], onto: Float[np.ndarray, "grid stars own"], border: scipy.sparse.csr_array
) -> Float[np.ndarray, "nodes border"]:
    """Of nodes with the border, from sums over each star's samples."""
    terms, width = basis.shape[1], border.shape[1]
    each = [border.multiply(np.repeat(column, OWN)[:, None]).T for column in basis.T]
    found = scipy.sparse.vstack(each, format="csr") @ np.ascontiguousarray(onto.reshape(len(onto), -1).T)
    return np.ascontiguousarray(found.reshape(terms, width, -1).transpose(2, 0, 1)).reshape(-1, width)


def _onto_nodes(
    seen: Weighted, values: Float[np.ndarray, "stars samples k"], grid: tuple[int, int]
) -> Float[np.ndarray, "nodes stars k"]:
    """The stars' taps, transposed: from each star's samples to nodes."""
    stars, samples, k = values.shape
    nodes = grid[0] * grid[1]
    step = (np.arange(TAPS)[:, None] * grid[1] + np.arange(TAPS)).ravel()
    index = (seen.first[..., None] + step) * stars + np.arange(stars)[:, None, None]
    weights = seen.down[..., :, None] * seen.across[..., None, :]
    ends = np.arange(0, index.size + 1, TAPS**2)
    taps = scipy.sparse.csr_array((weights.ravel(), index.ravel(), ends), shape=(stars * samples, nodes * stars))
    return np.asarray(taps.T @ values.reshape(-1, k)).reshape(nodes, stars, k)
