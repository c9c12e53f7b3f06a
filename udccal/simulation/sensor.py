"""The sensor: from light to electrons to numbers, with realistic noise (EMVA 1288, and ELD for the read noise).

Order of events: photo-response (PRNU), dark current, photon counting, full well, dark offset (DSNU) and read noise,
gain, row noise, black level, rounding, and the range of the converter.
"""

from __future__ import annotations

from typing import final

import numpy as np
from jaxtyping import Float, Float32, UInt16
from scipy.special import boxcox

from udccal.cameras.protocol import Region
from udccal.simulation.truth import RigTruth, SensorTruth

_ROWS_AT_ONCE = 64
_TABLE = 65536
# Above this, photon counts are drawn from a normal distribution corrected to Poisson's mean, variance and third moment.
# They are not rounded: read noise of more than one electron makes whole numbers unobservable.
_COUNTED_ONE_BY_ONE_BELOW_E = 50.0
_HOT_CURRENT_E_PER_S = (300.0, 6000.0)


@final
class Sensor:
    """One sensor with its own fixed patterns, drawn from the truth's seed."""

    def __init__(self, truth: RigTruth) -> None:
        camera, sensor = truth.description.camera, truth.sensor
        shape = (camera.rows, camera.columns)
        rng = np.random.default_rng([truth.seed, 0x5E25])
        self.truth: SensorTruth = sensor
        self.response: Float32[np.ndarray, "rows columns"] = _pattern(rng, shape, 1.0, sensor.PRNU1288)
        self.offset_e: Float32[np.ndarray, "rows columns"] = _pattern(rng, shape, 0.0, sensor.DSNU1288_e)
        self.dark_current_e_per_s: Float32[np.ndarray, "rows columns"] = _dark_current(rng, shape, sensor)
        self._read_noise_e = tukey_lambda_quantiles(sensor.lambda_read, sensor.sigma_read_e)

    @property
    def sigma_d_e(self) -> float:
        """Temporal dark noise of a short frame: read and row noise, without quantisation."""
        return float(np.hypot(self.truth.sigma_read_e, self.truth.sigma_row_DN / self.truth.K_DN_per_e))

    @property
    def saturation_DN(self) -> float:
        """Signal of a saturated pixel at 0 dB: the full well or the converter's maximum, whichever is lower."""
        full = self.truth.black_DN + self.truth.K_DN_per_e * self.truth.full_well_e
        return float(min(full, 2.0**self.truth.bits - 1))

    def expose(
        self,
        rate_e_per_s: Float[np.ndarray, "rows columns"],
        exposure_s: float,
        region: Region,
        rng: np.random.Generator,
        gain_dB: float = 0.0,
    ) -> UInt16[np.ndarray, "rows columns"]:
        """Return a frame of ``region`` in DN for the expected photo-electron rates of its pixels."""
        frame = np.empty((region.rows, region.columns), np.uint16)
        amplification = 10 ** (gain_dB / 20)
        row_DN = amplification * self.truth.sigma_row_DN * rng.standard_normal((region.rows, 1), np.float32)
        across = slice(region.x, region.x + region.columns)
        for top in range(0, region.rows, _ROWS_AT_ONCE):
            part = slice(top, min(top + _ROWS_AT_ONCE, region.rows))
            down = slice(region.y + part.start, region.y + part.stop)
            expected = self.response[down, across] * rate_e_per_s[part].astype(np.float32)
            expected += self.dark_current_e_per_s[down, across]
            expected *= np.float32(exposure_s)
            signal = np.minimum(_counted(expected, rng), np.float32(self.truth.full_well_e))
            signal += self.offset_e[down, across]
            signal += self._read_noise(signal.shape, rng)
            signal *= np.float32(self.truth.K_DN_per_e * amplification)
            signal += row_DN[part] + np.float32(self.truth.black_DN)
            frame[part] = np.clip(np.rint(signal, out=signal), 0, 2**self.truth.bits - 1)
        return frame

    def _read_noise(self, shape: tuple[int, ...], rng: np.random.Generator) -> Float32[np.ndarray, "rows columns"]:
        draws = np.frombuffer(rng.bytes(2 * int(np.prod(shape))), np.uint16)
        return self._read_noise_e[draws].reshape(shape)


def tukey_lambda_quantiles(shape: float, sigma: float) -> Float32[np.ndarray, "table"]:
    """Return equally likely values of Tukey's lambda distribution, scaled to the standard deviation ``sigma``.

    Q(p) = (p^lambda - (1 - p)^lambda) / lambda; 0.14 is close to normal, smaller values have heavier tails (Wei et
    al., "A physics-based noise formation model for extreme low-light raw denoising", 2020).
    """
    p = (np.arange(_TABLE) + 0.5) / _TABLE
    values = boxcox(p, shape) - boxcox(1 - p, shape)
    return (values * (sigma / values.std())).astype(np.float32)


def _counted(
    expected: Float32[np.ndarray, "rows columns"], rng: np.random.Generator
) -> Float32[np.ndarray, "rows columns"]:
    """Draw Poisson counts, large ones as m + sqrt(m - 1/18) z + (z^2 - 1) / 6 (Cornish-Fisher expansion)."""
    few = expected < _COUNTED_ONE_BY_ONE_BELOW_E
    if few.all():
        return rng.poisson(expected).astype(np.float32)
    z = rng.standard_normal(expected.shape, np.float32)
    counts = np.sqrt(np.maximum(expected - np.float32(1 / 18), 0))
    counts *= z
    counts += expected
    z *= z
    z -= 1
    z /= 6
    counts += z
    if few.any():
        counts[few] = rng.poisson(expected[few])
    return counts


def _pattern(
    rng: np.random.Generator, shape: tuple[int, int], mean: float, sigma: float
) -> Float32[np.ndarray, "rows columns"]:
    # Of exactly this mean and deviation: EMVA 1288's PRNU and DSNU are those of the sensor at hand.
    drawn = rng.standard_normal(shape, np.float32)
    return np.float32(mean) + np.float32(sigma) * (drawn - drawn.mean()) / drawn.std()


def _dark_current(
    rng: np.random.Generator, shape: tuple[int, int], sensor: SensorTruth
) -> Float32[np.ndarray, "rows columns"]:
    current = np.full(shape, sensor.dark_current_e_per_s, np.float32)
    hot = rng.random(shape) < sensor.hot_fraction
    low, high = np.log(_HOT_CURRENT_E_PER_S)
    current[hot] = np.exp(rng.uniform(low, high, int(hot.sum())))
    return current
