"""Tables of the filter for pictures that have all three colours at every pixel.

Without aliases, the samples' covariance at a frequency is a diagonal matrix and one of rank one,

    s B + 1 = D + s d e h h^H,   D = 1 + s d c |h|^2,

where h holds the colours' transfers, d the prior's density, and c and e what a colour has for itself and what all have
in common. Its inverse is a closed formula (Sherman and Morrison, 1950), so that nothing is computed ahead but h.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Final, final

import numpy as np
from jaxtyping import Complex64, Float32, Int
from scipy import fft

from udccal.cfa import BLUE, GREEN, RED, Site
from udccal.restoration.filter_tables import SPARSE, power_of
from udccal.restoration.kernel_grid import KernelGrid, centred, interpolated_kernels
from udccal.restoration.scene_prior import COLOURFUL, COMMON, prior_density
from udccal.restoration.tiles import TileLayout

_EVERY = (slice(None), slice(None))


@final
@dataclass(frozen=True, eq=False)
class _ThreeColours:
    """The pattern of pictures that have all colours at every pixel. There is one; it is compared by identity."""

    sites: tuple[Site, ...] = tuple(Site(0, 0, channel, _EVERY) for channel in (RED, GREEN, BLUE))
    rows: int = 1
    columns: int = 1


THREE_COLOURS: Final = _ThreeColours()


@final
@dataclass(frozen=True)
class ColourTables:
    """``Tables`` of one kernel, or of several, for three colours at every pixel.

    Attributes:
        transfer: h, by colour. density: c d, the prior's power of what each colour has for itself, at strength 1.
    """

    transfer: Complex64[np.ndarray, "*kernels 3 rows half"]
    density: Float32[np.ndarray, "rows half"]

    @property
    def matched(self) -> Complex64[np.ndarray, "*kernels 1 3 rows half"]:
        """Prior power times the conjugate transfer, as of one place."""
        return (np.conjugate(self.transfer) * (self.density / np.float32(COLOURFUL)))[..., None, :, :, :]

    def at(self, kernels: int | Int[np.ndarray, " some"]) -> ColourTables:
        """Return the tables of one kernel, or of several."""
        return ColourTables(self.transfer[kernels], self.density)

    def along(self, spectra: Complex64[np.ndarray, "3 rows half"]) -> Complex64[np.ndarray, "3 rows half"]:
        """Return the spectra as they are."""
        return spectra

    def costs(
        self, along: Complex64[np.ndarray, "3 rows half"], samples: float
    ) -> Callable[[Float32[np.ndarray, " some"]], Float32[np.ndarray, " some"]]:
        """Return the likelihood of every n-th frequency, ready for any strengths; see ``Tables``."""
        some, h = along[:, ::SPARSE, ::SPARSE] / np.sqrt(np.float32(samples)), self.transfer[:, ::SPARSE, ::SPARSE]
        density = self.density[::SPARSE, ::SPARSE]
        power, size, product = power_of(some), power_of(h), np.conjugate(h) * some

        def cost(strength: np.float32) -> np.float32:
            own = strength * density
            weight = 1 / (1 + own * size)
            shared = own * np.float32(COMMON)
            beyond = 1 + shared * (size * weight).sum(axis=0)
            explained = shared * power_of((product * weight).sum(axis=0)) / beyond
            found: np.float32 = (power * weight - np.log(weight)).sum() + (np.log(beyond) - explained).sum()
            return found

        return lambda strengths: np.array([cost(one) for one in strengths], dtype=np.float32)

    def solved(
        self, along: Complex64[np.ndarray, "3 rows half"], strength: np.float32
    ) -> Complex64[np.ndarray, "3 rows half"]:
        """Return (B + 1 / s)^-1 Y; ``along`` is overwritten."""
        own = strength * self.density
        size = power_of(self.transfer)
        weight = strength / (1 + own * size)
        shared = self.density * np.float32(COMMON)
        along *= weight
        in_common = (np.conjugate(self.transfer) * along).sum(axis=0)
        in_common *= shared / (1 + shared * (size * weight).sum(axis=0))
        along -= self.transfer * (weight * in_common)
        return along


def colour_tables(grid: KernelGrid, layout: TileLayout, workers: int) -> ColourTables:
    """Compute the tables of every kernel of a layout, for pictures with three colours at every pixel.

    Args:
        grid: kernels over the picture.
        layout: the tiles.
        workers: threads.
    """
    kernels = interpolated_kernels(grid, layout.kernel_px)
    transfer = np.empty((len(kernels), 3, layout.rows, layout.columns // 2 + 1), dtype=np.complex64)

    def one(index: int) -> None:
        placed = np.stack([centred(kernel, layout.rows, layout.columns) for kernel in kernels[index]])
        transfer[index] = fft.rfft2(placed.astype(np.float32))

    with ThreadPoolExecutor(workers) as pool:
        list(pool.map(one, range(len(kernels))))
    density = COLOURFUL * prior_density(layout.rows, layout.columns)[:, : transfer.shape[3]]
    return ColourTables(transfer, density.astype(np.float32))
