"""The sensor's response to an even field, wire and shading included: boards are divided by it beforehand.

A gradient of the picture's brightness beside a corner moves it. Rows of the panel out of focus make such gradients: on
a rig whose wire modulates by 3 % corners scatter half as much once they are divided out (EMVA 1288's flat-field
correction, with the panel as part of the camera). Unequal pixels go with it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float

from udccal.fitting.geometry.luminance import temporal_variance_DN2
from udccal.models.noise import Noise
from udccal.sessions.schema import StoredRegion
from udccal.sessions.store import Session

_DARK, _FLAT = "wire/dark", "wire/flat"
# Samples with less of the response than this part of their colour's, or at saturation, tell nothing: dead, or behind an
# opaque row. They are left as they are.
_LEAST = 0.05
_CLIPPED = 0.995


@final
@dataclass(frozen=True)
class FlatField:
    """Response of every sample over the mean of its site of the pattern, and the relative variance of that by noise."""

    response: Float[np.ndarray, "rows columns"]
    relative_variance: Float[np.ndarray, "rows columns"]

    def of(self, region: StoredRegion) -> FlatField:
        """The part of a region."""
        part = (slice(region.y, region.y + region.rows), slice(region.x, region.x + region.columns))
        return FlatField(self.response[part], self.relative_variance[part])


def read_flat_field(session: Session, noise: Noise) -> FlatField | None:
    """From the averages that the wire is fitted to; None where the session has none.

    Raises:
        SessionError: when a file is missing or damaged.
    """
    if not {_DARK, _FLAT} <= {step.id for step in session.steps("wire")}:
        return None
    capture = session.step(_FLAT).captures[0]
    flat = session.average(capture).mean.astype(np.float64)
    light = flat - session.average(session.step(_DARK).captures[0]).mean
    variance = temporal_variance_DN2(noise, light, capture.exposure_s) / capture.frames
    told = flat < _CLIPPED * float(np.asarray(noise.saturation_DN))
    return flat_field(light, variance, told)


def flat_field(
    light: Float[np.ndarray, "rows columns"],
    variance: Float[np.ndarray, "rows columns"],
    told: np.ndarray,
) -> FlatField:
    """Of an even field's light and its variance, both in one unit; ``told``: samples that are not clipped."""
    response, relative = np.ones_like(light), np.zeros_like(light)
    for row in (0, 1):
        for column in (0, 1):
            site = (slice(row, None, 2), slice(column, None, 2))
            own = light[site] / max(float(light[site].mean()), 1e-12)
            good = told[site] & (own > _LEAST)
            response[site] = np.where(good, own, 1.0)
            relative[site] = np.where(good, variance[site] / np.where(good, light[site], 1.0) ** 2, 0.0)
    return FlatField(response, relative)
