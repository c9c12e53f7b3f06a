"""How sure the kernel is: the covariance of all numbers of diffraction, and the sigma of the psf at a field point."""

from __future__ import annotations

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from udccal.fitting.psf.blocks import HEAD, PUPIL
from udccal.fitting.psf.descent import reduced, without_locals
from udccal.fitting.psf.diffraction import DiffractionFit
from udccal.fitting.psf.kernel_error import KernelError
from udccal.fitting.psf.normal import Evaluator
from udccal.models.arrays import Arrayish
from udccal.models.diffraction import LocalFrame, average_transfer, local_frame
from udccal.models.geometry import Geometry
from udccal.models.interference import interference_transfer, node_overlaps, overlap_tables
from udccal.models.lattice import Lattice, lattice_for, sample, spline_coefficients
from udccal.models.psf import lattice_points
from udccal.numerics import in_float64

_MARGIN, _PER_PX = 1.25, 4
# Overlaps of the pupil's footprint depend on the pitch and on the pupil.
_IN_OVERLAPS = np.array([0, PUPIL])


@dataclass(frozen=True)
class PsfPosterior:
    """What the fit of diffraction knows.

    Attributes:
        geometry: where pixels look.
        evaluator, theta: the model and its global parameters; ``evaluator.model(theta)`` is the fitted one.
        cov: their covariance, model error included.
        error: of the kernel, residual included, at positions that were held out.
    """

    geometry: Geometry
    evaluator: Evaluator
    theta: Float[np.ndarray, " p"]
    cov: Float[np.ndarray, "p p"]
    error: KernelError


def posterior(fit: DiffractionFit, geometry: Geometry, error: KernelError) -> PsfPosterior:
    """Of a fit, with the spread between positions added where a model error was found."""
    return PsfPosterior(geometry, fit.problem.evaluator, fit.theta, full_cov(fit), error)


def full_cov(fit: DiffractionFit) -> Float[np.ndarray, "p p"]:
    """Covariance of the global parameters.

    What the model leaves out is alike in all samples of a position, so that it averages out over positions only: where
    there is a model error, the jackknife over positions is added, each left out in one Newton step (Efron, The
    Jackknife, the Bootstrap and Other Resampling Plans, 1982).
    """
    count = len(fit.problem.blocks)
    if fit.model_error == 0.0 or count < 2:
        return fit.cov
    matrix, _, _ = reduced(fit.problem, fit.point)
    shifts = []
    for normal in fit.point.normals:
        own, slope, _ = without_locals(normal)
        shifts.append(np.linalg.pinv(matrix - own, hermitian=True) @ -slope)
    spread = np.stack(shifts) - np.mean(shifts, axis=0)
    return fit.cov + spread.T @ spread * (count - 1) / count


@in_float64
def psf_sigma(
    known: PsfPosterior, positions_px: Float[np.ndarray, "n 2"], rows: int, columns: int
) -> Float[np.ndarray, "n 3 rows columns"]:
    """One standard deviation of the kernel's samples at field positions, in the kernel's own unit.

    By the slopes of diffraction, or what was found at positions held out where that is more: the numbers' own errors
    are part of that. ``rows`` and ``columns`` are odd.
    """
    grid = lattice_for(rows * _MARGIN + 8, columns * _MARGIN + 8, _PER_PX, _PER_PX)
    made = []
    for position in np.asarray(positions_px, dtype=np.float64):
        kernel, slopes = (
            np.asarray(part)
            for part in kernel_and_slopes(known.evaluator, known.theta, known.geometry, position, grid, rows, columns)
        )
        variance = np.einsum("pcyx,pq,qcyx->cyx", slopes, known.cov, slopes)
        made.append(np.maximum(np.sqrt(np.maximum(variance, 0.0)), known.error.of_kernels(kernel)))
    return np.stack(made)


@eqx.filter_jit
def kernel_and_slopes(
    evaluator: Evaluator,
    theta: Float[Arrayish, " p"],
    geometry: Geometry,
    position: Float[Arrayish, "2"],
    grid: Lattice,
    rows: int,
    columns: int,
) -> tuple[Float[Array, "3 rows columns"], Float[Array, "p 3 rows columns"]]:
    """The diffraction kernel at a position, and how it changes with each global parameter."""
    frame = local_frame(geometry, position)
    y, x = jnp.meshgrid(jnp.arange(rows) - rows // 2, jnp.arange(columns) - columns // 2, indexing="ij")
    points, density = lattice_points(geometry, frame, position, jnp.stack([x.ravel(), y.ravel()], axis=-1) * 1.0)
    light, slopes = light_and_slopes(evaluator, theta, frame, grid, points, density, 0.0)
    return light.T.reshape(3, rows, columns), jnp.moveaxis(slopes, -1, 1).reshape(-1, 3, rows, columns)


@eqx.filter_jit
def light_and_slopes(
    evaluator: Evaluator,
    theta: Float[Arrayish, " p"],
    frame: LocalFrame,
    grid: Lattice,
    points: Float[Arrayish, "n 2"],
    density: Float[Arrayish, " n"],
    disc_px: Float[Arrayish, ""],
) -> tuple[Float[Array, "n 3"], Float[Array, "p n 3"]]:
    """What one unit of light brings to points of a lattice, and how that changes with each global parameter.

    ``points`` and ``density`` as of ``models.psf.lattice_points``; ``disc_px`` is the diameter of the source.
    """
    at = jnp.asarray(theta)
    spectra = jnp.asarray(evaluator.model(at).spectrum)

    def overlaps(values: Float[Array, " p"]) -> Float[Array, "nodes terms rows half"]:
        model = evaluator.model(values)
        return node_overlaps(model, frame, grid, overlap_tables(model, frame))

    def lit(
        values: Float[Array, " p"], own: Float[Array, "nodes terms rows half"] | None, light: Float[Array, "c nodes"]
    ) -> Float[Array, "n c"]:
        model = evaluator.model(values)
        transfer = average_transfer(model, frame, grid, light, disc_px)
        if own is not None:
            transfer = transfer + interference_transfer(model, frame, grid, light, own, disc_px)
        return sample(grid, spline_coefficients(grid, transfer), jnp.asarray(points)) * jnp.asarray(density)[:, None]

    def along(way: Float[Array, " p"]) -> Float[Array, "n 3"]:
        return jax.jvp(lambda values: lit(values, here, spectra), (at,), (way,))[1]

    def through_overlaps(way: Float[Array, " p"]) -> Float[Array, "n 3"]:
        return jax.jvp(lambda values: lit(at, overlaps(values), spectra), (at,), (way,))[1]

    here = overlaps(at) if evaluator.interference else None
    each = jnp.eye(HEAD, jnp.size(at))
    slopes = jax.lax.map(along, each)
    if here is not None:
        # Apart, since the overlaps are by far the slowest to follow.
        slopes = slopes.at[_IN_OVERLAPS].add(jax.lax.map(through_overlaps, each[_IN_OVERLAPS]))
    # The light is linear in the spectra, which are normalised exponentials.
    nodes = lit(at, here, jnp.eye(spectra.shape[1]))
    light = nodes @ spectra.T
    by_log = jnp.einsum("cd,cj,njc->cjnd", jnp.eye(3), spectra, nodes[:, :, None] - light[:, None, :])
    return light, jnp.concatenate([slopes, by_log.reshape(-1, *light.shape)])
