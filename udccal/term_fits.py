"""The fits of a session, each with the terms that it needs, and how long they took."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeVar, final

import numpy as np
from jaxtyping import Float

from udccal.effort import FitEffort
from udccal.fitting.backscatter.fit import fit_backscatter
from udccal.fitting.backscatter.parameters import BackscatterRules
from udccal.fitting.backscatter.read import read_backscatter
from udccal.fitting.geometry.data import BoardView, read_geometry
from udccal.fitting.geometry.fit import fit_boards
from udccal.fitting.noise.data import read_noise
from udccal.fitting.noise.fit import fit_noise, nominal_noise
from udccal.fitting.nominal import absent_backscatter, absent_psf, absent_wire, lacking, nominal_geometry
from udccal.fitting.psf.fit import fit_psf
from udccal.fitting.psf.start import read_psf
from udccal.fitting.wire.data import read_wire
from udccal.fitting.wire.fit import fit_wire, sensor_map
from udccal.fitting.wire.parameters import WireRules
from udccal.models.backscatter import Backscatter
from udccal.models.geometry import Geometry
from udccal.models.noise import Noise
from udccal.models.psf import PsfField
from udccal.models.wire import Wire
from udccal.planned_steps import skipped_note
from udccal.result import FitResult, FitStatus
from udccal.sessions.evidence import captures_of
from udccal.sessions.schema import TermName
from udccal.sessions.store import Session

Term = TypeVar("Term")


@dataclass(frozen=True)
class FitTime:
    """Duration of one term's fit."""

    term: TermName
    seconds: float


@final
class TermFits:
    """The fits of a session: each runs when it is first read, after those whose terms it needs.

    Setting a property keeps its fit from running. The wire fit goes on from ``wire_start`` where there is one.
    """

    def __init__(
        self,
        session: Session,
        effort: FitEffort | None,
        progress: Callable[[TermName], None] = lambda term: None,
        wire_start: Wire | None = None,
    ) -> None:
        self._wire_start = wire_start
        self._session, self._progress, self._effort = session, progress, effort or FitEffort()
        self.boards: tuple[BoardView, ...] = ()
        self.times: list[FitTime] = []

    @cached_property
    def noise(self) -> FitResult[Noise]:
        """The noise fit."""
        nominal = nominal_noise(self._session.rig)
        return self._run("noise", lambda: fit_noise(read_noise(self._session), nominal), lambda: nominal)

    @cached_property
    def geometry(self) -> FitResult[Geometry]:
        """The geometry fit; it sets ``boards``."""
        rig, noise = self._session.rig, self.noise.term

        def fit() -> FitResult[Geometry]:
            data = read_geometry(self._session, noise)
            self.boards = data.views
            return fit_boards(data)

        return self._run("geometry", fit, lambda: nominal_geometry(rig))

    @cached_property
    def wire(self) -> FitResult[Wire]:
        """The wire fit."""
        noise, geometry = self.noise, self.geometry.term
        rules = WireRules(samples=self._effort.wire_samples)

        def fit() -> FitResult[Wire]:
            black_sigma_DN = next((one.sigma for one in noise.estimates if one.name == "black_DN"), 0.0)
            data = read_wire(self._session, noise.term, geometry, rules, black_sigma_DN)
            return fit_wire(data, rules, self._wire_start)

        return self._run(
            "wire",
            fit,
            lambda: absent_wire(self._session.rig, geometry),
        )

    @cached_property
    def wire_map(self) -> Float[np.ndarray, "rows columns"]:
        """The fitted wire at every pixel."""
        camera = self._session.rig.camera
        return sensor_map(self.wire.term, camera.rows, camera.columns)

    @cached_property
    def psf(self) -> FitResult[PsfField]:
        """The psf fit."""
        noise, geometry, wire, wire_map = self.noise.term, self.geometry.term, self.wire.term, self.wire_map
        rig, rules = self._session.rig, self._effort.psf
        return self._run(
            "psf",
            lambda: fit_psf(read_psf(self._session, noise, wire_map, rules), rig, geometry, wire, rules),
            lambda: absent_psf(rig, geometry),
        )

    @cached_property
    def backscatter(self) -> FitResult[Backscatter]:
        """The backscatter fit."""
        noise, geometry, wire_map = self.noise.term, self.geometry.term, self.wire_map
        rig, rules = self._session.rig, BackscatterRules(positions=self._effort.backscatter_positions)
        return self._run(
            "backscatter",
            lambda: fit_backscatter(read_backscatter(self._session, noise, geometry, wire_map), geometry, rig, rules),
            lambda: absent_backscatter(rig, geometry),
        )

    def _run(self, term: TermName, fit: Callable[[], FitResult[Term]], absent: Callable[[], Term]) -> FitResult[Term]:
        """Run and time the fit of a term, or return its absent form where the session lacks what the fit needs."""
        self._progress(term)
        start = time.perf_counter()
        captured = self._session.steps(term)
        lacks = lacking(self._session, term)
        skipped = skipped_note(term, self._session.rig, {step.id for step in captured}) if captured else ""
        if captured and not lacks:
            result = replace(fit(), captures=captures_of(captured), effort=self._effort.label)
        else:
            notes = (f"Captured in part: the fit needs {lacks} as well.",) if captured else ()
            result = FitResult.failed(term, absent(), FitStatus.NOT_CAPTURED, *notes)
        result = replace(result, notes=(*result.notes, *filter(None, (skipped,))))
        self.times.append(FitTime(term, time.perf_counter() - start))
        return result
