"""Lens, panel and board poses. ``fit_geometry`` takes arrays of corners, ``fit_boards`` the views of a session."""

from udccal.fitting.geometry.boards import fit_boards
from udccal.fitting.geometry.bundle import GeometryRules, Intrinsics
from udccal.fitting.geometry.calibrated import CalibratedViews, Gauge
from udccal.fitting.geometry.data import GeometryData, read_geometry
from udccal.fitting.geometry.fit import fit_geometry

__all__ = [
    "CalibratedViews",
    "Gauge",
    "GeometryData",
    "GeometryRules",
    "Intrinsics",
    "fit_boards",
    "fit_geometry",
    "read_geometry",
]
