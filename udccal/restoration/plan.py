"""What restoration computes once per profile, and the options that trade accuracy for time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from udccal.arguments import check_count
from udccal.errors import RestorationError
from udccal.kernels import KERNEL_COLUMNS, KERNEL_ROWS, fitted_size, kernels_at
from udccal.models.psf import PsfField
from udccal.restoration.kernel_grid import KernelGrid
from udccal.restoration.rectify import Interpolation
from udccal.restoration.tiles import LEAST_PX
from udccal.rig import RigDescription

_CHANNELS = 3
# A kernel sums to 1. If its absolute values sum to more than this, it is not a kernel.
_MOST_LIGHT = 10.0
# Least and largest value of each option that is a whole number.
_BOUNDS: Final = {
    "kernel_rows": (1, 16384),
    "kernel_columns": (1, 16384),
    "grid_rows": (1, 256),
    "grid_columns": (1, 256),
    "tile_rows": (LEAST_PX, 16384),
    "tile_columns": (LEAST_PX, 16384),
    "network_views": (1, 4),
    "lamps": (0, 1000),
    "workers": (1, 256),
}


@dataclass(frozen=True)
class PlanOptions:
    """Accuracy against time; the defaults were measured on full-size simulated scenes.

    Attributes:
        kernel_rows, kernel_columns: largest size of the kernels in px, odd. A smaller sensor, or a psf with less
            support, gets smaller kernels.
        grid_rows, grid_columns: field positions at which the psf is evaluated.
        tile_rows, tile_columns: size in px of the tiles, each of which has one prior; those within a fifth of the
            frame share a kernel.
        interpolation: with which sharp pictures are resampled onto the view.
        network_views: ways round in which the network of the tier ``accurate`` sees the picture, 1 to 4.
        lamps: most pieces of clipped samples that the tier ``accurate`` tries as lamps; 0 to leave their halos.
        workers: threads where they save time.

    Raises:
        RestorationError: when one is no whole number that it may be, the size of kernels is even, or
            ``interpolation`` is no ``Interpolation``.
    """

    kernel_rows: int = KERNEL_ROWS
    kernel_columns: int = KERNEL_COLUMNS
    grid_rows: int = 7
    grid_columns: int = 9
    tile_rows: int = 192
    tile_columns: int = 160
    interpolation: Interpolation = Interpolation.CUBIC
    network_views: int = 4
    lamps: int = 24
    workers: int = 2

    def __post_init__(self) -> None:
        for name, (least, most) in _BOUNDS.items():
            check_count(getattr(self, name), f"PlanOptions.{name}", least, most, RestorationError)
        for name in ("kernel_rows", "kernel_columns"):
            if (size := getattr(self, name)) % 2 == 0:
                raise RestorationError(
                    f"Expected PlanOptions.{name} to be odd, found {size}: a kernel has a middle. Give {size + 1}."
                )
        if not isinstance(self.interpolation, Interpolation):
            names = ", ".join(f"Interpolation.{each.name}" for each in Interpolation)
            raise RestorationError(
                f"Expected PlanOptions.interpolation to be one of {names}, found {self.interpolation!r:.80}. Give one."
            )


def checked_options(options: PlanOptions | None) -> PlanOptions:
    """Return the options, or the defaults for None.

    Raises:
        RestorationError: when they are something else.
    """
    if options is None:
        return PlanOptions()
    if not isinstance(options, PlanOptions):
        raise RestorationError(f"Expected options as PlanOptions, found {options!r:.80}. Give PlanOptions(...).")
    return options


def kernel_grid(psf: PsfField, rig: RigDescription, options: PlanOptions) -> KernelGrid:
    """Evaluate the psf at a grid of positions that spans the sensor from edge to edge.

    Raises:
        RestorationError: when the psf's values there are not kernels.
    """
    camera = rig.camera
    x = np.linspace(0.0, camera.columns - 1.0, options.grid_columns)
    y = np.linspace(0.0, camera.rows - 1.0, options.grid_rows)
    rows, columns = fitted_size(psf, rig, options.kernel_rows, options.kernel_columns)
    positions = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    kernels = kernels_at(psf, positions, rows, columns, options.workers)
    light = np.abs(kernels).sum(axis=(2, 3))
    if not np.all(light <= _MOST_LIGHT):
        raise RestorationError(
            f"Expected kernels that sum to 1 with hardly any negative values, found one whose absolute values sum to "
            f"{light.max():g}. Check the psf and geometry terms, or calibrate the rig again."
        )
    return KernelGrid(x, y, kernels.reshape(len(y), len(x), _CHANNELS, rows, columns))
