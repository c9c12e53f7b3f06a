"""Noise after EMVA 1288: what dark frames and flats tell of the sensor. ``fit`` reads sessions, ``frames`` arrays."""

from udccal.fitting.noise.fit import fit_noise, nominal_noise
from udccal.fitting.noise.frames import ExposureLevel, SpatialStack, fit_noise_frames

__all__ = ["ExposureLevel", "SpatialStack", "fit_noise", "fit_noise_frames", "nominal_noise"]
