"""How far corners scatter beyond their noise: paper that is not flat, blur that a saddle does not describe."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import brentq

from udccal.fitting.geometry.calibrated_views import CalibratedViews

# No lens follows its model more closely than this.
_LEAST_PX = 1e-3


@final
@dataclass(frozen=True)
class CornerScatter:
    """Standard deviation by axis in px that corners have beside noise: of all views together, and of each in use."""

    excess_px: float
    by_view_px: tuple[float, ...] = ()

    def of(self, noise_px: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """One sigma by axis of corners whose noise gives ``noise_px``."""
        return np.maximum(np.hypot(noise_px, self.excess_px), _LEAST_PX)


def excess_scatter(bundle: CalibratedViews, noise_px: Float[np.ndarray, " points"]) -> CornerScatter:
    """The scatter at which the residuals of a bundle have the size that they should (Paule and Mandel, 1982).

    Args:
        bundle: fitted. noise_px: of all of its points, used or not.
    """
    spent = (sum(bundle.free) + 6 * len(bundle.names)) / max(2 * int(bundle.used.sum()), 1)
    # A floor keeps fits that spend nearly all of their data from dividing by nothing.
    left = max(1 - spent, 0.05)

    def of(points: Bool[np.ndarray, " points"]) -> float:
        square = (bundle.residuals_px[points] ** 2).sum(axis=1) / left
        return _excess(square, np.maximum(noise_px[points], _LEAST_PX) ** 2)

    by_view = (of(bundle.used & (bundle.view == view)) for view in range(len(bundle.names)))
    return CornerScatter(of(bundle.used), tuple(by_view))


def _excess(square: Float[np.ndarray, " n"], variance: Float[np.ndarray, " n"]) -> float:
    """``square``: of both axes together. Where noise explains them, nothing is left."""

    def surplus(excess2: float) -> float:
        return float((square / (variance + excess2)).sum()) - 2 * len(square)

    if surplus(0.0) <= 0:
        return 0.0
    # It cannot be more than if there were no noise.
    most = float(square.mean()) / 2
    return float(np.sqrt(brentq(surplus, 0.0, most * (1 + 1e-9), xtol=1e-9 * most)))
