"""Bundle adjustment of flat boards: nine intrinsics are common to all views, and each view has a pose of six numbers.

``cv2.projectPoints`` gives places and their Jacobian in one compiled call for all points. Its five-coefficient model
(Brown and Conrady) is that of ``udccal.models.geometry``.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Final, final

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, Shaped
from scipy.spatial.transform import Rotation

from udccal.fitting.engine.gaussian import Prior
from udccal.fitting.engine.least_squares import Blocks, Solution, SolverRules, Step, minimise
from udccal.fitting.engine.robust import Cauchy, OutlierRule
from udccal.models.arrays import Arrayish
from udccal.models.geometry import Geometry

INTRINSIC_NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
LENS = len(INTRINSIC_NAMES)
# Orders of the distortion, simplest first: which intrinsics are free. The last one includes all others.
ORDERS = {
    name: np.array([own in ("fx", "fy", "cx", "cy", *name.split()) for own in INTRINSIC_NAMES])
    for name in ("no distortion", "k1", "k1 k2", "k1 k2 k3", "k1 k2 p1 p2", "k1 k2 p1 p2 k3")
}
EVERY = np.ones(LENS, dtype=bool)
# Intrinsics as the solver has them; see ``Intrinsics``.
Lens = Float[np.ndarray, "9"]
Free = Bool[np.ndarray, "9"]
# Of each view, board to camera: rotation vector (rad), then translation (board's unit).
Poses = Float[np.ndarray, "views 6"]
NOTHING_KNOWN = Prior(np.zeros(LENS), np.zeros((0, LENS)))


@final
@dataclass(frozen=True)
class GeometryRules:
    """The constants of the fit of lens and boards.

    Attributes:
        least_views: usable views that may determine a lens; with a prior, one determines at least its pose.
        least_corners: of a usable view. Four determine a homography; two more test it.
        most_clipped: part of a board's samples at saturation. Beyond it edges have bloomed.
        corners: which corners are left out, by their view's own scatter.
        strange_view: a view is left out whole when it scatters this many times as much as the median view.
        loud_view: a view is mentioned when it scatters this many times as much.
        copy: a view is a copy of another when their corners differ by less than this part of the variance that
            independent errors give; it is left out.
        further_order: prior odds against each further order of the distortion: a coefficient that is not needed raises
            the sigma of the others.
        full_order: part of the variance in the order with every coefficient that a chosen order without some states at
            least.
        prior_share: beyond this part of the information on focal length or centre, the prior chooses the order.
        most_uncertain: sigma of focal length (of itself) and centre (of the width) beyond which the views do not
            determine the lens; the model is not linear over such a sigma.
        worst_rms_px, worst_chi2_dof: beyond both, the fit is poor.
        no_corners_px: RMS residual beyond which the fit is poor whatever the sigmas: any corner detector comes closer.
        pattern_cells: cells along a side of the grid over which residuals are averaged.
        start_scatter_px: scatter of corners in addition to noise, before it is estimated.
        window_px: least and largest radius of a corner's window.
        least_contrast: half the step at a corner over the saddle's residuals.
        worst_corner_sigma_px: largest sigma of a corner by noise.
    """

    least_views: int = 3
    least_corners: int = 6
    most_clipped: float = 0.02
    corners: OutlierRule = field(default_factory=lambda: OutlierRule("corners"))
    strange_view: float = 20.0
    loud_view: float = 3.0
    copy: float = 0.25
    further_order: float = 10.0
    full_order: float = 0.25
    prior_share: float = 0.1
    most_uncertain: float = 0.05
    worst_rms_px: float = 1.0
    worst_chi2_dof: float = 9.0
    no_corners_px: float = 5.0
    pattern_cells: int = 6
    start_scatter_px: float = 0.02
    window_px: tuple[float, float] = (4.0, 25.0)
    least_contrast: float = 6.0
    worst_corner_sigma_px: float = 1.0


RULES: Final = GeometryRules()


@final
@dataclass(frozen=True)
class Intrinsics:
    """The nine numbers of a lens, or the first nine of a vector, by name; see ``Geometry``.

    ``of`` and ``vector`` convert from and to a vector in the order of ``INTRINSIC_NAMES``, numpy's or JAX's.
    """

    focal_px: Float[Arrayish, "2"]
    principal_point_px: Float[Arrayish, "2"]
    distortion: Float[Arrayish, "5"]

    @classmethod
    def of(cls, vector: Float[Arrayish, " n"]) -> Intrinsics:
        """From a vector that begins with intrinsics."""
        return cls(vector[:2], vector[2:4], vector[4:LENS])

    @classmethod
    def of_geometry(cls, geometry: Geometry) -> Intrinsics:
        """Of a fitted or nominal term."""
        return cls(geometry.focal_px, geometry.principal_point_px, geometry.distortion)

    @classmethod
    def centred(cls, focal_px: float, image_size: tuple[int, int]) -> Intrinsics:
        """Without distortion, about the middle of the picture of (columns, rows)."""
        return cls(np.full(2, focal_px), (np.array(image_size) - 1) / 2, np.zeros(5))

    @property
    def vector(self) -> Lens:
        """In double precision."""
        return np.concatenate([self.focal_px, self.principal_point_px, self.distortion], dtype=np.float64)

    @property
    def opencv(self) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "5"]]:
        """OpenCV's camera matrix and coefficients of the distortion."""
        (fx, fy), (cx, cy) = np.asarray(self.focal_px), np.asarray(self.principal_point_px)
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]), np.asarray(self.distortion, np.float64)

    def camera(self) -> Geometry:
        """The term with the lens alone: camera coordinates are the panel's."""
        return Geometry(self.focal_px, self.principal_point_px, self.distortion, np.zeros(3), np.zeros(3))


