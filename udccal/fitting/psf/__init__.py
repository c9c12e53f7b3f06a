"""Diffraction by the pixel rows as a field over the sensor, from brackets of an LED: ``read_psf``, then ``fit_psf``."""

from udccal.fitting.psf.data import PsfData, read_psf
from udccal.fitting.psf.fit import fit_psf, nominal_psf
from udccal.fitting.psf.start import PsfRules

__all__ = ["PsfData", "PsfRules", "fit_psf", "nominal_psf", "read_psf"]
