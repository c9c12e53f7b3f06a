"""What a difference of two profiles does to what is seen, term by term, in the units of the accuracy tables."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float

from udccal.comparison.limits import DiffLimits
from udccal.comparison.maps import DifferenceMaps
from udccal.comparison.picture import PictureLoss
from udccal.profiles.profile import Profile
from udccal.quantities import quantity
from udccal.result import FitResult
from udccal.sessions.schema import TermName

_LOSS = "loss of a restored picture"


@final
@dataclass(frozen=True)
class Effect:
    """One effect of a term's difference.

    Attributes:
        name: what differs. value: by how much, in ``unit``; it is the same when the profiles change places.
        limit: up to which it is harmless; None where it only explains.
        error: one standard deviation by the errors that both profiles state of it; None where one states none.
    """

    name: str
    value: float
    unit: str
    limit: float | None
    error: float | None = None

    @property
    def harmful(self) -> bool:
        """Whether it is beyond its limit."""
        return self.limit is not None and self.value > self.limit


def effects_of(
    term: TermName, a: Profile, b: Profile, maps: DifferenceMaps, loss: PictureLoss, limits: DiffLimits
) -> tuple[Effect, ...]:
    """Return the effects of a term's difference, the first with what the accuracy tables measure."""
    match term:
        case "noise":
            return _noise(a, b, limits)
        case "geometry":
            return _geometry(maps, limits)
        case "wire":
            error = _stated(a.wire, b.wire, "wire_map_rms_sigma", 1.0)
            first, lost = Effect("wire map, RMS", 100 * _rms(maps.wire), "%", limits.wire_percent, error), loss.wire
        case "psf":
            error = _stated(a.psf, b.psf, "kernel_relative_l2", 100.0)
            first, lost = Effect("kernels, L2", _kernels(maps), "%", limits.kernel_percent, error), loss.psf
        case "backscatter":
            error = _stated(a.backscatter, b.backscatter, "held_out_without_noise_of_peak", 100.0)
            name, lost = "panel's light, RMS, of its peak", loss.backscatter
            gain = 100 * math.hypot(*(_relative_sigma(p.noise, "K_DN_per_e") for p in (a, b)))
            error = None if error is None else math.hypot(error, gain)  # electrons are DN over the gain
            first = Effect(name, _light(maps), "%", limits.backscatter_percent, error)
    return first, Effect(_LOSS, lost, "dB", limits.picture_dB)


def _noise(a: Profile, b: Profile, limits: DiffLimits) -> tuple[Effect, ...]:
    shares = (
        ("K_DN_per_e", limits.K_percent),
        ("sigma_d_e", limits.sigma_d_percent),
        ("PRNU1288", limits.PRNU_percent),
    )
    found = []
    for name, limit in shares:
        one, other = (float(np.asarray(getattr(p.noise.term, name))) for p in (a, b))
        middle = abs(one + other) / 2 or 1.0
        found.append(Effect(quantity("noise", name).plain, 100 * abs(other - one) / middle, "%", limit))
    one, other = a.noise.term, b.noise.term
    dark_DN = float(one.K_DN_per_e * one.sigma_d_e + other.K_DN_per_e * other.sigma_d_e) / 2 or 1.0
    off = abs(float(other.black_DN - one.black_DN)) / dark_DN
    return (*found, Effect("black level, in dark noise of one sample", off, "σ_d", limits.black_sigma_d))


def _geometry(maps: DifferenceMaps, limits: DiffLimits) -> tuple[Effect, ...]:
    error = None if maps.rays_sigma_px is None else float(np.percentile(maps.rays_sigma_px, 95))
    rays, lens = (float(np.percentile(np.hypot(*some.T), 95)) for some in (maps.rays_px, maps.lens_px))
    return (
        Effect("rays in the panel's frame, 95th percentile", rays, "px", limits.rays_px, error),
        Effect("of these, the lens alone", lens, "px", None),
    )


def _kernels(maps: DifferenceMaps) -> float:
    a, b = maps.kernels_a, maps.kernels_b
    square, size = np.sum((a - b) ** 2, axis=(2, 3)), np.sqrt(np.sum(a**2, axis=(2, 3)) * np.sum(b**2, axis=(2, 3)))
    return 100 * float(np.sqrt(square / size).mean(axis=0).max())


def _light(maps: DifferenceMaps) -> float:
    shares = []
    for a, b in zip(maps.light_a, maps.light_b, strict=True):
        peak = max(float(np.abs(a).max()), float(np.abs(b).max()))
        shares.append(_rms(a - b) / peak if peak > 0 else 0.0)
    return 100 * max(shares)


def _rms(values: Float[np.ndarray, "..."]) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _stated(a: FitResult, b: FitResult, name: str, unit: float) -> float | None:
    """Error that both profiles state of themselves under this name, as an estimate or a diagnostic."""
    one, other = (_number(result, name) for result in (a, b))
    return None if one is None or other is None else unit * float(np.hypot(one, other))


def _relative_sigma(result: FitResult, name: str) -> float:
    """Relative error of an estimate; 0 of one that was not made."""
    estimate = next((one for one in result.estimates if one.name == name), None)
    return estimate.sigma / abs(estimate.value) if estimate is not None and estimate.value else 0.0


def _number(result: FitResult, name: str) -> float | None:
    estimate = next((one.value for one in result.estimates if one.name == name), None)
    return result.diagnostic(name) if estimate is None else estimate