@final
@dataclass(frozen=True)
class Bundle:
    """Intrinsics and one pose per view."""

    intrinsics: Lens
    poses: Poses

    def facing(self) -> Bundle:
        """The same pictures with every board in front of the camera, and rotations of at most half a turn.

        Behind the camera, a flat board turned by half a turn about its normal projects to the same points.
        """
        behind = self.poses[:, 5:] < 0
        turn = Rotation.from_rotvec(self.poses[:, :3]) * Rotation.from_rotvec(behind * np.array([0.0, 0.0, np.pi]))
        return Bundle(self.intrinsics, np.hstack([turn.as_rotvec(), np.where(behind, -1.0, 1.0) * self.poses[:, 3:]]))


@final
@dataclass(frozen=True)
class Points:
    """Points of all usable views one after another: on the board in any unit of length, and in px with their sigma.

    Attributes:
        view: number of the point's view among the usable ones. index: its place in its view as given.
        used: whether it takes part in the fit.
        names: the usable views by their place in what was given.
        rules: of their fit.
    """

    board: Float[np.ndarray, "points 3"]
    image: Float[np.ndarray, "points 2"]
    sigma: Float[np.ndarray, " points"]
    view: Int[np.ndarray, " points"]
    index: Int[np.ndarray, " points"]
    used: Bool[np.ndarray, " points"]
    names: tuple[int, ...]
    rules: GeometryRules = RULES

    def scaled(self, factor: Float[np.ndarray, " views"]) -> Points:
        """With the sigma of each view's points multiplied by that view's factor."""
        return replace(self, sigma=self.sigma * factor[self.view])

    def without(self, views: Bool[np.ndarray, " views"]) -> Points:
        """Without these views; the others move up."""
        number, stay = (np.cumsum(~views) - 1)[self.view], ~views[self.view]
        parts = (self.board[stay], self.image[stay], self.sigma[stay], number[stay])
        names = tuple(np.array(self.names)[~views].tolist())
        return Points(*parts, self.index[stay], self.used[stay], names, self.rules)

    def split(self, values: Shaped[np.ndarray, "points *n"]) -> list[Shaped[np.ndarray, "_ *n"]]:
        """Values of the points, view by view."""
        return np.split(values, np.flatnonzero(np.diff(self.view)) + 1)

    def sums(self, values: Float[np.ndarray, " points"]) -> Float[np.ndarray, " views"]:
        """Sums over each view's points in use."""
        return np.bincount(self.view[self.used], values[self.used], len(self.names))

    def cells(self, size: tuple[int, int]) -> Int[np.ndarray, " points"]:
        """Number of the cell, of ``rules.pattern_cells`` across and down a sensor (columns, rows), of each point."""
        across = self.rules.pattern_cells
        x, y = np.clip(self.image / np.array(size) * across, 0, across - 1).astype(np.int64).T
        return np.asarray(y * across + x)


