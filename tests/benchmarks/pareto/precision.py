"""dB that the precision of the filters' arithmetic and of their stored tables costs.

The filter is computed a second time in double precision, by other code, from the same tables. Then the tables are
rounded as they would be stored with fewer bits, and the product's filter is applied.
"""

from __future__ import annotations

import enum
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import ml_dtypes
import numpy as np
from jaxtyping import Float32, Float64

from tests.benchmarks.pareto.runs import Sight
from udccal.restoration.filter_tables import FilterTables
from udccal.restoration.metrics import psnr
from udccal.restoration.runtime import Restorer, SceneLight
from udccal.restoration.scene_prior import COLOURS
from udccal.restoration.sharpen import Sharpener, Solved
from udccal.tiers import Tier

# A storage may lose so much.
LEAST_DB: Final = 0.05
_BYTES: Final = 4
# The largest power of two that an array is scaled to before it is stored in 16-bit floats.
_TOP: Final = 2.0**14


class Kind(enum.StrEnum):
    """How a number is stored."""

    float32 = "float32"
    bfloat16 = "bfloat16"
    float16 = "float16"


@dataclass(frozen=True)
class Storage:
    """How each array of the tables is stored."""

    matched: Kind = Kind.float32
    vectors: Kind = Kind.float32
    values: Kind = Kind.float32

    @property
    def name(self) -> str:
        """For a table."""
        fewer = {field: kind for field, kind in self._kinds if kind is not Kind.float32}
        if len(fewer) == len(self._kinds) and len(set(fewer.values())) == 1:
            return f"all tables in {self.matched}"
        return ", ".join(f"{field} in {kind}" for field, kind in fewer.items()) or "tables in float32"

    @property
    def _kinds(self) -> tuple[tuple[str, Kind], ...]:
        return ("matched", self.matched), ("vectors", self.vectors), ("values", self.values)

    def stored(self, tables: FilterTables) -> FilterTables:
        """Tables as they are when read back."""
        return FilterTables(
            rounded(tables.matched, self.matched),
            rounded(tables.vectors, self.vectors),
            rounded(tables.values, self.values),
        )

    def mebibytes(self, tables: FilterTables) -> float:
        """Size of the tables."""
        kinds = (tables.matched, self.matched), (tables.vectors, self.vectors), (tables.values, self.values)
        return sum(array.nbytes if kind is Kind.float32 else array.nbytes / 2 for array, kind in kinds) / 2**20


STORAGES: Final = (
    *(Storage(**{field: kind}) for kind in (Kind.bfloat16, Kind.float16) for field in ("matched", "vectors", "values")),
    *(Storage(kind, kind, kind) for kind in (Kind.bfloat16, Kind.float16)),
)


@dataclass(frozen=True)
class Loss:
    """What a precision costs: dB on the scenes (positive is worse), and the tables' size."""

    name: str
    dB: tuple[float, ...]
    tables_MiB: float

    @property
    def worst_dB(self) -> float:
        """Of all scenes; not a number where one is none."""
        return float(np.max(self.dB))


def losses_of(profile: str, sights: Iterable[Sight], keep: Path) -> list[Loss]:
    """Measure every precision on some sights in which nothing clips.

    Args:
        profile: its path or name.
        sights: what the camera took.
        keep: folder of prepared arrays.
    """
    fast = Restorer.load(profile, Tier.fast, keep=keep)
    balanced = Restorer.load(profile, Tier.balanced, keep=keep)
    sharpener = balanced.sharpener
    assert sharpener is not None
    assert fast.sharpener is not None
    doubled = list[float]()
    found: dict[Storage, list[float]] = {storage: [] for storage in STORAGES}
    for sight in sights:
        doubled.append(_double_gain_dB(fast, fast.sharpener, sight))
        given = sight.taken.frame, sight.taken.exposure_s, sight.taken.panel_picture
        whole = _dB(sight, balanced.restore(*given))
        for storage in STORAGES:
            tables = storage.stored(sharpener.tables)
            restorer = replace(balanced, sharpener=replace(sharpener, tables=tables))
            found[storage].append(whole - _dB(sight, restorer.restore(*given)))
    own_MiB = Storage().mebibytes(sharpener.tables)
    losses = [Loss("arithmetic in float32, not float64", tuple(doubled), own_MiB)]
    return losses + [
        Loss(storage.name, tuple(dB), storage.mebibytes(sharpener.tables)) for storage, dB in found.items()
    ]


