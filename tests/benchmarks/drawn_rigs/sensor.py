"""The sensor of a drawn rig: from light to numbers."""

from __future__ import annotations

import numpy as np

from tests.benchmarks.drawn_rigs.draw import Rig


class DrawnSensor:
    """One sensor with its own patterns; every frame has new noise."""

    def __init__(self, rig: Rig) -> None:
        self.noise = rig.noise
        self.rng = np.random.default_rng([rig.seed, 5])
        shape, noise = (rig.rows, rig.columns), rig.noise
        self.response = 1 + self._even(shape, noise.PRNU) + self._even((1, rig.columns), noise.columns_PRNU)
        self.offset = self._even(shape, noise.DSNU_e) + self._even((1, rig.columns), noise.columns_DSNU_e)
        self.restless = self.rng.random(shape) < (noise.tails if noise.kind == "telegraph" else 0.0)

    @property
    def sigma_d_e(self) -> float:
        """Root mean square of the dark noise over all pixels and frames, rounding excluded."""
        jumps = self.restless.mean() * _JUMP**2 * 2 / 9
        return float(np.hypot(self.noise.read_e * np.sqrt(1 + jumps), self.noise.row_DN / self.noise.K_DN_per_e))

    def frame(
        self, rate: np.ndarray, exposure_s: float, x: int = 0, y: int = 0, columns: int = 0, rows: int = 0
    ) -> np.ndarray:
        """One frame of a region; ``rate`` in e-/s is the region's own, or the whole sensor's."""
        noise, rng = self.noise, self.rng
        part = np.s_[y : y + (rows or len(self.response)), x : x + (columns or self.response.shape[1])]
        rate = rate[part] if rate.shape == self.response.shape else rate
        electrons = self._counted((rate * self.response[part] + noise.dark_e_per_s) * exposure_s)
        # The bend is a parabola, which would fall again far beyond the full well.
        electrons = np.minimum(electrons, 2 * noise.well_e)
        electrons = np.minimum(electrons * (1 - noise.bend * electrons / noise.well_e), noise.well_e)
        electrons = electrons + self.offset[part] + self._read(electrons.shape, self.restless[part])
        rows_DN = rng.normal(0, noise.row_DN, (len(electrons), 1))
        values = noise.black_DN + noise.K_DN_per_e * electrons + rows_DN
        return np.clip(np.rint(values), 0, 2**noise.bits - 1).astype(np.uint16)

    def _even(self, shape: tuple[int, int], sigma: float) -> np.ndarray:
        """A pattern of exactly this deviation."""
        drawn = self.rng.normal(size=shape)
        return sigma * (drawn - drawn.mean()) / drawn.std()

    def _counted(self, mean: np.ndarray) -> np.ndarray:
        """Poisson counts; those of much light are normal, with Poisson's skewness."""
        z = self.rng.standard_normal(mean.shape, np.float32)
        many = mean + np.sqrt(mean) * z + (z * z - 1) / 6
        few = mean < 100
        many[few] = self.rng.poisson(mean[few])
        return many

    def _read(self, shape: tuple[int, ...], restless: np.ndarray) -> np.ndarray:
        """Read noise of unit variance times its size; restless pixels jump between three levels as well."""
        noise, rng = self.noise, self.rng
        if noise.kind == "Student":
            return noise.read_e * rng.standard_t(noise.tails, shape) / np.sqrt(noise.tails / (noise.tails - 2))
        jump = rng.choice([-1.0, 0.0, 1.0], shape, p=[1 / 9, 7 / 9, 1 / 9]) if restless.any() else 0.0
        return noise.read_e * (rng.standard_normal(shape, np.float32) + _JUMP * jump * restless)


# Size of a telegraph pixel's jumps, in sigma of its read noise.
_JUMP = 5.0
