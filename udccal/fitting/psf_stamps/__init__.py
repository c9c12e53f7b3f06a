"""A smooth psf field from stamps of point sources, of mosaics too."""

from udccal.fitting.psf_stamps.data import Stamps, StampsRules, mosaic_channels
from udccal.fitting.psf_stamps.fit import fit_psf_stamps
from udccal.fitting.psf_stamps.term import StampsPsf

__all__ = ["Stamps", "StampsPsf", "StampsRules", "fit_psf_stamps", "mosaic_channels"]
