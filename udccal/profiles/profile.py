"""A profile in memory: the measured terms of a rig, with the evidence."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32

from udccal.models.backscatter import Backscatter
from udccal.models.geometry import Geometry
from udccal.models.noise import Noise
from udccal.models.psf import PsfField
from udccal.models.wire import Wire
from udccal.profiles.pictures import backscatter_mask
from udccal.profiles.schema import Provenance
from udccal.result import FitResult, TermResults
from udccal.rig import RigDescription

# Sentences in profile.json and in the report; each names a change of the rig.
INVALIDATED_BY = (
    "The lens was refocused, its aperture changed, or it was exchanged: geometry, wire and psf are stale.",
    "The camera moved against the panel, even by a fraction of a millimetre: wire and backscatter are stale.",
    "The camera was turned against the panel: geometry, wire, psf and backscatter are stale.",
    "The panel was exchanged: wire, psf and backscatter are stale.",
    "The panel's brightness, gamma or colour settings changed: backscatter is stale.",
    "The camera's gain, black level or binning changed: noise is stale, and every term with it.",
)


@dataclass(frozen=True, eq=False)
class Profile(TermResults):
    """One rig as measured.

    Attributes:
        rig: the rig description: what it was built to be.
        provenance: where the numbers come from.
        parent: SHA-256 of the profile that this one was derived from, or None.
        noise, geometry, wire, psf, backscatter: the terms with their evidence.
        wire_map: the wire at every pixel of the sensor, mean 1. Restoration divides by it.
        backscatter_mask: backscatter of an all-white panel in e-/s, one sample per 2 x 2 cell and channel.
        invalidated_by: sentences that say which changes make the profile stale.
    """

    rig: RigDescription
    provenance: Provenance
    parent: str | None
    noise: FitResult[Noise]
    geometry: FitResult[Geometry]
    wire: FitResult[Wire]
    psf: FitResult[PsfField]
    backscatter: FitResult[Backscatter]
    wire_map: Float32[np.ndarray, "rows columns"]
    backscatter_mask: Float32[np.ndarray, "half_rows half_columns 3"]
    invalidated_by: tuple[str, ...] = INVALIDATED_BY

    @property
    def results(self) -> tuple[FitResult, FitResult, FitResult, FitResult, FitResult]:
        """All five results, in the order of ``TermName``."""
        return self.noise, self.geometry, self.wire, self.psf, self.backscatter


def build_profile(
    rig: RigDescription,
    provenance: Provenance,
    noise: FitResult[Noise],
    geometry: FitResult[Geometry],
    wire: FitResult[Wire],
    psf: FitResult[PsfField],
    backscatter: FitResult[Backscatter],
    wire_map: Float[np.ndarray, "rows columns"],
    parent: str | None = None,
) -> Profile:
    """Make a profile from five fits, and evaluate the maps that are stored with it.

    Args:
        rig: the rig description.
        provenance: where the numbers come from.
        noise, geometry, wire, psf, backscatter: the fits.
        wire_map: the fitted wire at every pixel of the sensor, mean 1.
        parent: SHA-256 of the profile that this one is derived from, or None.

    Raises:
        FitError: when a fit has no term with error bars (``FitResult.usable``), with the advice of its status.
    """
    for result in (noise, geometry, wire, psf, backscatter):
        if not result.usable:
            raise result.error()
    return Profile(
        rig=rig,
        provenance=provenance,
        parent=parent,
        noise=noise,
        geometry=geometry,
        wire=wire,
        psf=psf,
        backscatter=backscatter,
        wire_map=wire_map.astype(np.float32),
        backscatter_mask=backscatter_mask(backscatter.term, rig),
    )
