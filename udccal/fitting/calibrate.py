"""All five fits of a session, each with what the ones before it found: noise, geometry, wire, psf, backscatter."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TypeVar, get_args

import numpy as np
from jaxtyping import Float

from udccal.fitting.absent import absent_backscatter, absent_psf, absent_wire
from udccal.fitting.backscatter.fit import fit_backscatter
from udccal.fitting.geometry.fit import BoardView, fit_views, read_views, rig_prior
from udccal.fitting.noise.fit import fit_noise, nominal_noise
from udccal.fitting.nominal import nominal_geometry
from udccal.fitting.psf.data import read_psf
from udccal.fitting.psf.fit import fit_psf
from udccal.fitting.psf.start import PsfRules
from udccal.fitting.wire.fit import FIELD_SAMPLES, fit_wire_session, sensor_map
from udccal.fitting.wire.sigma import MapSigma
from udccal.models.backscatter import Backscatter
from udccal.models.geometry import Geometry
from udccal.models.noise import Noise
from udccal.models.psf import PsfField
from udccal.models.wire import Wire
from udccal.result import FitResult, FitStatus
from udccal.rig import RigDescription
from udccal.sessions.schema import TermName
from udccal.sessions.store import Session

Term = TypeVar("Term")
ORDER: tuple[TermName, ...] = get_args(TermName)


@dataclass(frozen=True)
class FitEffort:
    """What the fits may spend; less is quicker and less accurate.

    Attributes:
        wire_samples: pixels that the wire's fields are fitted to.
        psf: see ``udccal.fitting.psf.start.PsfRules``.
        backscatter_positions: sensor positions that the footprint is fitted at.
        workers: with 2, psf and backscatter, which do not need each other, are fitted at once, in more memory.
    """

    wire_samples: int = FIELD_SAMPLES
    psf: PsfRules = field(default_factory=PsfRules)
    backscatter_positions: int = 96
    workers: int = 1


# For a demonstration.
QUICK = FitEffort(
    wire_samples=60_000,
    psf=PsfRules(positions=5, shifts=2, half_px=(36, 12), close_px=(32, 12), iterations=30),
    backscatter_positions=32,
    workers=2,
)


@dataclass(frozen=True)
class FitTime:
    """How long one term's fit took."""

    term: TermName
    seconds: float


@dataclass(frozen=True)
class Foundation:
    """The fits that psf and backscatter stand on.

    Attributes:
        times: how long these took.
        wire_map: the fitted wire over the sensor, which takes long enough to be kept.
        wire_sigma: how sure the map is at any pixel; None where no wire was fitted.
        boards: what the geometry was fitted to.
    """

    noise: FitResult[Noise]
    geometry: FitResult[Geometry]
    wire: FitResult[Wire]
    times: tuple[FitTime, ...]
    wire_map: Float[np.ndarray, "rows columns"]
    wire_sigma: MapSigma | None
    boards: tuple[BoardView, ...]


@dataclass(frozen=True)
class Calibration:
    """The five results of one session, and how long each took."""

    rig: RigDescription
    foundation: Foundation
    psf: FitResult[PsfField]
    backscatter: FitResult[Backscatter]
    times: tuple[FitTime, ...]

    def result(self, term: TermName) -> FitResult:
        """The result of a term by its name."""
        results: dict[TermName, FitResult] = {
            "noise": self.foundation.noise,
            "geometry": self.foundation.geometry,
            "wire": self.foundation.wire,
            "psf": self.psf,
            "backscatter": self.backscatter,
        }
        return results[term]

    def or_raise(self) -> Calibration:
        """Itself when every term can be used.

        Raises:
            FitError: with the advice of the first bad status otherwise.
        """
        for term in ORDER:
            self.result(term).or_raise()
        return self


class _Clock:
    """Runs fits one by one and notes how long each took."""

    def __init__(self, session: Session, progress: Callable[[TermName], None]) -> None:
        self._session, self._progress = session, progress
        self.times: list[FitTime] = []

    @contextmanager
    def of(self, term: TermName) -> Iterator[bool]:
        """Times what is done within; gives whether the session has steps of the term."""
        self._progress(term)
        start = time.perf_counter()
        yield bool(self._session.steps(term))
        self.times.append(FitTime(term, time.perf_counter() - start))

    def run(self, term: TermName, fit: Callable[[], FitResult[Term]], otherwise: Callable[[], Term]) -> FitResult[Term]:
        """The fit of a term, or what stands for it when the session has no steps of it."""
        with self.of(term) as captured:
            return fit() if captured else _left_out(term, otherwise())


def fit_foundation(
    session: Session, progress: Callable[[TermName], None] = lambda term: None, effort: FitEffort | None = None
) -> Foundation:
    """Fit noise, geometry and wire; arguments and errors as for ``fit_session``.

    This needs the steps of these terms only: it can go on while the others are captured.
    """
    rig, effort, clock = session.rig, effort or FitEffort(), _Clock(session, progress)
    noise = clock.run("noise", lambda: fit_noise(session), lambda: nominal_noise(rig))
    with clock.of("geometry") as captured:
        boards = tuple(read_views(session, noise.term)) if captured else ()
        geometry = (
            fit_views(boards, nominal_geometry(rig), (rig.camera.columns, rig.camera.rows), rig_prior(rig))
            if captured
            else _left_out("geometry", nominal_geometry(rig))
        )
    with clock.of("wire") as captured:
        wire_fit = fit_wire_session(session, noise.term, geometry.term, effort.wire_samples) if captured else None
        wire = wire_fit.result if wire_fit else _left_out("wire", absent_wire(rig, geometry.term))
    wire_map = sensor_map(wire.term, rig.camera.rows, rig.camera.columns)
    sigma = wire_fit.sigma if wire_fit else None
    return Foundation(noise, geometry, wire, tuple(clock.times), wire_map, sigma, boards)


def fit_session(
    session: Session,
    progress: Callable[[TermName], None] = lambda term: None,
    effort: FitEffort | None = None,
    foundation: Foundation | None = None,
) -> Calibration:
    """Fit every term of a session; a term without steps gets its nominal or absent form, a note and status ABSENT.

    Args:
        session: what was captured.
        progress: called with a term's name when its fit begins.
        effort: what the fits may spend.
        foundation: what ``fit_foundation`` found in the same session, when it has been run already.

    Raises:
        SessionError: when a file of the session is missing or damaged.
    """
    rig, effort, clock = session.rig, effort or FitEffort(), _Clock(session, progress)
    base = foundation or fit_foundation(session, progress, effort)
    noise, geometry = base.noise.term, base.geometry.term
    with ThreadPoolExecutor(effort.workers) as pool:
        psf = pool.submit(
            clock.run,
            "psf",
            lambda: fit_psf(
                read_psf(session, noise, base.wire.term, effort.psf), rig, geometry, base.wire.term, effort.psf
            ),
            lambda: absent_psf(rig, geometry),
        )
        backscatter = pool.submit(
            clock.run,
            "backscatter",
            lambda: fit_backscatter(session, noise, geometry, base.wire_map, effort.backscatter_positions),
            lambda: absent_backscatter(rig, geometry),
        )
    late = sorted(clock.times, key=lambda taken: ORDER.index(taken.term))
    return Calibration(rig, base, psf.result(), backscatter.result(), (*base.times, *late))


def _left_out(name: TermName, term: Term) -> FitResult[Term]:
    note = f"The session has no {name} steps; the term stands at what the rig description says, or is absent."
    return FitResult.failed(name, term, FitStatus.ABSENT, note)
