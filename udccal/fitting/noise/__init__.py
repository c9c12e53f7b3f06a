"""Noise after EMVA 1288: what dark frames and flats tell of the sensor."""

from udccal.fitting.noise.data import ExposureLevel, NoiseData, SpatialStack, read_noise
from udccal.fitting.noise.fit import fit_noise, mean_response, nominal_noise
from udccal.fitting.noise.rules import NoiseRules

__all__ = [
    "ExposureLevel",
    "NoiseData",
    "NoiseRules",
    "SpatialStack",
    "fit_noise",
    "mean_response",
    "nominal_noise",
    "read_noise",
]
