"""The points of views, from a session's boards behind its flat field or from arrays, and poses to start from.

A gradient of the picture's brightness at a corner moves it. Out-of-focus rows of the panel make such gradients. On a
rig whose wire modulates by 3 %, corners scatter half as much once the flat field is divided out (EMVA 1288's flat-field
correction, with the panel as part of the camera). That corrects unequal pixels as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import final

import cv2
import numpy as np
from jaxtyping import Bool

from udccal.arguments import check_unmasked, found_instead
from udccal.arrangements import BoardSpec
from udccal.cfa import cfa_named
from udccal.errors import FitError
from udccal.fitting.engine.gaussian import Prior
from udccal.fitting.engine.robust import outliers
from udccal.fitting.geometry.bundle import RULES, GeometryRules, Intrinsics, Lens, Points, Poses
from udccal.fitting.geometry.corners import BoardCorners, Picture, detect_corners
from udccal.fitting.nominal import nominal_geometry
from udccal.fitting.wire.data import read_wire
from udccal.models.geometry import Geometry
from udccal.models.noise import Noise, linear_signal, variance_e
from udccal.result import Outliers
from udccal.rig import RigDescription
from udccal.sessions.schema import BoardSubject, StoredCapture
from udccal.sessions.store import Session


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

    def usable(self, rules: GeometryRules = RULES) -> bool:
        """Whether enough corners were found in an unclipped picture."""
        return len(self.corners.ids) >= rules.least_corners and self.clipped <= rules.most_clipped


@final
@dataclass(frozen=True)
class GeometryData:
    """The data of a rig's geometry fit: views of boards, at least one of them parallel to the panel.

    The fit starts at ``nominal``, whose pupil it keeps. ``image_size`` is (columns, rows). ``prior`` is on the
    intrinsics, in the order of ``INTRINSIC_NAMES``; None where nothing is known.
    """

    views: tuple[BoardView, ...]
    nominal: Geometry
    image_size: tuple[int, int]
    prior: Prior | None = None
    rules: GeometryRules = RULES


def read_geometry(session: Session, noise: Noise, rules: GeometryRules = RULES) -> GeometryData:
    """Read the boards of all steps ``geometry/*``, and the prior on the lens from the rig's description.

    The noise term gives the black level, the saturation and the corners' sigma.

    Raises:
        SessionError: when a file is missing or damaged.
        FitError: when a board's dictionary is unknown.
    """
    rig, nominal = session.rig, nominal_geometry(session.rig)
    shape = rig.camera.rows, rig.camera.columns
    # Without a flat field every pixel may be as unequal as the noise term says.
    flat = np.ones(shape), np.full(shape, float(np.asarray(noise.PRNU1288)) ** 2)
    if {"wire/dark", "wire/flat"} <= {step.id for step in session.steps("wire")}:
        wire = read_wire(session, noise, nominal)
        flat = flat_field(wire.signal.astype(np.float64), wire.variance, wire.signal < wire.clip)
    views = []
    for step in session.steps("geometry"):
        if isinstance(board := step.subject, BoardSubject):
            spec = BoardSpec(board.columns, board.rows, board.square_mm, board.marker_mm, board.dictionary)
            found = _corners(session, step.captures[0], spec, noise, flat, rules)
            views.append(BoardView(step.id, spec, board.parallel_to_panel, *found))
    return GeometryData(tuple(views), nominal, shape[::-1], rig_prior(rig), rules)


def rig_prior(rig: RigDescription) -> Prior:
    """Prior on the intrinsics, in their order, from a rig's description.

    One sigma of the focal length is its tolerance, of the centre 1 % of the width. Those of the distortion hold for
    most lenses.
    """
    focal = rig.focal_px * max(rig.lens.focal_mm.tolerance / rig.lens.focal_mm.value, 1e-4)
    sigma = [*[focal] * 2, *[0.01 * rig.camera.columns] * 2, 0.2, 0.2, 1e-3, 1e-3, 0.1]
    return Prior.independent(Intrinsics.of_geometry(nominal_geometry(rig)).vector, np.array(sigma))


def flat_field(
    light: Picture, variance: Picture, unclipped: Bool[np.ndarray, "rows columns"]
) -> tuple[Picture, Picture]:
    """Response of every sample to an even field over the mean of its CFA site, and the relative variance of that.

    Clipped, dead and covered samples have a response of 1.

    ``light`` has any linear unit, its black level subtracted; ``variance`` is its own, in that unit squared.
    """
    response, relative = np.ones_like(light), np.zeros_like(light)
    for site in cfa_named("RGGB").sites:  # Any pattern of 2 x 2 has these sites.
        own = light[site.samples] / max(float(light[site.samples].mean()), 1e-12)
        # Samples with less are dead, or behind an opaque row.
        good = unclipped[site.samples] & (own > 0.05)
        response[site.samples][good] = own[good]
        relative[site.samples][good] = variance[site.samples][good] / light[site.samples][good] ** 2
    return response, relative


def _corners(
    session: Session,
    capture: StoredCapture,
    spec: BoardSpec,
    noise: Noise,
    flat: tuple[Picture, Picture],
    rules: GeometryRules,
) -> tuple[BoardCorners, float]:
    """The board in a capture (an average, or a single frame), and the part of its samples next to saturation."""
    mean = session.frame(capture) if capture.kind == "frame" else session.average(capture).mean
    black, top, bend, gain = (
        float(np.asarray(one)) for one in (noise.black_DN, noise.saturation_DN, noise.bend_per_DN, noise.K_DN_per_e)
    )
    light = linear_signal(mean.astype(np.float64) - black, bend)
    temporal_e2 = np.asarray(variance_e(noise, light / gain, np.float64(capture.exposure_s)), dtype=np.float64)
    variance = gain**2 * (temporal_e2 / capture.frames + float(np.asarray(noise.DSNU1288_e)) ** 2)
    area = capture.region
    part = np.s_[area.y : area.y + area.rows, area.x : area.x + area.columns]
    # The picture as equal pixels would see it; the remaining inequality adds to the temporal noise.
    response, relative = (one[part] for one in flat)
    even = light / response
    found = detect_corners(even, variance / response**2 + relative * even**2, spec, rules)
    return replace(found, xy=found.xy + np.array([area.x, area.y])), float(np.mean(mean >= 0.995 * top))


@final
@dataclass(frozen=True)
class Gathered:
    """Points of all usable views, what was left out, a note for each other view; ``weighted`` if sigmas were given."""

    points: Points
    outliers: tuple[Outliers, ...]
    notes: tuple[str, ...]
    weighted: bool


def gather(
    board: Sequence[np.ndarray],
    image: Sequence[np.ndarray],
    sigmas: Sequence[np.ndarray] | None = None,
    rules: GeometryRules = RULES,
) -> Gathered:
    """Every finite point of every view that determines a pose; arguments and errors as for ``fit_geometry``."""
    for given in (board, image) if sigmas is None else (board, image, sigmas):
        if isinstance(given, str) or not isinstance(given, Sequence | np.ndarray):
            raise FitError(f"Expected points as one array per view, found {found_instead(given)}. Give a list of them.")
    if len({len(board), len(image), len(image if sigmas is None else sigmas)}) > 1:
        raise FitError(
            f"Expected as many views on the board as in pictures (and of sigmas), found {len(board)} and {len(image)}. "
            "Give one array of each per view."
        )
    # Without sigmas any common value serves: its scale is estimated.
    given = [np.full(len(pixels), 0.1) for pixels in image] if sigmas is None else sigmas
    lost, notes = list[str](), list[str]()
    parts = {-1: (np.zeros((0, 3)), np.zeros((0, 2)), np.zeros(0), np.zeros(0, dtype=np.int64))}
    for number, arrays in enumerate(zip(board, image, given, strict=True)):
        for one in arrays:
            check_unmasked(one, f"points and sigmas of view {number}", FitError)
        try:
            if any(np.iscomplexobj(one) for one in arrays):
                raise TypeError("numpy would drop a part of complex numbers")
            points, pixels, own = (np.asarray(one, dtype=np.float64) for one in arrays)
        except (TypeError, ValueError):
            kinds = ", ".join(found_instead(one) for one in arrays[:2])
            raise FitError(f"Expected numbers in view {number}, found {kinds}. Give arrays of points.") from None
        n = len(pixels)
        if points.shape not in ((n, 3), (n, 1, 3)) or pixels.shape not in ((n, 2), (n, 1, 2)) or own.shape != (n,):
            raise FitError(
                f"Expected board points (n, 3), image points (n, 2) and sigmas (n,) of equal n in view {number}, found "
                f"{points.shape}, {pixels.shape} and {own.shape}. Give each seen corner its point on the board."
            )
        whole = np.hstack([points.reshape(n, 3), pixels.reshape(n, 2), own[:, None]])
        good = np.isfinite(whole).all(axis=1) & (own > 0)
        lost += [f"view {number}, point {k}" for k in np.flatnonzero(~good)]
        part = (whole[good, :3], whole[good, 3:5], own[good], np.flatnonzero(good))
        if complaint := _complaint(part[0], part[1], list(parts.values()), rules.least_corners):
            notes.append(f"View {number} is left out: {complaint}")
        else:
            parts[number] = part
    points, pixels, own, index = (np.concatenate(same) for same in zip(*parts.values(), strict=True))
    view = np.repeat(np.arange(len(parts)) - 1, [len(part[0]) for part in parts.values()])
    found = Points(points, pixels, own, view, index, np.ones(len(points), dtype=bool), tuple(parts)[1:], rules)
    left_out = outliers("not a finite position with a positive sigma", lost)
    return Gathered(found, left_out, tuple(notes), sigmas is not None)


def _complaint(board: np.ndarray, image: np.ndarray, before: list[tuple[np.ndarray, ...]], least: int) -> str:
    """Why a view cannot be used; empty when it can."""
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


def best_poses(points: Points, intrinsics: Lens) -> tuple[Poses, Poses]:
    """The best pose of each view at these intrinsics, and the one mirrored at the line of sight."""
    lens = Intrinsics.of(intrinsics).opencv
    pairs = np.array([_pose_pair(points, view, *lens) for view in range(len(points.names))]).reshape(-1, 2, 6)
    return pairs[:, 0], pairs[:, 1]


def _pose_pair(points: Points, view: int, matrix: np.ndarray, distortion: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    mine = (points.view == view) & points.used
    board, image = points.board[mine], points.image[mine]
    good, middle = _consistent(board, image), board.mean(axis=0)
    flat = np.linalg.svd(board - middle, compute_uv=False)
    method = cv2.SOLVEPNP_IPPE if flat[2] <= 1e-6 * flat[0] else cv2.SOLVEPNP_SQPNP
    try:
        _, turns, shifts, _ = cv2.solvePnPGeneric(board[good], image[good], matrix, distortion, flags=method)
    except cv2.error:
        turns, shifts = (), ()
    found = [np.concatenate([t.ravel(), s.ravel()]) for t, s in zip(turns, shifts, strict=True)]
    found = [pose for pose in found if np.isfinite(pose).all()]
    if not found:  # One that faces the camera, at the distance and place by the points' spread.
        across, down = image.mean(axis=0)
        seen = max(float(np.linalg.norm(image - [across, down])), 1e-9)
        distance = matrix[0, 0] * float(np.linalg.norm(board - middle)) / seen
        found = [np.append(np.zeros(3), np.linalg.solve(matrix, [across, down, 1.0]) * distance - middle)]
    return found[0], found[-1]


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
