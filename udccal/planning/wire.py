"""Prediction for the wire: the columns that the joint fit has, on a part of the pixels that it spends.

The map's sigma follows from the covariance of shape, shading and site gains together, with the prior that the fit has.
A pixel's variance is shot and dark noise over the frames, and PRNU, which no number of frames averages down.
"""

from __future__ import annotations

from typing import final

import numpy as np
from jaxtyping import Bool, Float

from udccal.arrangements import Dark, FlatLight
from udccal.fitting.engine.gaussian import scaled_inverse
from udccal.fitting.wire.basis import SITES, Basis, Pixels, model_columns, sample_pixels
from udccal.fitting.wire.fit import FIELD_SAMPLES
from udccal.fitting.wire.harmonics import full_basis, plain_basis, possible_harmonics, wire_start
from udccal.fitting.wire.prior import rig_prior
from udccal.fitting.wire.scan import ideal_wire, with_harmonics
from udccal.fitting.wire.slopes import SHAPE_PARAMETERS
from udccal.models.wire import Wire
from udccal.numerics import in_float64
from udccal.planning.forecast import Floor
from udccal.planning.state import EvenField, RigState, sample_variance_e
from udccal.planning.steps import PlannedStep, planned_steps
from udccal.rig import Captures

_PIXELS = 8_000
# The strongest tell all of the shape that matters.
_HARMONICS = 24


@final
class WirePredictor:
    """Predicts the sigma of the wire map in per cent of its mean."""

    @in_float64
    def __init__(self, state: RigState) -> None:
        self._state = state
        camera = state.rig.camera
        shape = (camera.rows, camera.columns)
        size = camera.rows * camera.columns
        pixels = sample_pixels(np.ones(shape), np.ones(shape), state.geometry, _odd_step(size, _PIXELS))
        wire, basis = _as_expected(state, pixels)
        self._precision = rig_prior(wire_start(state.rig)).precision(basis, shape=True)
        self._value, self._design, self._places = _columns(wire, pixels, basis)
        used = pixels.place >= 0
        # The fit spends so many pixels for each of these.
        self._each = size / _odd_step(size, FIELD_SAMPLES) / used.sum()
        y, x = np.divmod(np.maximum(pixels.place, 0), camera.columns)
        field = EvenField(state)
        self._signal_e = np.where(used, state.full_well_e * field.signal(np.stack([x, y], axis=1).astype(float)), 0.0)
        self._used = used

    def sigma(self, captures: Captures) -> float:
        """Root mean square over the sensor; see ``prediction.Predictor``."""
        relative = self._of_captures(captures)
        return float("inf") if relative is None else self._map_sigma(relative, self._each)

    def used(self, captures: Captures) -> float:
        """Of all pixels, a part; see ``prediction.Predictor``."""
        relative = self._of_captures(captures)
        if relative is None:
            return 1.0
        every = self._state.rig.camera.rows * self._state.rig.camera.columns / self._used.sum()
        by_all, by_part = (self._map_sigma(relative, each, model=0.0) for each in (every, self._each))
        return min((by_all / by_part) ** 2, 1.0)

    def floor(self) -> Floor:
        """That of PRNU."""
        prnu = float(np.asarray(self._state.noise.PRNU1288))
        share = self._each * self._used.sum() / (self._state.rig.camera.rows * self._state.rig.camera.columns)
        return Floor(
            self._map_sigma(np.full(len(self._used), prnu**2), self._each),
            f"Pixels differ in their response by {100 * prnu:.2g} % (PRNU), and that does not average over frames: "
            + ("a fit to more of the sensor's pixels (FitEffort's wire_samples)" if share < 0.9 else "more pixels")
            + " would lower it.",
        )

    def _of_captures(self, captures: Captures) -> Float[np.ndarray, " n"] | None:
        """Relative variance of each pixel; None without flats or darks."""
        steps = list(planned_steps("wire", self._state.with_captures(captures)))
        flats = [step for step in steps if isinstance(step.arrangement, FlatLight)]
        darks = [step for step in steps if isinstance(step.arrangement, Dark)]
        return self._relative_variance(flats[0], darks[0]) if flats and darks else None

    def _relative_variance(self, flat: PlannedStep, dark: PlannedStep) -> Float[np.ndarray, " n"]:
        """Of flat less dark, over the signal squared."""
        signal = np.maximum((flat.level or 0.0) * self._signal_e, 1e-3)
        variance = sample_variance_e(self._state, signal, flat.exposures_s[0]) / len(flat.exposures_s)
        variance = variance + sample_variance_e(self._state, np.zeros(1), dark.exposures_s[0]) / len(dark.exposures_s)
        return np.asarray(variance / signal**2 + float(np.asarray(self._state.noise.PRNU1288)) ** 2)

    def _map_sigma(self, relative: Float[np.ndarray, " n"], each: float, model: float | None = None) -> float:
        """``relative`` is the variance of each pixel, which stands for ``each`` of them, over its signal squared."""
        left_out = self._state.unexplained.wire if model is None else model
        weight = np.where(self._used, each / np.maximum(relative * self._value**2, 1e-12), 0.0)
        information = (self._design * weight) @ self._design.T + np.diag(self._precision)
        cov = scaled_inverse(information)
        of_noise = np.mean(np.einsum("in,ij,jn->n", self._places, cov, self._places))
        return 100.0 * float(np.sqrt(of_noise + left_out**2))


