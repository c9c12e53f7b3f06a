"""Lens, panel and board poses. ``fit`` reads sessions, ``bundle`` takes arrays of corners."""

from udccal.fitting.geometry.bundle import calibrate_views
from udccal.fitting.geometry.bundle_projection import Gauge
from udccal.fitting.geometry.bundle_solve import Prior
from udccal.fitting.geometry.calibrated_views import CalibratedViews
from udccal.fitting.geometry.fit import fit_views

__all__ = ["CalibratedViews", "Gauge", "Prior", "calibrate_views", "fit_views"]
