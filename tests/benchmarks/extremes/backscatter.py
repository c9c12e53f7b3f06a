"""The backscatter fit at the ends of its range, on rigs whose light follows the model."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from tests.benchmarks.extremes.case import Case, Outcome, outcome
from tests.scenes.backscatter import EXPOSURE_S, RULES, World, panel_pictures, shots_of, small_rig, world_at
from udccal.fitting.backscatter.data import BackscatterData, Binned
from udccal.fitting.backscatter.fit import fit_backscatter
from udccal.fitting.backscatter.parameters import TWO_PLANES, prior_of
from udccal.result import FitResult
from udccal.rig import Nominal, RigDescription

PICTURES = 10
_WHITE = np.array([1.6e4, 2e4, 1.4e4])[:, None, None]
_SHIFT = 0.4


@dataclass(frozen=True)
class Made:
    """A rig whose light follows the model, its pictures, and shots of them."""

    of: World
    pictures: tuple[np.ndarray, ...]
    shots: BackscatterData


def made(
    rig: RigDescription | None = None,
    pictures: tuple[np.ndarray, ...] | None = None,
    gamma: float | None = None,
    exposure_s: float = EXPOSURE_S,
    truth: Float[np.ndarray, "18"] | None = None,
    seed: int = 0,
) -> Made:
    """A rig somewhat off its nominal values, and its shots."""
    rig = rig or small_rig()
    rng = np.random.default_rng([seed, 0xE])
    prior = prior_of(rig)
    x = prior.mean + _SHIFT * prior.sigma * rng.choice([-1.0, 1.0], 18) if truth is None else truth
    x = TWO_PLANES.start(x, prior)
    x[0] = x[0] if gamma is None else gamma
    of = world_at(x, rig, _WHITE)
    shown = pictures or tuple(panel_pictures(rig, 40, PICTURES))
    return Made(of, shown, shots_of(of, rng, list(shown), exposure_s))


def fitted(made_of: Made, rig: RigDescription | None = None) -> FitResult:
    """The fit of shots, by the true rig's description or by another."""
    return fit_backscatter(made_of.shots, made_of.of.term.geometry, rig or made_of.of.rig, RULES)


def errors(result: FitResult, of: World) -> Float[np.ndarray, " n"]:
    """Errors of the estimates that were fitted, in sigma."""
    values = of.values
    # In an order without a part, what stands for it has no error bar.
    return np.array([(e.value - v) / e.sigma for e, v in zip(result.estimates, values, strict=False) if e.sigma > 0])


def _judged(made_of: Made, rig: RigDescription | None = None) -> Outcome:
    result = fitted(made_of, rig)
    return outcome(result, errors(result, made_of.of) if result.ok else None)


def _even(levels: list[int], rig: RigDescription) -> tuple[np.ndarray, ...]:
    return tuple(np.full((rig.panel.rows, rig.panel.columns, 3), level, np.uint8) for level in levels)


def with_seen(data: BackscatterData, change: Callable[[int, Binned], Binned]) -> BackscatterData:
    """Shots with every picture's bins changed."""
    shots = [data.shots.part(slice(k, k + 1)) for k in range(len(data.names) + 2)]
    shots[1:-1] = [change(k, one) for k, one in enumerate(shots[1:-1])]
    return replace(data, shots=Binned.joined(shots))


def _scaled(one: Binned, by: float) -> Binned:
    return replace(one, rate=one.rate * by)


def _constant(level: int) -> Outcome:
    return _judged(made(pictures=_even([level] * PICTURES, small_rig())))


def _saturated() -> Outcome:
    found = made()
    full = with_seen(found.shots, lambda _, one: replace(one, clipped=np.ones_like(one.clipped)))
    return _judged(replace(found, shots=full))


def _white_only() -> Outcome:
    return _first(0)


def _first(count: int) -> Outcome:
    found = made()
    return _judged(replace(found, shots=found.shots.only(np.arange(PICTURES) < count)))


def _wrong_order() -> Outcome:
    found = made()
    return _judged(replace(found, shots=replace(found.shots, shown=found.shots.shown[::-1].copy())))


def _dropped() -> Outcome:
    found = made()
    dark = found.shots.shots.part(slice(-1, None))
    return _judged(replace(found, shots=with_seen(found.shots, lambda k, one: dark if k == 4 else one)))


def _flickering(sigma: float) -> Outcome:
    found, rng = made(), np.random.default_rng(5)
    gains = 1 + sigma * rng.normal(size=PICTURES)
    return _judged(replace(found, shots=with_seen(found.shots, lambda k, one: _scaled(one, gains[k]))))


def _bright(electrons: float) -> Outcome:
    return _judged(made(exposure_s=electrons / float(_WHITE.max())))


def _standoff(distance_mm: float) -> Outcome:
    """The pupil keeps its distance in units of what it sees: a longer lens further away."""
    rig = small_rig()
    mounting = rig.mounting.model_copy(update={"standoff_mm": Nominal(value=distance_mm, tolerance=0.03 * distance_mm)})
    camera = rig.camera.model_copy(
        update={"pitch_um": max(4.0, rig.camera.pitch_um * min(1.0, rig.mounting.standoff_mm.value / distance_mm))}
    )
    return _judged(made(rig.model_copy(update={"mounting": mounting, "camera": camera})))


def off_by(rig: RigDescription, pitch: float = 1.0, distance: float = 1.0, lens: float = 1.0) -> RigDescription:
    """A description that is wrong by these factors."""
    panel, mounting, optics = rig.panel, rig.mounting, rig.lens

    def scaled(value: Nominal, by: float) -> Nominal:
        return Nominal(value=value.value * by, tolerance=value.tolerance)

    return rig.model_copy(
        update={
            "panel": panel.model_copy(update={"pitch_mm": scaled(panel.pitch_mm, pitch)}),
            "mounting": mounting.model_copy(update={"standoff_mm": scaled(mounting.standoff_mm, distance)}),
            "lens": optics.model_copy(update={"f_number": scaled(optics.f_number, 1 / lens)}),
        }
    )


def wrong_start(pitch: float = 1.0, distance: float = 1.0, lens: float = 1.0) -> Outcome:
    """The plain pictures, fitted from a description that is off by these factors."""
    found = made()
    return _judged(found, off_by(small_rig(), pitch, distance, lens))


def _case(name: str, run: Callable[..., Outcome], *args: float, **named: float) -> Case:
    return Case("backscatter", name, functools.partial(run, *args, **named))


CASES = (
    _case("ten even greys", _constant, 128),
    _case("ten black pictures", _constant, 0),
    _case("every picture saturated", _saturated),
    _case("white only", _white_only),
    _case("two pictures", _first, 2),
    *(_case(f"{electrons:g} e⁻ of white light", _bright, electrons) for electrons in (1.0, 30.0, 1000.0, 11000.0)),
    _case("pictures in the wrong order", _wrong_order),
    _case("a dropped frame", _dropped),
    _case("panel flickers by 0.2 %", _flickering, 0.002),
    _case("panel flickers by 5 %", _flickering, 0.05),
    *(_case(f"gamma {gamma}, description says 2.2", lambda g=gamma: _judged(made(gamma=g))) for gamma in (1.0, 3.0)),
    *(_case(f"pupil {distance:g} mm from the panel", _standoff, distance) for distance in (2.0, 30.0, 100.0)),
    _case("distance 20 % too long", wrong_start, distance=1.2),
    _case("distance 20 % too short", wrong_start, distance=0.8),
    _case("lens 20 % too wide", wrong_start, lens=1.2),
    _case("lens 20 % too narrow", wrong_start, lens=0.8),
)
