"""Stamps of point sources as arrays, checked, and sorted by colour; the constants of their fit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Bool, Float, Int

from udccal.cfa import channel_map
from udccal.errors import FitError

_FEWEST_PX, _MOST_PX = 7, 255
_MOST_SAMPLES = 2**26
WINDOW_PX, _CENTRING = 1.6, 15  # of first centroids: a Gaussian's standard deviation, and rounds


@final
@dataclass(frozen=True)
class Stamps:
    """What a fit is given: each stamp is cut about one point source; what else shines has been subtracted.

    Attributes:
        values_e: samples in electrons; NaN where nothing is known.
        position_px: of each stamp's middle sample (``rows // 2, columns // 2``) on the sensor, (x, y).
        read_e: standard deviation of a sample's noise without light, in electrons, quantisation included.
        clip_e: samples at or above it tell only that they are so.
        channel: of each sample (0 = R, 1 = G, 2 = B) of raw mosaics; ``None`` where all samples are of one kind.
    """

    values_e: Float[np.ndarray, "stars rows columns"]
    position_px: Int[np.ndarray, "positions 2"]
    read_e: float
    clip_e: float = np.inf
    channel: Int[np.ndarray, "*channels"] | None = None

    def __post_init__(self) -> None:
        _check(self)

    @property
    def planes(self) -> int:
        """How many colours there are."""
        return 1 if self.channel is None else int(self.channel.max()) + 1


@final
@dataclass(frozen=True)
class StampsRules:
    """The constants of a fit of stamps.

    Attributes:
        fewest_stars: that are fitted at all.
        least_snr: light over noise of the median stamp.
        fewest_unclipped: stamps, at least, whose core (``core_px`` about the middle) is neither clipped nor missing.
        outlier_sigma: samples further off, in robust sigma, are left out.
        star_ratio, star_lost: stamps are left out whose mean square is over so many times the median's, or that lose
            more than such a part of their samples.
        coarse: degrees of map and images, and the relative error of the model that is allowed for, of the fits that
            lead from a round star to a field.
        coarse_steps: of each of these.
        spacings_px: of nodes, the coarsest first.
        worth_finer: nodes are made denser again where the criterion may still fall by so much.
        highest_map, highest_image: degrees.
        steps_to_judge, steps_to_judge_new, steps_to_end: of one fit at most: of candidates, of those with a degree that
            comes new, and of the fit that is given.
        gain, evidence: converged when one more step would raise the log posterior by less, and the last one raised the
            log evidence by less.
        beyond_doubt: log evidence; candidates expected to lose more are not fitted.
        worth_fitting: nor those expected to gain less than this part of what their precisions cost.
        first_image, first_map, first_lateral: precisions before the data: of images of degree 0 (size, roughness) and
            of higher ones, of maps and of lateral colour by degree.
        new_image, new_map: of a degree that comes new, relative to the degree below it, and as it is: nearly absent.
            Where the data ask for it, one update makes it appear.
        update_draws, draws: of the posterior: for updates of precisions, and for error bars (5 % of a sigma).
        inflate_above: reduced chi-squared above which every sigma grows with its root. Counts are skewed: theirs
            scatters more than that of normal samples.
        poor_above: reduced chi-squared beyond which this is no psf field.
    """

    fewest_stars: int = 4
    least_snr: float = 10.0
    fewest_unclipped: int = 3
    core_px: float = 1.5
    outlier_sigma: float = 5.0
    star_ratio: float = 3.0
    star_lost: float = 0.2
    coarse: tuple[tuple[int, int, float], ...] = ((0, 0, 0.3), (0, 0, 0.1), (2, 0, 0.05), (2, 1, 0.02))
    coarse_steps: int = 2
    spacings_px: tuple[float, ...] = (1.0, 0.75, 0.5)
    worth_finer: float = 200.0
    highest_map: int = 4
    highest_image: int = 3
    steps_to_judge: int = 2
    steps_to_judge_new: int = 1
    steps_to_end: int = 12
    gain: float = 0.3
    evidence: float = 2.0
    beyond_doubt: float = 200.0
    worth_fitting: float = 0.5
    first_image: tuple[tuple[float, float], tuple[float, float]] = ((1e-3, 1e-4), (30.0, 30.0))
    first_map: float = 100.0
    first_lateral: float = 10.0
    new_image: float = 20.0
    new_map: float = 3e4
    update_draws: int = 16
    draws: int = 192
    inflate_above: float = 1.05
    poor_above: float = 2.0


def mosaic_channels(
    cfa: str, position_px: Int[np.ndarray, "stars 2"], rows: int, columns: int
) -> Int[np.ndarray, "stars rows columns"]:
    """Channels of stamps cut from a mosaic whose first 2 x 2 cell is ``cfa``; for ``Stamps.channel``.

    Raises:
        ValueError: when ``cfa`` is not four letters of R, G, B.
    """
    cell = channel_map(cfa, 2, 2)
    y = position_px[:, 1, None] - rows // 2 + np.arange(rows)
    x = position_px[:, 0, None] - columns // 2 + np.arange(columns)
    return cell[y[:, :, None] % 2, x[:, None, :] % 2]


@dataclass(frozen=True)
class Plane:
    """The samples of one colour; stamps that hold fewer than others are padded with samples that are not used.

    Attributes:
        offset_px: (x, y) from each stamp's middle sample.
        value_e: zero where not used.
        usable: whether a sample tells something.
        clipped: whether it tells only that it is at or above the clipping.
        place: flat index of the sample in its stamp.
    """

    offset_px: Float[np.ndarray, "stars samples 2"]
    value_e: Float[np.ndarray, "stars samples"]
    usable: Bool[np.ndarray, "stars samples"]
    clipped: Bool[np.ndarray, "stars samples"]
    place: Int[np.ndarray, "stars samples"]


@dataclass(frozen=True)
class Scene:
    """What does not change during a fit.

    Attributes:
        planes: samples by colour.
        unit: positions scaled to about [-1, 1].
        shape: rows and columns of a stamp.
        read_e, clip_e: of the samples' noise.
    """

    planes: tuple[Plane, ...]
    unit: Float[np.ndarray, "stars 2"]
    shape: tuple[int, int]
    read_e: float
    clip_e: float

    @property
    def samples(self) -> int:
        """That tell something."""
        return sum(int(plane.usable.sum()) for plane in self.planes)


def split(stamps: Stamps) -> tuple[Plane, ...]:
    """The stamps colour by colour."""
    count, rows, columns = stamps.values_e.shape
    channel = np.zeros((count, rows * columns), dtype=np.int64)
    if stamps.channel is not None:
        channel = stamps.channel.reshape(count, -1).astype(np.int64)
    return tuple(_plane(stamps, channel == colour) for colour in range(stamps.planes))


def centroids(planes: tuple[Plane, ...], stars: int) -> Float[np.ndarray, "stars 2"]:
    """Under a Gaussian that follows, all colours alike: of light per sample, each colour by its own number of them."""
    centre = np.zeros((stars, 2))
    for _ in range(_CENTRING):
        top, bottom = np.zeros((stars, 2)), np.zeros(stars)
        for plane in planes:
            off = plane.offset_px - centre[:, None]
            weight = plane.usable * np.exp(-0.5 * (off**2).sum(axis=2) / WINDOW_PX**2)
            light = weight * np.maximum(plane.value_e, 0.0)
            # The mean under the weight alone is taken off: samples of a mosaic do not lie evenly about the centre.
            mean = np.einsum("ks,ksi->ki", weight, off) / np.maximum(weight.sum(axis=1), 1e-300)[:, None]
            top += np.einsum("ks,ksi->ki", light, off - mean[:, None])
            bottom += light.sum(axis=1)
        move = 2 * top / np.maximum(bottom, 1e-300)[:, None]
        centre = np.clip(centre + np.clip(move, -1.0, 1.0), -3.0, 3.0)
    return centre


def light_of(plane: Plane, read_e: float) -> Float[np.ndarray, " stars"]:
    """Sums, scaled up for samples that are missing; in light per pixel of all colours."""
    known = np.maximum(plane.usable.sum(axis=1), 1)
    total = (plane.value_e * plane.usable).sum(axis=1)
    pixels = int(plane.place.max()) + 1
    return np.maximum(total * pixels / known, 10 * read_e)


def _plane(stamps: Stamps, own: Bool[np.ndarray, "stars pixels"]) -> Plane:
    count, rows, columns = stamps.values_e.shape
    most = int(own.sum(axis=1).max())
    # Stable: a stamp's own samples first, in their order.
    place = np.argsort(~own, axis=1, kind="stable")[:, :most]
    value = np.take_along_axis(stamps.values_e.reshape(count, -1), place, axis=1)
    usable = np.take_along_axis(own, place, axis=1) & np.isfinite(value)
    y, x = np.divmod(place, columns)
    return Plane(
        offset_px=np.stack([x - columns // 2, y - rows // 2], axis=-1).astype(np.float64),
        value_e=np.where(usable, value, 0.0),
        usable=usable,
        clipped=usable & (value >= stamps.clip_e),
        place=place,
    )


def _check(stamps: Stamps) -> None:
    count, rows, columns = stamps.values_e.shape
    if min(rows, columns) < _FEWEST_PX or max(rows, columns) > _MOST_PX:
        raise FitError(
            f"Expected stamps of {_FEWEST_PX} to {_MOST_PX} samples a side, found {rows} x {columns}. Cut them anew."
        )
    if stamps.values_e.size > _MOST_SAMPLES:
        raise FitError(f"Expected at most {_MOST_SAMPLES} samples, found {stamps.values_e.size}. Use fewer stamps.")
    if stamps.position_px.shape[0] != count:
        raise FitError(f"Expected a position for each of {count} stamps, found {stamps.position_px.shape[0]}.")
    if not (np.isfinite(stamps.read_e) and stamps.read_e > 0):
        raise FitError(f"Expected a read noise above 0 e-, found {stamps.read_e}. Count the quantisation into it.")
    if not stamps.clip_e > 0:
        raise FitError(f"Expected a clipping level above 0 e-, found {stamps.clip_e}. Leave it out if nothing clips.")
    if stamps.channel is not None:
        _check_channel(stamps.channel, stamps.values_e.shape)


def _check_channel(channel: Int[np.ndarray, "..."], shape: tuple[int, ...]) -> None:
    if channel.shape != shape:
        raise FitError(f"Expected a channel for every sample, {shape}, found {channel.shape}.")
    found = np.unique(channel)
    if not np.array_equal(found, np.arange(len(found))) or len(found) > 3:
        raise FitError(f"Expected channels 0, 1 and 2 without gaps, found {found.tolist()}. Number them from 0.")
