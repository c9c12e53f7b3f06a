"""Diffraction by the pixel rows as a field over the sensor, from brackets of an LED: start with ``fit.fit_psf``."""