def projected(
    intrinsics: Lens, camera: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2 15"]]:
    """Places of points in camera coordinates (any unit), in px (``cv2.projectPoints``).

    The second result has their derivatives by the 9 intrinsics, a small turn (rad) and a shift of the points.
    """
    places, slopes = cv2.projectPoints(camera, np.zeros(3), np.zeros(3), *Intrinsics.of(intrinsics).opencv)
    by = slopes.reshape(-1, 2, 15)
    return places.reshape(-1, 2), np.concatenate([by[..., 6:], by[..., :6]], axis=2)


def linearised(
    bundle: Bundle, points: Points
) -> tuple[Float[np.ndarray, "points 2"], Float[np.ndarray, "points 2 15"]]:
    """Projected minus seen in px, and the derivatives of that by the intrinsics and the view's own pose."""
    turns = [cv2.Rodrigues(np.ascontiguousarray(pose[:3])) for pose in bundle.poses]
    rotation = np.array([matrix for matrix, _ in turns])[points.view]
    by_vector = np.array([by.reshape(3, 3, 3) for _, by in turns])[points.view]
    camera = np.einsum("nij,nj->ni", rotation, points.board) + bundle.poses[points.view, 3:]
    places, jacobian = projected(bundle.intrinsics, camera)
    turned = np.einsum("nkij,nj->nki", by_vector, points.board)
    jacobian[:, :, LENS : LENS + 3] = np.einsum("nai,nki->nak", jacobian[:, :, LENS + 3 :], turned)
    return places - points.image, jacobian


def in_sigma(bundle: Bundle, points: Points) -> tuple[Float[np.ndarray, "points 2"], Float[np.ndarray, "points 2 15"]]:
    """As ``linearised``, in units of sigma; zero for points that are not used."""
    residuals, jacobian = linearised(bundle, points)
    weight = (points.used / points.sigma)[:, None]
    return residuals * weight, jacobian * weight[..., None]


@final
@dataclass(frozen=True)
class BundleProblem:
    """A bundle as the solver's problem, with a prior on the intrinsics; those that are not ``free`` stay.

    ``robust`` is the loss of residuals; None stands for their squares.
    """

    points: Points
    free: Free
    prior: Prior = NOTHING_KNOWN
    robust: Cauchy | None = None

    @property
    def name(self) -> str:
        """For the iteration log."""
        return f"bundle, {int(self.free.sum())} of {LENS} intrinsics"

    def moved(self, place: Bundle, step: Step) -> Bundle:
        """The place after a step."""
        return Bundle(place.intrinsics + step.shared, place.poses + step.own)

    def by_view(self, place: Bundle) -> list[Blocks]:
        """The equations of each view alone, without the prior: intrinsics are shared, with zeros for those held."""
        z, jacobian = in_sigma(place, self.points)
        jacobian[..., :LENS] *= self.free
        made, loss = [], (z**2).sum(axis=1)
        if self.robust is not None:
            root, loss = np.sqrt(self.robust.weight(np.sqrt(loss))), self.robust.loss(np.sqrt(loss))
            z, jacobian = z * root[:, None], jacobian * root[:, None, None]
        for mine in self.points.split(np.arange(len(z))):
            slopes, errors = jacobian[mine].reshape(-1, LENS + 6), z[mine].ravel()
            whole, right, used = slopes.T @ slopes, -slopes.T @ errors, 2 * int(self.points.used[mine].sum())
            # Each intrinsic gets this part of the information that known poses would bring: an intrinsic that views
            # do not determine has then a very large variance, not none. It is above rounding, and changes no other.
            shared = whole[:LENS, :LENS] + 1e-11 * np.diag(np.diag(whole)[:LENS])
            own = whole[None, LENS:, LENS:], right[None, LENS:], whole[None, :LENS, LENS:]
            made.append(Blocks(float(loss[mine].sum()), used, shared, right[:LENS], *own))
        return made

    def equations_at(self, place: Bundle) -> Blocks:
        """Those of all views together, with the prior's part."""
        with np.errstate(all="ignore"):  # A step too far may lead to points behind the camera; the cost refuses it.
            together = Blocks.joined(self.by_view(place))
        return together.with_prior(Prior(self.prior.mean, self.prior.root * self.free), place.intrinsics)


Solved = Solution[Bundle, Blocks]


def solve(
    start: Bundle, points: Points, free: Free, prior: Prior = NOTHING_KNOWN, robust: Cauchy | None = None
) -> Solved:
    """The minimum next to ``start``, to a thousandth of a sigma or, where robust, a tenth: another descent follows."""
    rules = SolverRules(least_gain=1e-6 if robust is None else 1e-2)
    return minimise(BundleProblem(points, free, prior, robust), start, rules)
