"""Disturbances of a measurement; each is off by default."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from udccal.simulation.truth import RigTruth


@dataclass(frozen=True)
class Disturbances:
    """Disturbances of a simulated session.

    Attributes:
        flicker_fraction: relative amplitude of the flat light's flicker.
        flicker_hz: frequency of the flicker.
        leak_e_per_s: light that reaches the sensor past the panel in every arrangement, including darkness.
        dropped_frame_every: number of frames of which one is lost; 0 for no loss.
        knock_at_frame: first frame after the camera was knocked; None for no knock.
        knock_mm: displacement of the camera by the knock, along panel axes.
        smudge_fraction: light that a smudge takes away in its middle; it is in front of the lens in every arrangement.
        smudge_px: the smudge's middle (x, y) and radius on the sensor; it fades as a Gaussian bell of that sigma.
    """

    flicker_fraction: float = 0.0
    flicker_hz: float = 100.0
    leak_e_per_s: float = 0.0
    dropped_frame_every: int = 0
    knock_at_frame: int | None = None
    knock_mm: tuple[float, float, float] = (0.0, 0.05, 0.0)
    smudge_fraction: float = 0.0
    smudge_px: tuple[float, float, float] = (0.0, 0.0, 1.0)

    def flicker(self, timestamp_s: float, exposure_s: float) -> float:
        """Return the mean relative brightness of the flat light over an exposure that starts at ``timestamp_s``."""
        phase = 2 * np.pi * self.flicker_hz * (timestamp_s + exposure_s / 2)
        return float(1 + self.flicker_fraction * np.cos(phase) * np.sinc(self.flicker_hz * exposure_s))

    def transmission(self, x: int, y: int, columns: int, rows: int) -> Float[np.ndarray, "rows columns"]:
        """Return the part of the light that a smudge lets through, in a rectangle of the sensor."""
        across, down, radius = self.smudge_px
        square = (x + np.arange(columns) - across) ** 2 + (y + np.arange(rows)[:, None] - down) ** 2
        return np.asarray(1 - self.smudge_fraction * np.exp(-0.5 * square / radius**2))

    def drops(self, frame_id: int) -> bool:
        """Return whether this frame is lost."""
        return self.dropped_frame_every > 0 and frame_id % self.dropped_frame_every == self.dropped_frame_every - 1

    def knocked(self, frame_id: int) -> bool:
        """Return whether the camera has been knocked by the time of this frame."""
        return self.knock_at_frame is not None and frame_id >= self.knock_at_frame


def knock(truth: RigTruth, by_mm: tuple[float, float, float]) -> RigTruth:
    """Return the same rig with its camera moved along panel axes."""
    return replace(truth, optics=replace(truth.optics, pupil_mm=truth.optics.pupil_mm + np.asarray(by_mm)))
