"""What a geometry fit found, beside its numbers: diagnostics, residuals, corners left out, and what was held."""

from __future__ import annotations

import numpy as np

from udccal.fitting.geometry.bundle_noise import OUTLIER_RULE
from udccal.fitting.geometry.bundle_orders import INTRINSIC_NAMES
from udccal.fitting.geometry.calibrated_views import CalibratedViews
from udccal.fitting.geometry.corner_scatter import CornerScatter
from udccal.fitting.geometry.views import BoardView
from udccal.result import Diagnostic, Outliers, ResidualSample

# Scatter beside noise of the board on the jig, and of the median view of others: a plan reads them.
ON_JIG, BY_HAND = "corner_scatter_on_jig", "corner_scatter_by_hand"
PATTERN = "residual_pattern"
_MOST_RESIDUALS = 2000


def diagnostics_of(bundle: CalibratedViews, scatter: CornerScatter, views: list[BoardView]) -> tuple[Diagnostic, ...]:
    """``views`` are those that the bundle uses."""
    evidence = bundle.evidence
    on_jig = [one for one, view in zip(scatter.by_view_px, views, strict=True) if view.parallel]
    by_hand = [one for one, view in zip(scatter.by_view_px, views, strict=True) if not view.parallel]
    return (
        Diagnostic("rms_reprojection", bundle.rms_px, "px"),
        Diagnostic("corner_scatter_beside_noise", scatter.excess_px, "px"),
        Diagnostic(ON_JIG, float(np.median(on_jig)), "px"),
        Diagnostic(BY_HAND, float(np.median(by_hand or on_jig)), "px"),
        Diagnostic("views", float(len(bundle.names)), "1"),
        Diagnostic("corners_used", float(bundle.used.sum()), "1"),
        Diagnostic("corners_rejected", float((~bundle.used).sum()), "1"),
        Diagnostic("iterations", float(bundle.iterations), "1"),
        Diagnostic("starts_agreeing", float(bundle.starts_agreeing), "1"),
        Diagnostic("rms_held_out", evidence.held_out_rms_px, "px"),
        Diagnostic("rms_held_out_expected", evidence.expected_rms_px, "px"),
        Diagnostic("views_disagree_p", evidence.views.p_value, "1"),
        Diagnostic("variance_factor", evidence.variance_factor, "1"),
        Diagnostic("residual_pattern_p", evidence.pattern.p_value, "1"),
        Diagnostic(PATTERN, evidence.pattern_px, "px"),
    )


def residual_sample(bundle: CalibratedViews) -> ResidualSample:
    """Both coordinates of evenly drawn corners in use, in sigma."""
    use = np.flatnonzero(bundle.used)
    drawn = use[:: max(1, -(-len(use) // _MOST_RESIDUALS))]
    z = bundle.residuals_px[drawn] / bundle.sigma_px[drawn, None]
    return ResidualSample(np.repeat(bundle.points_px[drawn], 2, axis=0), z.ravel())


def rejections(bundle: CalibratedViews, views: list[BoardView]) -> tuple[str, ...]:
    """One sentence per view that lost corners."""
    return tuple(
        f"{step}: corners {', '.join(map(str, corners))} left out, {OUTLIER_RULE}."
        for step, corners in _corners_out(bundle, views)
    )


def outliers_of(bundle: CalibratedViews, views: list[BoardView]) -> tuple[Outliers, ...]:
    """Corners by step and number, and what the bundle left out for other reasons."""
    places = [f"{step} corner {corner}" for step, corners in _corners_out(bundle, views) for corner in corners]
    found = (Outliers(OUTLIER_RULE, len(places), tuple(places[:20])),) if places else ()
    return (*(other for other in bundle.outliers if other.rule != OUTLIER_RULE), *found)


def _corners_out(bundle: CalibratedViews, views: list[BoardView]) -> list[tuple[str, list[int]]]:
    """Steps that lost corners, and the numbers of those."""
    lost = []
    for k, view in enumerate(views):
        out = bundle.index[(bundle.view == k) & ~bundle.used]
        if len(out):
            lost.append((view.step_id, [int(corner) for corner in view.corners.ids[out]]))
    return lost


def held_notes(bundle: CalibratedViews) -> tuple[str, ...]:
    """What was not fitted."""
    held = [name for name, free in zip(INTRINSIC_NAMES, bundle.free, strict=True) if not free]
    fixed = (f"Held at 0, as the data do not ask for it: {', '.join(held)}.",) if held else ()
    return (*fixed, "Stand-off and panel position are the rig's nominal ones; the wire fit refines them.")
