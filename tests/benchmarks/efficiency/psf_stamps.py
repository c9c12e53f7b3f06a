"""Efficiency of the psf field from stamps: kernels at field points, light and places of the stars.

The truth lies in the model class: a first image as fitted to round stars, images of the first degree drawn from their
prior. The bound is that of the same likelihood with the prior's precision added (van Trees' inequality).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.linalg import block_diag

from tests.benchmarks.efficiency.trials import Trials
from tests.scenes.information import fisher_information
from udccal.fitting.engine.gaussian import cramer_rao
from udccal.fitting.psf_stamps.data import Stamps, StampsRules, offsets
from udccal.fitting.psf_stamps.field import PsfField, Seen, response
from udccal.fitting.psf_stamps.fit import fit_psf_stamps
from udccal.fitting.psf_stamps.probability import envelope, grid_size, laplacian
from udccal.fitting.psf_stamps.search import Orders
from udccal.models.fields import polynomial_basis
from udccal.numerics import in_float64

STARS, SIZE, NODES, READ_E, ORDERS = 20, 11, 18, 4.0, Orders(2, 1, 1.0)
TRUTHS, PER_TRUTH = 40, 3
# Prior precisions: (a, b) of the images by degree, and of the map by degree.
IMAGE = np.array([[0.05, 0.5], [300.0, 300.0]])
MAP = np.array([1e3, 300.0])
OF_MAP = np.repeat(MAP, [8, 12])
SENSOR = np.array([1000, 800])
POINTS = np.array([[0.3, 0.4], [-0.6, 0.5], [0.7, -0.7]])


@dataclass(frozen=True)
class Truth:
    """A field, stars, and what can be known of them at best."""

    field: PsfField
    unit: Float[np.ndarray, "stars 2"]
    centre_px: Float[np.ndarray, "stars 2"]
    flux_e: Float[np.ndarray, " stars"]
    middle_px: np.ndarray
    window_px: float

    @property
    def vector(self) -> Float[np.ndarray, " n"]:
        """Nodes, map, pedestal, background, places, logarithm of light."""
        field = self.field
        parts = (field.nodes, field.warp, field.pedestal, 0.0, self.centre_px, np.log(self.flux_e))
        return np.concatenate([np.ravel(part) for part in parts])


def trials(share: float) -> list[Trials]:
    """So many fits of each truth; standard errors are of truths."""
    rng = np.random.default_rng(41)
    errors, sigmas, bounds = [], [], []
    count = max(2, round(share * TRUTHS))
    for _ in range(count):
        truth = make_truth(rng)
        quantities, bound = at_best(truth)
        for _ in range(PER_TRUTH):
            error, sigma = realisation(truth, quantities, rng)
            errors.append(error)
            sigmas.append(sigma)
            bounds.append(bound)
    e, s, b = (np.array(part) for part in (errors, sigmas, bounds))
    pixels = len(POINTS) * SIZE**2
    cuts = {"psf": np.s_[:pixels], "place": np.s_[pixels : pixels + 2 * STARS], "light": np.s_[pixels + 2 * STARS :]}
    number = np.repeat(np.arange(count), PER_TRUTH)
    return [Trials(f"psf_stamps/{name}", e[:, cut], s[:, cut], b[:, cut], number) for name, cut in cuts.items()]


@in_float64
def make_truth(rng: np.random.Generator) -> Truth:
    grid = np.stack(np.meshgrid(np.arange(5), np.arange(4)), axis=-1).reshape(-1, 2)
    position = (grid + 0.5 + rng.uniform(-0.3, 0.3, grid.shape)) / [5, 4] * SENSOR
    middle = np.rint(position).astype(np.int64)
    low, high = middle.min(axis=0), middle.max(axis=0)
    unit = (middle - (low + high) / 2) / ((high - low) / 2)
    place = np.arange(NODES) - (NODES - 1) / 2
    core = np.exp(-0.5 * (place[:, None] ** 2 + place**2) / 1.5**2)
    base = core / core.sum() + 0.02 / NODES**2
    draw = np.linalg.cholesky(np.linalg.inv(prior_matrix(base, IMAGE[1])))
    images = (draw @ rng.standard_normal((NODES**2, 2))).T.reshape(2, NODES, NODES)
    while True:
        warp = rng.standard_normal((5, 2, 2)) / np.sqrt(OF_MAP).reshape(5, 2, 2)
        field = PsfField(np.stack([base, *images])[None], warp[None], np.zeros((0, 5, 2)), np.eye(3), np.zeros(1), 1.0)
        # The model class is that of the nodes: those of the fit, whose number follows from the map, are the truth's.
        if grid_size((SIZE, SIZE), 1.0, reach(field, unit)) == (NODES, NODES):
            break
    return Truth(field, unit, position - middle, 1e5 * rng.uniform(0.5, 1.5, STARS), middle, 2.0)


def reach(field: PsfField, unit: Float[np.ndarray, "stars 2"]) -> float:
    return float(np.abs(np.linalg.inv(field.maps(unit))).sum(axis=3).max())


def prior_matrix(base: Float[np.ndarray, "rows columns"], ab: Float[np.ndarray, "2"]) -> Float[np.ndarray, "n n"]:
    scale = np.diag(1 / envelope(base, 1.0).ravel())
    rough = laplacian(*base.shape)[0].toarray() @ scale
    return ab[0] * scale**2 + ab[1] * rough.T @ rough


def unpack(x: Array, like: PsfField) -> tuple[PsfField, Array, Array, Array]:
    """Field, background, places and light."""
    count = np.size(like.nodes)
    ends = [count, count + np.size(like.warp), len(x) - 3 * STARS - 1, len(x) - 3 * STARS, len(x) - STARS]
    nodes, warp, pedestal, background, centre, light = jnp.split(x, ends)
    field = replace(like, nodes=nodes.reshape(like.nodes.shape), warp=warp.reshape(like.warp.shape), pedestal=pedestal)
    return field, background, centre.reshape(-1, 2), jnp.exp(light)


def seen_at(field: PsfField, unit: Array, centre: Array) -> Seen:
    """What a field brings to samples of stamps, traced."""
    basis = polynomial_basis(unit, 2)
    images = basis[:, :3] @ field.nodes.reshape(3, -1)
    maps = jnp.eye(2) + jnp.einsum("sm,mij->sij", basis[:, 1:], field.warp[0])
    plane = np.zeros((len(images), SIZE**2), dtype=int)
    seen = response(images[:, None], maps[:, None], centre[:, None], plane, offsets(SIZE, SIZE), NODES, NODES, 1.0)
    return seen._replace(value=seen.value + field.pedestal)


def expected(x: Array, like: PsfField, unit: Array) -> tuple[Array, Array]:
    """Mean and variance of every sample."""
    field, background, centre, light = unpack(x, like)
    mean = (light[:, None] * seen_at(field, unit, centre).value).ravel() + background
    return mean, jnp.maximum(mean, 0.0) + READ_E**2


def wanted(x: Array, like: PsfField, unit: Array, window_px: Array) -> Array:
    """Kernels at the points, places, logarithms of light, all in the term's convention."""
    field, _, centre, light = unpack(x, like)
    everywhere = jnp.concatenate([jnp.asarray(POINTS), unit])
    grid = offsets(SIZE, SIZE)
    weight = grid * jnp.exp(-0.5 * (grid**2).sum(axis=1) / window_px**2)[:, None]
    own = jnp.zeros((len(everywhere), 2))
    for _ in range(6):
        seen = seen_at(field, everywhere, own)
        slope = jnp.einsum("npi,pj->nji", seen.jacobian[..., 1:3], weight)
        own = own - jnp.linalg.solve(slope, (seen.value @ weight)[..., None])[..., 0]
    value = seen_at(field, everywhere, own).value
    total = value.sum(axis=1)
    kernels = (value / total[:, None])[: len(POINTS)]
    stars = slice(len(POINTS), None)
    return jnp.concatenate([kernels.ravel(), (centre - own[stars]).ravel(), jnp.log(light * total[stars])])