def _odd_step(size: int, samples: int) -> int:
    step = max(1, size // samples)
    return step + 1 - step % 2


def _as_expected(state: RigState, pixels: Pixels) -> tuple[Wire, Basis]:
    """The wire as measured or as built, with the columns that a fit of it is expected to keep."""
    start = wire_start(state.rig)
    harmonics, sizes = possible_harmonics(start)
    harmonics, sizes = harmonics[:_HARMONICS], sizes[:_HARMONICS]
    built = with_harmonics(ideal_wire(state.geometry, start, harmonics), harmonics, pixels)
    basis = full_basis(sizes, plain_basis())
    if state.wire is None or not len(np.asarray(state.wire.harmonics)):
        return built, basis.kept(basis.groups < 0)
    # What a profile's wire has of shading and of departures from a round pupil is what the data asked for.
    return built, basis.kept((basis.groups < 0) | _present(state.wire, basis))


def _present(wire: Wire, basis: Basis) -> Bool[np.ndarray, " all"]:
    baseline, fields = np.asarray(wire.baseline), np.asarray(wire.fields)
    smooth = np.array([_at(baseline, tuple(pair)) != 0 for pair in basis.baseline], dtype=bool)
    linear = []
    for column in basis.fields:
        neutral = 1.0 if not column[1:].any() else 0.0
        linear.append(_at(fields, tuple(column), neutral) != neutral)
    sites = np.ones(SITES - 1, dtype=bool)
    return np.concatenate([smooth, sites, np.zeros(len(basis.amplitudes), bool), np.array(linear, dtype=bool)])


def _at(values: np.ndarray, place: tuple[int, ...], otherwise: float = 0.0) -> float:
    inside = all(int(i) < size for i, size in zip(place, values.shape, strict=True))
    return float(values[place]) if inside else otherwise


def _columns(
    wire: Wire, pixels: Pixels, basis: Basis
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "columns n"], Float[np.ndarray, "columns n"]]:
    """The map at pixels, its slopes by what is fitted, and those of the map once scaled to a mean of 1."""
    parts = [model_columns(wire, part, basis, shape=True) for part in pixels.blocks()]
    whole, base, design = (np.concatenate(same, axis=-1) for same in zip(*parts, strict=True))
    # Scaled to a mean of 1.
    used = pixels.place >= 0
    mean = float((whole * base)[used].mean())
    value, design = whole * base / mean, design * base / mean
    places = design[:, used].copy()
    places[basis.gains_at : basis.gains_at + SITES - 1] = 0.0
    places -= (value[used][None, :]) * places.mean(axis=1, keepdims=True)
    assert len(design) == basis.size + SHAPE_PARAMETERS
    return value, design, places