def cheapest(losses: Iterable[Loss]) -> Loss:
    """The smallest tables that lose less than ``LEAST_DB`` on every scene; of equal ones, those that lose least.

    Raises:
        ValueError: when none does.
    """
    good = [loss for loss in losses if loss.worst_dB < LEAST_DB]
    if not good:
        raise ValueError(f"Expected a precision that loses less than {LEAST_DB} dB, found none.")
    return min(good, key=lambda loss: (loss.tables_MiB, loss.worst_dB))


def rounded(array: np.ndarray, kind: Kind) -> np.ndarray:
    """Round the numbers of an array as a kind stores them; its type stays.

    An array in 16-bit floats has a scale of its own, a power of two, so that its largest number is within their range.
    """
    if kind is Kind.float32:
        return array
    numbers = np.ascontiguousarray(array).view(np.float32)
    if kind is Kind.bfloat16:
        return numbers.astype(ml_dtypes.bfloat16).astype(np.float32).view(array.dtype)
    scale = np.float32(_TOP / 2.0 ** np.ceil(np.log2(max(float(np.abs(numbers).max()), 1e-30))))
    return ((numbers * scale).astype(np.float16).astype(np.float32) / scale).view(array.dtype)


def _double_gain_dB(restorer: Restorer, sharpener: Sharpener, sight: Sight) -> float:
    """dB by which the filter in double precision is better than in single precision."""
    light = restorer.scene_light(sight.taken.frame, sight.taken.exposure_s, sight.taken.panel_picture)
    single = sharpener.solved(light.signal_e, light.variance_e2, light.clipped)
    double = sharpener.layout.join(in_double(sharpener, light, single))
    onto_view = restorer.rectification.from_row(sharpener.rows.start)

    def dB(picture: Float32[np.ndarray, "rows columns 3"]) -> float:
        return _dB(sight, onto_view.apply(picture, restorer.options.interpolation) / np.float32(sight.taken.exposure_s))

    return dB(double) - dB(single.picture)


def in_double(sharpener: Sharpener, light: SceneLight, solved: Solved) -> Float32[np.ndarray, "tiles rows columns 3"]:
    """The tiles' pictures by the equations of ``mosaic_filter``, in double precision.

    Args:
        sharpener: of the tables.
        light: of the scene.
        solved: the same in single precision, of which the strengths and the noise are taken.
    """
    tiles = sharpener.layout.cut(light.signal_e)
    pictures = np.empty((*tiles.shape, 3), dtype=np.float32)
    for index, tile in enumerate(tiles):
        tables, noise_e = sharpener.tables.at(index), solved.noise_e[index].astype(np.float64)
        pictures[index] = _tile_in_double(sharpener, tile.astype(np.float64), noise_e, solved.strengths[index], tables)
    return pictures


def _tile_in_double(
    sharpener: Sharpener,
    tile: Float64[np.ndarray, "rows columns"],
    noise_e: Float64[np.ndarray, "3"],
    strength: np.float32,
    tables: FilterTables,
) -> Float64[np.ndarray, "rows columns 3"]:
    cfa = sharpener.cfa
    channels = np.array([site.channel for site in cfa.sites])
    means = np.array([tile[site.samples].mean() for site in cfa.sites])
    levels = np.array([means[channels == colour].mean() for colour in range(len(COLOURS))])
    planes = np.stack(
        [
            ((tile - levels[c]) / noise_e[c] * sharpener.layout.taper)[site.samples]
            for c, site in zip(channels, cfa.sites, strict=True)
        ]
    )
    vectors = tables.vectors.astype(np.complex128)
    whitened = np.einsum("ijyx,jyx->iyx", vectors, np.fft.rfft2(planes))
    weighted = whitened / (tables.values.astype(np.float64) + 1 / np.float64(strength))
    by_site = np.einsum("jiyx,jyx->iyx", vectors.conj(), weighted)
    mixed = np.einsum(
        "ac,cpyx->apyx",
        COLOURS,
        np.stack([_of_colour(tables, by_site, channels == colour) for colour in range(len(COLOURS))]),
    )
    picture = np.empty((*tile.shape, len(COLOURS)))
    for place, (y, x) in enumerate(np.ndindex(cfa.rows, cfa.columns)):
        part = np.fft.irfft2(mixed[:, place], s=planes.shape[1:])
        picture[y :: cfa.rows, x :: cfa.columns] = np.moveaxis(part, 0, -1)
    return picture * noise_e + levels


def _of_colour(tables: FilterTables, by_site: np.ndarray, sites: np.ndarray) -> np.ndarray:
    return np.einsum("psyx,syx->pyx", tables.matched[:, sites].astype(np.complex128), by_site[sites])


def _dB(sight: Sight, linear: Float32[np.ndarray, "rows columns 3"]) -> float:
    return psnr(sight.after(linear), sight.truth)
