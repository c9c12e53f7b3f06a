"""The points of views, from a session's boards behind its flat field or from arrays, and poses to start from.

A gradient of the picture's brightness at a corner moves it. Out-of-focus rows of the panel make such gradients. On a
rig whose wire modulates by 3 %, corners scatter half as much once the flat field is divided out (EMVA 1288's flat-field
correction, with the panel as part of the camera). That corrects unequal pixels as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import cv2
import jax
import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from udccal.arrangements import BoardSpec
from udccal.errors import FitError
from udccal.fitting.engine.gaussian import Prior
from udccal.fitting.engine.robust import outliers
from udccal.fitting.geometry.bundle import GeometryRules, Intrinsics, Points
from udccal.fitting.geometry.corners import BoardCorners, detect_corners, luminance, sites
from udccal.fitting.nominal import nominal_geometry
from udccal.models.geometry import Geometry
from udccal.models.noise import Noise, linear_signal, variance_e
from udccal.result import Outliers
from udccal.rig import RigDescription
from udccal.sessions.schema import BoardSubject, StoredCapture, StoredStep
from udccal.sessions.store import Session

_variance_e = jax.jit(variance_e)


@final
@dataclass(frozen=True)
class BoardView:
    """The corners of one step's board; ``clipped`` is the part of the picture's samples at saturation.

    A board that stands ``parallel`` to the panel has its axes.
    """

    step_id: str
    spec: BoardSpec
    parallel: bool
    corners: BoardCorners
    clipped: float

    def usable(self, rules: GeometryRules | None = None) -> bool:
        """Whether enough corners were found in an unclipped picture."""
        rules = rules or GeometryRules()
        return len(self.corners.ids) >= rules.least_corners and self.clipped <= rules.most_clipped


@final
@dataclass(frozen=True)
class GeometryData:
    """The data of a rig's geometry fit: views of boards, at least one of them parallel to the panel.

    The fit starts at ``nominal``, whose pupil it keeps. ``image_size`` is (columns, rows). ``prior`` is on the
    intrinsics, in the order of ``Intrinsics``; None where nothing is known.
    """

    views: tuple[BoardView, ...]
    nominal: Geometry
    image_size: tuple[int, int]
    prior: Prior | None = None


def read_geometry(session: Session, noise: Noise, rules: GeometryRules | None = None) -> GeometryData:
    """Read the boards of all steps ``geometry/*``, and the prior on the lens from the rig's description.

    The noise term gives the black level, the saturation and the corners' sigma.

    Raises:
        SessionError: when a file is missing or damaged.
        FitError: when a board's dictionary is unknown.
    """
    rules, rig = rules or GeometryRules(), session.rig
    steps = [step for step in session.steps("geometry") if isinstance(step.subject, BoardSubject)]
    flat = _read_flat_field(session, noise, rules) if steps else None
    views = tuple(_read_view(session, step, noise, flat, rules) for step in steps)
    return GeometryData(views, nominal_geometry(rig), (rig.camera.columns, rig.camera.rows), rig_prior(rig, rules))


def rig_prior(rig: RigDescription, rules: GeometryRules | None = None) -> Prior:
    """Prior on the intrinsics, in their order, from a rig's description.

    The focal length's tolerance is its sigma; ``rules`` have those of principal point and distortion.
    """
    rules = rules or GeometryRules()
    focal = rig.focal_px * max(rig.lens.focal_mm.tolerance / rig.lens.focal_mm.value, 1e-4)
    centre = rules.centre_sigma * rig.camera.columns
    sigma = Intrinsics(np.full(2, focal), np.full(2, centre), np.array(rules.distortion_sigma))
    return Prior.independent(Intrinsics.of_geometry(nominal_geometry(rig)).vector, sigma.vector)


@final
@dataclass(frozen=True)
class FlatField:
    """Response of every sample over the mean of its CFA site, and the relative variance of that by noise."""

    response: Float[np.ndarray, "rows columns"]
    relative_variance: Float[np.ndarray, "rows columns"]


def flat_field(
    light: Float[np.ndarray, "rows columns"],
    variance: Float[np.ndarray, "rows columns"],
    unclipped: Bool[np.ndarray, "rows columns"],
    rules: GeometryRules | None = None,
) -> FlatField:
    """Response of a sensor to an even field; clipped, dead and covered samples have a response of 1.

    ``light`` has any linear unit, its black level subtracted; ``variance`` is its own, in that unit squared.
    """
    least = (rules or GeometryRules()).least_response
    response, relative = np.ones_like(light), np.zeros_like(light)
    for site in sites():
        own = light[site] / max(float(light[site].mean()), 1e-12)
        good = unclipped[site] & (own > least)
        response[site] = np.where(good, own, 1.0)
        relative[site] = np.where(good, variance[site] / np.where(good, light[site], 1.0) ** 2, 0.0)
    return FlatField(response, relative)


def _read_flat_field(session: Session, noise: Noise, rules: GeometryRules) -> FlatField | None:
    """The flat field by the averages of the wire fit; None where the session has none."""
    if not {"wire/dark", "wire/flat"} <= {step.id for step in session.steps("wire")}:
        return None
    capture = session.step("wire/flat").captures[0]
    flat = session.average(capture).mean.astype(np.float64)
    light = flat - session.average(session.step("wire/dark").captures[0]).mean
    unclipped = flat < rules.clipped * float(np.asarray(noise.saturation_DN))
    return flat_field(light, _temporal_variance_DN2(noise, light, capture), unclipped, rules)


def _temporal_variance_DN2(
    noise: Noise, light_DN: Float[np.ndarray, "rows columns"], capture: StoredCapture
) -> Float[np.ndarray, "rows columns"]:
    """Temporal variance of a capture's mean in DN^2 (EMVA 1288's photon transfer)."""
    gain, exposure_s = float(np.asarray(noise.K_DN_per_e)), np.float64(capture.exposure_s)
    return gain**2 * np.asarray(_variance_e(noise, light_DN / gain, exposure_s), dtype=np.float64) / capture.frames


def _read_view(
    session: Session, step: StoredStep, noise: Noise, flat: FlatField | None, rules: GeometryRules
) -> BoardView:
    """The board in the first capture of a step (its average, or a single frame)."""
    subject, capture = step.subject, step.captures[0]
    if not isinstance(subject, BoardSubject):
        raise TypeError(f"step {step.id} shows no board")
    mean = session.frame(capture) if capture.kind == "frame" else session.average(capture).mean
    spec = BoardSpec(subject.columns, subject.rows, subject.square_mm, subject.marker_mm, subject.dictionary)
    above_DN = mean.astype(np.float64) - float(np.asarray(noise.black_DN))
    light = linear_signal(above_DN, float(np.asarray(noise.bend_per_DN)))
    area, offsets_DN = capture.region, float(np.asarray(noise.K_DN_per_e)) * float(np.asarray(noise.DSNU1288_e))
    variance = _temporal_variance_DN2(noise, light, capture) + offsets_DN**2
    part = np.s_[area.y : area.y + area.rows, area.x : area.x + area.columns]
    # The picture as equal pixels would see it; the remaining inequality adds to the temporal noise.
    response, unequal = np.ones_like(light), np.full_like(light, float(np.asarray(noise.PRNU1288)) ** 2)
    if flat is not None:
        response, unequal = flat.response[part], flat.relative_variance[part]
    even = light / response
    corners = detect_corners(luminance(even, variance / response**2 + unequal * even**2), spec, rules)
    moved = BoardCorners(corners.ids, corners.xy + np.array([area.x, area.y], dtype=np.float64), corners.sigma)
    clipped = float(np.mean(mean >= rules.clipped * float(np.asarray(noise.saturation_DN))))
    return BoardView(step.id, spec, subject.parallel_to_panel, moved, clipped)


@final
@dataclass(frozen=True)
class Gathered:
    """Points of the usable ones of ``views``, what was left out, and notes; ``weighted`` if sigmas were given."""

    points: Points
    outliers: tuple[Outliers, ...]
    notes: tuple[str, ...]
    views: int
    weighted: bool


def gather(
    board: Sequence[np.ndarray],
    image: Sequence[np.ndarray],
    sigmas: Sequence[np.ndarray] | None = None,
    rules: GeometryRules | None = None,
) -> Gathered:
    """Every finite point of every view that determines a pose; arguments and errors as for ``fit_geometry``."""
    rules = rules or GeometryRules()
    if len({len(board), len(image), len(image if sigmas is None else sigmas)}) > 1:
        raise FitError(
            f"Expected as many views on the board as in pictures (and of sigmas), found {len(board)} and {len(image)}. "
            "Give one array of each per view."
        )
    # Without sigmas any common value serves: its scale is estimated.
    given = [np.full(len(pixels), 0.1) for pixels in image] if sigmas is None else sigmas
    lost: list[str] = []
    notes: list[str] = []
    parts = {-1: (np.zeros((0, 3)), np.zeros((0, 2)), np.zeros(0), np.zeros(0, dtype=np.int64))}
    for number, arrays in enumerate(zip(board, image, given, strict=True)):
        points, pixels, own = _view(number, *(np.asarray(a, dtype=np.float64) for a in arrays))
        good = np.isfinite(points).all(axis=1) & np.isfinite(pixels).all(axis=1) & np.isfinite(own) & (own > 0)
        lost += [f"view {number}, point {k}" for k in np.flatnonzero(~good)]
        part = (points[good], pixels[good], own[good], np.flatnonzero(good))
        if complaint := _complaint(part[0], part[1], list(parts.values()), rules):
            notes.append(f"View {number} is left out: {complaint}")
        else:
            parts[number] = part
    points, pixels, own, index = (np.concatenate(same) for same in zip(*parts.values(), strict=True))
    view = np.repeat(np.arange(len(parts)) - 1, [len(part[0]) for part in parts.values()])
    found = Points(points, pixels, own, view, index, np.ones(len(points), dtype=bool), tuple(parts)[1:])
    left_out = outliers("not a finite position with a positive sigma", lost)
    return Gathered(found, left_out, tuple(notes), len(board), sigmas is not None)


def _view(number: int, points: np.ndarray, pixels: np.ndarray, own: np.ndarray) -> tuple[np.ndarray, ...]:
    """Board points (n, 3), pixels (n, 2) and sigma (n,) of a view, whatever the shape OpenCV gave them."""
    n = len(pixels)
    if points.shape not in ((n, 3), (n, 1, 3)) or pixels.shape not in ((n, 2), (n, 1, 2)) or own.shape != (n,):
        raise FitError(
            f"Expected board points (n, 3), image points (n, 2) and sigmas (n,) of equal n in view {number}, found "
            f"{points.shape}, {pixels.shape} and {own.shape}. Give each seen corner its point on the board."
        )
    return points.reshape(-1, 3), pixels.reshape(-1, 2), own


def _complaint(board: np.ndarray, image: np.ndarray, before: list[tuple[np.ndarray, ...]], rules: GeometryRules) -> str:
    """Why a view cannot be used; empty when it can."""
    least = rules.least_corners
    if len(board) < least:
        return f"expected at least {least} points, found {len(board)}. Bring more of the board into the picture."
    for points, what in ((board, "on the board"), (image, "in the picture")):
        spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
        if not 1e-9 < spread[0] < 1e9:
            return f"its points span {spread[0]:.2g} {what}. Give the board in mm or m, and the picture in px."
        if spread[1] <= 1e-3 * spread[0]:
            return f"its points lie on one line {what} and hold no pose. Show at least two rows of corners."
    if any(np.array_equal(image, other[1]) and np.array_equal(board, other[0]) for other in before):
        return "it repeats another view to the last digit, and so adds nothing. Capture every view anew."
    return ""


def best_poses(
    points: Points, intrinsics: Float[np.ndarray, "9"]
) -> tuple[Float[np.ndarray, "views 6"], Float[np.ndarray, "views 6"]]:
    """The best pose of each view at these intrinsics, and the one mirrored at the line of sight."""
    pairs = [_pose_pair(points, view, Intrinsics.of(intrinsics)) for view in range(len(points.names))]
    return np.array([first for first, _ in pairs]), np.array([second for _, second in pairs])


def facing(poses: Float[np.ndarray, "views 6"]) -> Float[np.ndarray, "views 6"]:
    """The same pictures with every board in front of the camera, and rotations of at most half a turn.

    Behind the camera, a flat board turned by half a turn about its normal projects to the same points.
    """
    side = np.where(poses[:, 5:] < 0, -1.0, 1.0)
    turn = Rotation.from_rotvec(poses[:, :3]) * Rotation.from_rotvec(np.pi * (side < 0) * np.array([0.0, 0.0, 1.0]))
    return np.hstack([turn.as_rotvec(), side * poses[:, 3:]])


def _pose_pair(points: Points, view: int, lens: Intrinsics) -> tuple[np.ndarray, np.ndarray]:
    mine = (points.view == view) & points.used
    board, image = points.board[mine], points.image[mine]
    good = _consistent(board, image)
    flat = np.linalg.svd(board - board.mean(axis=0), compute_uv=False)
    method = cv2.SOLVEPNP_IPPE if flat[2] <= 1e-6 * flat[0] else cv2.SOLVEPNP_SQPNP
    try:
        _, turns, shifts, _ = cv2.solvePnPGeneric(board[good], image[good], lens.matrix, lens.distortion, flags=method)
    except cv2.error:
        turns, shifts = (), ()
    found = [np.concatenate([t.ravel(), s.ravel()]) for t, s in zip(turns, shifts, strict=True)]
    found = [pose for pose in found if np.isfinite(pose).all()] or [_ahead(board, image, lens)]
    return found[0], found[-1]


def _ahead(board: np.ndarray, image: np.ndarray, lens: Intrinsics) -> np.ndarray:
    """A pose that faces the camera, at the distance and place by the points' spread."""
    (across, down), middle = image.mean(axis=0), board.mean(axis=0)
    seen = max(float(np.linalg.norm(image - image.mean(axis=0))), 1e-9)
    distance = lens.matrix[0, 0] * float(np.linalg.norm(board - middle)) / seen
    return np.concatenate([np.zeros(3), np.linalg.solve(lens.matrix, [across, down, 1.0]) * distance - middle])


def _consistent(board: np.ndarray, image: np.ndarray) -> Bool[np.ndarray, " n"]:
    """Points that one homography puts near their places; all points where there are too few for it.

    The limit is a part of the board's size: distortion bends straight lines by less, and a corner with its neighbour's
    number is off by more.
    """
    if len(board) >= 12:
        limit = max(0.02 * float(np.ptp(image, axis=0).max()), 1.0)
        _, inside = cv2.findHomography(board[:, :2], image, cv2.RANSAC, limit)
        if inside is not None and inside.sum() >= max(6, len(board) // 3):
            return inside.ravel().astype(bool)
    return np.ones(len(board), dtype=bool)