@in_float64
def at_best(truth: Truth) -> tuple[Float[np.ndarray, " q"], Float[np.ndarray, " q"]]:
    """The true quantities, and the smallest standard deviation of estimates."""
    x = truth.vector
    information = fisher_information(expected, x, truth.field, truth.unit)
    base = np.asarray(truth.field.nodes[0, 0])
    first, second = prior_matrix(base, IMAGE[0]), prior_matrix(base, IMAGE[1])
    pedestal = (SIZE**2 / StampsRules().most_pedestal) ** 2
    prior = block_diag(first, second, second, np.diag(OF_MAP), pedestal, READ_E**-2)
    information[: len(prior), : len(prior)] += prior
    args = (truth.field, jnp.asarray(truth.unit), jnp.asarray(truth.window_px))
    slopes = np.asarray(jax.jacfwd(wanted)(jnp.asarray(x), *args))
    return np.asarray(wanted(jnp.asarray(x), *args)), cramer_rao(information, slopes)


@in_float64
def realisation(
    truth: Truth, quantities: Float[np.ndarray, " q"], rng: np.random.Generator
) -> tuple[Float[np.ndarray, " q"], Float[np.ndarray, " q"]]:
    mean, _ = expected(jnp.asarray(truth.vector), truth.field, jnp.asarray(truth.unit))
    light = np.asarray(mean)
    # A drawn image may ask for a little light below zero, which has no shot noise.
    noisy = rng.poisson(np.maximum(light, 0.0)) + np.minimum(light, 0.0) + READ_E * rng.standard_normal(len(light))
    stamps = Stamps(noisy.reshape(STARS, SIZE, SIZE), truth.middle_px, READ_E)
    term = replace(fit_psf_stamps(stamps, ORDERS).term, window_px=truth.window_px)
    position = term.centre_px + POINTS * term.half_px
    stars = term.sources()
    found = [term.predict(position).ravel(), stars.place_px.ravel(), np.log(stars.light_e[:, 0])]
    sigma = [term.sigma(position).ravel(), stars.place_sigma_px.ravel(), (stars.light_sigma_e / stars.light_e)[:, 0]]
    return np.concatenate(found) - quantities, np.concatenate(sigma)
