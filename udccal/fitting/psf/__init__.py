"""Diffraction by the pixel rows as a field over the sensor, from brackets of an LED. ``fit`` reads sessions."""

from udccal.fitting.psf.fit import Effort, fit_psf, fit_shots, fit_shots_fully

__all__ = ["Effort", "fit_psf", "fit_shots", "fit_shots_fully"]
