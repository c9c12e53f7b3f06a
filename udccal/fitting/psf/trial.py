"""One residual that is tried: solved from some positions, judged at those that were held out."""

from __future__ import annotations

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from udccal.fitting.psf.free import PER_PX, fixed, image_of, solve_free
from udccal.fitting.psf.held_out import Judged, judge, kernel_error
from udccal.fitting.psf.kernel_error import KernelError
from udccal.fitting.psf.residual import Sources, Windows, make_windows, mismatch, prior_spread, solve_residual
from udccal.fitting.psf.shots import Shots
from udccal.models.fields import polynomial_terms

# On top of diffraction the residual may be one of these fractions of the kernel nearby; free, it may be all of it.
BESIDE, FREE = (0.1, 0.03, 0.01), 1.0
# A higher order must lower the held-out loss of a sample by so much (what is left of the samples then narrows by an
# eighth), and by more than the places held out leave in doubt, to be worth its ten thousand coefficients: every
# restoration pays for them. Pictures held out share what their makers did with the others: on a full-size rig of wave
# optics a residual gained 0.17, and made the kernel at new places a fifth worse.
_WORTH = 0.25
# Room around a residual costs less: no component more, only a larger one.
_WORTH_OF_ROOM = 0.05


@dataclass(frozen=True)
class Order:
    """What residual there may be.

    Attributes:
        degree: of its polynomials, -1 for none.
        share: of diffraction, 1 or 0.
        freedom: its standard deviation beforehand, as a fraction of the kernel nearby.
        model_error: what solutions allow for, see ``psf.weights``.
        reach: of the window, so large a part has a residual, about the source.
    """

    degree: int
    share: float
    freedom: float
    model_error: float
    reach: float = 1.0

    @property
    def per_px(self) -> int:
        """Nodes of the image to a pixel."""
        return 1 if self.share else PER_PX

    @property
    def terms(self) -> int:
        """Polynomials."""
        return polynomial_terms(self.degree)

    @property
    def name(self) -> str:
        """For the table of candidates."""
        if self.degree < 0:
            return "diffraction"
        if not self.share:
            return f"free image, degree {self.degree}"
        within = "" if self.reach == 1 else f" within {self.reach:g} of the window"
        return f"diffraction, residual degree {self.degree} of {100 * self.freedom:g} %{within}"

    def coefficients(self, rows: int, columns: int) -> int:
        """Of the image for windows of this size."""
        half_rows, half_columns = self.half_px(rows, columns)
        return 3 * (2 * self.per_px * half_rows + 1) * (2 * self.per_px * half_columns + 1) * self.terms

    def half_px(self, rows: int, columns: int) -> tuple[int, int]:
        """(rows, columns) to either side of the source that have a residual, in windows of this size."""
        return round(self.reach * (rows // 2)), round(self.reach * (columns // 2))


@dataclass(frozen=True)
class Data:
    """Shots with what diffraction explains of them.

    Attributes:
        explained: per unit of light.
        unit: places of the shots, scaled to about [-1, 1].
        magnitude: how large the kernel is on average, by colour.
    """

    shots: Shots
    explained: Float[np.ndarray, "shots rows columns"]
    unit: Float[np.ndarray, "shots 2"]
    magnitude: Float[np.ndarray, "3 rows columns"]

    def windows(self, sources: Sources, order: Order, keep: Bool[np.ndarray, " shots"]) -> Windows:
        """What an order is solved from, or judged by."""
        half = (self.shots.rate.shape[1] // 2, self.shots.rate.shape[2] // 2)
        shots, own = self.shots.pick(keep), sources.pick(keep)
        parts = (self.explained[keep], half, self.unit[keep], max(order.degree, 0), order.model_error, order.per_px)
        return make_windows(shots, own, *parts)


@dataclass(frozen=True)
class Trial:
    """An order at positions that it was not solved from.

    Attributes:
        mismatch: relative L2 by colour, noise included.
        judged: the samples held out. loss: of these, by position.
        error: of the kernel, beside noise.
    """

    order: Order
    sources: Sources
    mismatch: Float[np.ndarray, "3"]
    judged: Judged
    loss: Float[np.ndarray, " places"]
    error: KernelError

    @property
    def criterion(self) -> float:
        """Minus twice the logarithm of the held-out likelihood per sample, but for a constant."""
        return float(self.loss.mean())

    @property
    def relative_l2(self) -> float:
        """In all colours."""
        return float(np.sqrt((self.mismatch**2).mean()))

    def beats(self, other: Trial) -> bool:
        """Whether it predicts what was held out better, beyond what the places held out leave in doubt."""
        gain, doubt = self._gain(other)
        return gain > max(doubt, _WORTH)

    def needs_room_of(self, other: Trial) -> bool:
        """Whether it predicts so much better than a narrower residual that it has to be as wide as it is."""
        gain, doubt = self._gain(other)
        return gain > max(doubt, _WORTH_OF_ROOM)

    def _gain(self, other: Trial) -> tuple[float, float]:
        gain = other.loss - self.loss
        doubt = float(gain.std(ddof=1) / np.sqrt(gain.size)) if gain.size > 1 else np.inf
        return float(gain.mean()), doubt


def attempt(data: Data, sources: Sources, test: Bool[np.ndarray, " shots"], order: Order) -> Trial:
    """Solve from all shots but ``test``, and judge by these."""
    image = solve(data, sources, ~test, order)
    windows = data.windows(sources, order, test)
    judged = judge(windows, order.share, image)
    return Trial(
        order=order,
        sources=sources,
        mismatch=mismatch(windows, order.share, image),
        judged=judged,
        loss=judged.loss(data.shots.position[test]),
        error=kernel_error(judged, windows, sources.pick(test)),
    )


def solve(
    data: Data, sources: Sources, keep: Bool[np.ndarray, " shots"], order: Order
) -> Float[np.ndarray, "terms 3 node_rows node_columns"]:
    """The residual's image; zeros where the order has none."""
    spread = prior_spread(data.magnitude, polynomial_terms(max(order.degree, 0)), order.freedom, order.per_px)
    if order.degree < 0:
        return np.zeros_like(spread)
    y, x = (np.abs(np.arange(nodes) - nodes // 2) for nodes in spread.shape[2:])
    half_rows, half_columns = (order.per_px * half for half in order.half_px(*data.shots.rate.shape[1:]))
    spread = spread * ((y <= half_rows)[:, None] & (x <= half_columns))
    windows = data.windows(sources, order, keep)
    if order.share:
        return np.asarray(solve_residual(windows, jnp.asarray(order.share), jnp.asarray(spread)))
    scaled, _ = solve_free(windows, spread, fixed(windows), np.zeros_like(spread))
    return np.asarray(image_of(scaled, spread))
