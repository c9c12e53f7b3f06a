"""Lens, panel and board poses. ``fit`` reads sessions, ``bundle`` takes arrays of corners."""

from udccal.fitting.geometry.bundle import CalibratedViews, Gauge, Prior, calibrate_views
from udccal.fitting.geometry.fit import fit_views

__all__ = ["CalibratedViews", "Gauge", "Prior", "calibrate_views", "fit_views"]
