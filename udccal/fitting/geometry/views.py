"""The boards of a session: corners found in the first capture of each step ``geometry/*``."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from udccal.arrangements import BoardSpec
from udccal.fitting.geometry.corners import MIN_CORNERS, BoardCorners, detect_corners
from udccal.fitting.geometry.flat_field import FlatField, read_flat_field
from udccal.fitting.geometry.luminance import Luminance, luminance, temporal_variance_DN2
from udccal.models.noise import Noise
from udccal.sessions.schema import BoardSubject, StoredStep
from udccal.sessions.store import Session

# A view with more of its samples than this at saturation has bloomed edges.
MAX_CLIPPED = 0.02


@dataclass(frozen=True)
class BoardView:
    """The corners of one step's board."""

    step_id: str
    spec: BoardSpec
    parallel: bool
    corners: BoardCorners
    clipped: float

    @property
    def usable(self) -> bool:
        """Whether enough corners were found in an unclipped picture."""
        return len(self.corners.ids) >= MIN_CORNERS and self.clipped <= MAX_CLIPPED


def read_views(session: Session, noise: Noise) -> tuple[BoardView, ...]:
    """The boards of all steps ``geometry/*``, behind the flat field where there is one.

    Args:
        session: where they were captured.
        noise: gives the black level and saturation.

    Raises:
        SessionError: when a file is missing or damaged.
    """
    steps = [step for step in session.steps("geometry") if isinstance(step.subject, BoardSubject)]
    flat = read_flat_field(session, noise) if steps else None
    return tuple(_read_view(session, step, noise, flat) for step in steps)


def _read_view(session: Session, step: StoredStep, noise: Noise, flat: FlatField | None) -> BoardView:
    """Find the board in the first capture of a step (its average, or a single frame)."""
    subject, capture = step.subject, step.captures[0]
    if not isinstance(subject, BoardSubject):
        raise TypeError(f"step {step.id} shows no board")
    mean = session.frame(capture) if capture.kind == "frame" else session.average(capture).mean
    spec = BoardSpec(subject.columns, subject.rows, subject.square_mm, subject.marker_mm, subject.dictionary)
    light = mean.astype(np.float64) - float(np.asarray(noise.black_DN))
    variance = temporal_variance_DN2(noise, light, capture.exposure_s) / capture.frames
    corners = detect_corners(_evened(light, variance, noise, flat.of(capture.region) if flat else None), spec)
    shift = np.array([capture.region.x, capture.region.y], dtype=np.float64)
    moved = BoardCorners(corners.ids, corners.xy + shift, corners.sigma)
    clipped = float(np.mean(mean >= 0.995 * float(np.asarray(noise.saturation_DN))))
    return BoardView(step.id, spec, subject.parallel_to_panel, moved, clipped)


def _evened(
    light: Float[np.ndarray, "rows columns"],
    temporal: Float[np.ndarray, "rows columns"],
    noise: Noise,
    flat: FlatField | None,
) -> Luminance:
    """As even pixels would see it; noise of pixels that stay unequal adds to the temporal noise."""
    offsets = (float(np.asarray(noise.K_DN_per_e)) * float(np.asarray(noise.DSNU1288_e))) ** 2
    if flat is None:
        return luminance(light, temporal + offsets + (float(np.asarray(noise.PRNU1288)) * light) ** 2)
    even = light / flat.response
    return luminance(even, (temporal + offsets) / flat.response**2 + flat.relative_variance * even**2)
