"""Wire: a session's averaged flat over a profile's wire map, at pixels that the map was not fitted to.

The light in front of the panel differs from day to day: its level in each colour and a polynomial of second degree
over the sensor are solved for.
"""

from __future__ import annotations

import jax
import numpy as np
from jaxtyping import Float

from udccal.errors import ProfileError
from udccal.fitting.wire.data import FlatNoise, Pixels, Weighed, WireData, flat_noise, read_wire, sample_pixels, weighed
from udccal.fitting.wire.fit import unusable_flat
from udccal.fitting.wire.jacobian import values_at
from udccal.fitting.wire.parameters import WireRules
from udccal.fitting.wire.residuals import misfit
from udccal.models.wire import Wire
from udccal.numerics import in_float64
from udccal.profiles.profile import Profile
from udccal.profiles.ranges import check_ranges
from udccal.result import FitResult
from udccal.sessions.store import Session
from udccal.validation.checks import Judged, ZMap, at_most, chi2_check, unusable
from udccal.validation.flats import NO_PARTS, cell_medians, light_design
from udccal.validation.limits import ValidationLimits


def validate_wire(profile: Profile, session: Session, limits: ValidationLimits) -> Judged:
    """Judge a session's flat; see ``judge_wire``.

    Raises:
        SessionError: when a file of the session is missing or damaged.
    """
    return judge_wire(read_wire(session, profile.noise.term, profile.wire.term.geometry), profile.wire, limits)


# Over a mean of 1; numbers beyond are of a profile that was altered, and NaN is none.
_MOST_LIGHT = 1e3


@in_float64
def judge_wire(data: WireData, result: FitResult[Wire], limits: ValidationLimits) -> Judged:
    """Judge patterns by the rows' and columns' period, the worst part of the sensor, and the scatter of pixels.

    A flat that cannot be judged, or a wire of which a number is out of its range, fails with a sentence.
    """
    rules = WireRules()
    try:
        # Compiled code may end the process at numbers far beyond a profile's ranges.
        check_ranges(jax.tree.map(lambda part: np.asarray(part, dtype=np.float64), result.term), "wire")
    except ProfileError as error:
        return unusable("wire", str(error))
    if (refused := unusable_flat(data, rules)) is not None:
        return unusable("wire", " ".join((refused[1], refused[0].value)))
    pixels = sample_pixels(data.balanced, result.term.geometry, rules.samples, data.cfa, other=True)
    noise = flat_noise(data)
    with np.errstate(over="ignore"):
        whole, base = values_at(result.term, pixels)
    if not (np.abs(whole * base) < _MOST_LIGHT).all():
        return unusable("wire", "The profile's wire map has values that no panel gives. Calibrate the rig again.")
    seen = _predicted(whole * base, pixels, noise)
    stated = (result.diagnostic("wire_map_rms_sigma") or 0.0) / 100
    panel = result.term if len(result.term.harmonics) else None
    off = misfit(seen, panel, stated, held_out=True)
    cells, sigma = cell_medians(seen, noise)
    if np.isnan(cells).all():
        return unusable("wire", NO_PARTS)
    worst, dof = float(np.nanmax(np.abs(cells))), seen.pixels.used
    checks = (
        at_most(
            "wire",
            "pattern by rows and columns",
            100 * off.sigma,
            limits.wire_percent,
            "%",
            f"The flat over the wire map {'has a pattern of' if off.test.found else 'has no pattern,'} "
            f"{100 * off.sigma:.3f} % (RMS) by rows and columns.",
        ),
        at_most(
            "wire",
            "worst part of the sensor",
            100 * worst,
            limits.cell_percent,
            "%",
            f"The part of the sensor that is farthest off is off by {100 * worst:.2f} %: dust or a smudge shows here.",
        ),
        chi2_check(
            "wire",
            float(np.sum(seen.z**2)) / max(dof, 1),
            dof,
            result.chi2_dof,
            limits.chi2_factor,
            limits,
            "Pixels of the flat over the wire map",
        ),
    )
    caption = "The flat over the wire map, median of a part of the sensor, in sigma."
    return Judged(checks, ZMap(cells / np.hypot(sigma, stated), "x", "y", caption))


def _predicted(light: Float[np.ndarray, " n"], pixels: Pixels, noise: FlatNoise) -> Weighed:
    """The sample with the light that the map predicts, at the best light in front of the panel."""
    plain = weighed(pixels, light, noise)
    for _ in range(2):  # What is far off counts once more after the light's level is known.
        smooth = _smooth(plain.pixels, light)
        plain = weighed(pixels, light * smooth, noise)
    return plain


def _smooth(pixels: Pixels, expected: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """The light of the day over that of the map, by weighted least squares."""
    design, root = light_design(pixels.scaled, pixels.site), np.sqrt(pixels.weight) * expected
    ratio = np.where(pixels.weight > 0, pixels.value / np.maximum(expected, 1e-9), 0.0)
    return np.asarray(design @ np.linalg.lstsq(design * root[:, None], ratio * root, rcond=None)[0])
