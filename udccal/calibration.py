"""All five fits of a session, each after those whose terms it needs, and the profile that they make."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

import numpy as np
from jaxtyping import Float

from udccal.effort import FitEffort
from udccal.errors import UdccalError
from udccal.fitting.geometry.data import BoardView
from udccal.models.backscatter import Backscatter
from udccal.models.geometry import Geometry
from udccal.models.noise import Noise
from udccal.models.psf import PsfField
from udccal.models.wire import Wire
from udccal.profiles.profile import build_profile
from udccal.profiles.provenance import provenance_now
from udccal.profiles.store import write_profile
from udccal.result import FitResult, TermResults
from udccal.rig import RigDescription
from udccal.sessions.manifest import MANIFEST_NAME
from udccal.sessions.schema import TermName
from udccal.sessions.store import Session, check_session
from udccal.term_fits import FitTime, TermFits

ORDER: tuple[TermName, ...] = get_args(TermName)


@dataclass(frozen=True)
class Foundation:
    """The fits that psf and backscatter need.

    Attributes:
        times: durations of these fits.
        wire_map: the fitted wire at every pixel; it is kept because evaluating it takes long.
        boards: the board views that the geometry was fitted to.
    """

    noise: FitResult[Noise]
    geometry: FitResult[Geometry]
    wire: FitResult[Wire]
    times: tuple[FitTime, ...]
    wire_map: Float[np.ndarray, "rows columns"]
    boards: tuple[BoardView, ...]


@dataclass(frozen=True, eq=False)
class Calibration(TermResults):
    """The five results of one session and their durations.

    Attributes:
        parent: SHA-256 that names the profile whose terms were kept where some only were fitted; None where all were.
    """

    session: Session
    foundation: Foundation
    psf: FitResult[PsfField]
    backscatter: FitResult[Backscatter]
    times: tuple[FitTime, ...]
    parent: str | None = None

    @property
    def rig(self) -> RigDescription:
        """The rig description: the rig as it was built to be."""
        return self.session.rig

    @property
    def noise(self) -> FitResult[Noise]:
        """The noise fit."""
        return self.foundation.noise

    @property
    def geometry(self) -> FitResult[Geometry]:
        """The geometry fit."""
        return self.foundation.geometry

    @property
    def wire(self) -> FitResult[Wire]:
        """The wire fit."""
        return self.foundation.wire

    @property
    def results(self) -> tuple[FitResult, FitResult, FitResult, FitResult, FitResult]:
        """All five results, in the order of ``TermName``."""
        return self.noise, self.geometry, self.wire, self.psf, self.backscatter

    def or_raise(self) -> Calibration:
        """Return itself when every fit ended well.

        Raises:
            FitError: when a fit did not, with the advice of its status.
        """
        for result in self.results:
            result.or_raise()
        return self

    def write(self, path: str | Path) -> Path:
        """Write the profile as a folder, or as one file if ``path`` ends in ``.zip``; replace a profile at ``path``.

        A term whose fit stopped early or fits poorly is written with its status, as its error bars include that. Call
        ``or_raise`` before to refuse such terms.

        Returns:
            the path that was written.

        Raises:
            FitError: when a term has no error bars (``FitResult.usable``); nothing is written then.
            ProfileError: when ``path`` holds something that is not a profile.
        """
        provenance = provenance_now(self.session.path / MANIFEST_NAME, self.session.camera)
        profile = build_profile(self.rig, provenance, *self.results, self.foundation.wire_map, self.parent)
        write_profile(Path(path), profile)
        return Path(path)


def fit(session: Session, term: str, effort: FitEffort | None = None) -> FitResult:
    """Fit one term of a session, after those that it needs.

    Args:
        session: the captured session.
        term: noise, geometry, wire, psf or backscatter.
        effort: how much time the fits may take; None for full effort, ``udccal.effort.QUICK`` for a quick look.

    Returns:
        the term with its covariance; a term without steps is the same as from ``calibrate``.

    Raises:
        SessionError: when it is no session, or a file of it is missing or damaged.
        UdccalError: when ``term`` is not the name of a term.
    """
    check_session(session)
    if term not in ORDER:
        raise UdccalError(f"Expected a term, one of {', '.join(ORDER)}, found '{term}'. Name one of these.")
    return getattr(TermFits(session, effort), term)


def fit_foundation(
    session: Session, progress: Callable[[TermName], None] = lambda term: None, effort: FitEffort | None = None
) -> Foundation:
    """Fit noise, geometry and wire. This needs only their steps, so it can run while the others are captured.

    Args:
        session: the captured session.
        progress: called with a term's name when its fit begins.
        effort: how much time the fits may take; None for full effort, ``udccal.effort.QUICK`` for a quick look.

    Raises:
        SessionError: when a file of the session is missing or damaged.
    """
    fits = TermFits(session, effort, progress)
    base = fits.noise, fits.geometry, fits.wire
    return Foundation(*base, tuple(fits.times), fits.wire_map, fits.boards)


def calibrate(
    session: Session,
    progress: Callable[[TermName], None] = lambda term: None,
    effort: FitEffort | None = None,
    foundation: Foundation | None = None,
) -> Calibration:
    """Fit every term of a session; a term without steps gets its nominal or absent form, and status NOT_CAPTURED.

    Args:
        session: the captured session.
        progress: called with a term's name when its fit begins.
        effort: how much time the fits may take; None for full effort, ``udccal.effort.QUICK`` for a quick look.
        foundation: result of ``fit_foundation`` for the same session, when it has already run.

    Raises:
        SessionError: when a file of the session is missing or damaged.
    """
    check_session(session)
    effort = effort or FitEffort()
    base = foundation or fit_foundation(session, progress, effort)
    fits = TermFits(session, effort, progress)
    # Setting a cached property keeps its fit from running.
    fits.noise, fits.geometry, fits.wire, fits.wire_map = base.noise, base.geometry, base.wire, base.wire_map
    with ThreadPoolExecutor(effort.workers) as pool:
        late = [pool.submit(getattr, fits, term) for term in ("psf", "backscatter")]
    times = sorted(fits.times, key=lambda taken: ORDER.index(taken.term))
    return Calibration(session, base, late[0].result(), late[1].result(), (*base.times, *times))
