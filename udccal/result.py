"""What a fit returns: the term, its uncertainty, diagnostics, and advice when the fit failed."""

from __future__ import annotations

import abc
import enum
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, Literal, Protocol, TypeVar, final, runtime_checkable

import numpy as np
from jaxtyping import Float, Float32

from udccal.errors import FitError, UdccalError

Term = TypeVar("Term")
_Term_co = TypeVar("_Term_co", covariant=True)
Effort = Literal["full", "quick", "own"]


class FitStatus(enum.Enum):
    """How a fit ended; the value says what to do next."""

    CONVERGED = "The fit converged."
    ABSENT = "The data show no sign of this term; it is left out and costs nothing later."
    NOT_CAPTURED = (
        "Nobody looked: the session has no captures of this term, or too few. It keeps the rig description's nominal "
        "values, or is left out. Capture it to measure it."
    )
    IMPORTED = "Taken from another program's file, which gives no error bars. Capture it to measure it."
    NOT_CONVERGED = "The solver stopped before it converged. Check the residual map, or allow more iterations."
    TOO_FEW_DATA = "There are fewer usable samples than parameters. Capture more positions, exposures or views."
    SATURATED = "Too much of the data is clipped. Capture again with a shorter exposure or less light."
    TOO_DARK = "The signal is buried in noise. Capture again with a longer exposure or more light."
    POOR_FIT = "The model does not describe the data. Check the rig description and the listed residuals."


@dataclass(frozen=True)
class EstimatePrior:
    """What was known of a quantity before the data: a nominal value, and its tolerance as one standard deviation."""

    value: float
    sigma: float


@dataclass(frozen=True)
class Estimate:
    """One named quantity with its unit and its standard deviation.

    ``quantities.toml`` says what it is. ``prior`` is what the fit started from; None where nothing was assumed.
    """

    name: str
    value: float
    sigma: float
    unit: str
    prior: EstimatePrior | None = None

    @property
    def by_prior(self) -> bool:
        """Whether the prior decides: at least half of what is known of the quantity is the prior."""
        return self.prior is not None and self.sigma >= self.prior.sigma * math.sqrt(0.5)


@dataclass(frozen=True)
class Candidate:
    """One order that was tried; a lower criterion is better."""

    name: str
    parameters: int
    criterion: float
    chosen: bool


@dataclass(frozen=True)
class Diagnostic:
    """A number that describes the fit (residual RMS, rejected samples, iterations, ...)."""

    name: str
    value: float
    unit: str


@dataclass(frozen=True)
class Outliers:
    """Samples left out of a fit by a documented rule.

    Attributes:
        rule: the rule, such as "off by more than 5 robust sigma of their view".
        count: number of samples left out.
        places: names or positions of the first of them, for a person to inspect.
    """

    rule: str
    count: int
    places: tuple[str, ...] = ()


@dataclass(frozen=True)
class ResidualSample:
    """An even sample of a fit's residuals: positions on the sensor, and residuals ``z`` in units of their sigma."""

    positions_px: Float[np.ndarray, "n 2"]
    z: Float[np.ndarray, " n"]


@dataclass(frozen=True)
class Captures:
    """The captures of a term that a fit used.

    Attributes:
        sha256: of the checksums of their files, in any order: fits of the same files have the same.
        files: number of the files. frames: number of the camera's frames in them.
        gain_dB: lowest and highest.
        completed_at: of the first and of the last step, in ISO 8601.
        temperature_C: lowest and highest of the captures that have one; None where none has.
        steps: digest of each step, sorted (``sessions.evidence.step_digest``); None where they are not known.
    """

    sha256: str
    files: int
    frames: int
    gain_dB: tuple[float, float]
    completed_at: tuple[str, str]
    temperature_C: tuple[float, float] | None = None
    steps: tuple[str, ...] | None = None


@final
@dataclass(frozen=True)
class Propagated:
    """A function of a term, with the uncertainty that it has by the term's posterior, to first order.

    Attributes:
        value: of the function at the fitted term.
        factor: derivatives of the flattened value along the posterior's directions; ``factor @ factor.T`` is ``cov``.
    """

    value: Float[np.ndarray, "*shape"]
    factor: Float[np.ndarray, "n k"]

    @property
    def sigma(self) -> Float[np.ndarray, "*shape"]:
        """One standard deviation of every element of ``value``, in its unit."""
        return np.asarray(np.sqrt((self.factor**2).sum(axis=1)).reshape(np.shape(self.value)))

    @property
    def cov(self) -> Float[np.ndarray, "n n"]:
        """Covariance of the flattened ``value``, in products of its units."""
        return np.asarray(self.factor @ self.factor.T)


@runtime_checkable
class TermPosterior(Protocol[_Term_co]):
    """Posterior distribution of a whole term, field coefficients included."""

    def sigma_of(self, f: Callable[[_Term_co], Float[np.ndarray, "*shape"]]) -> Float[np.ndarray, "*shape"]:
        """Return one standard deviation of every element of ``f(term)``."""

    def propagate(self, f: Callable[[_Term_co], Float[np.ndarray, "*shape"]]) -> Propagated:
        """Return ``f(term)`` with its covariance."""

    def draws(self, rng: np.random.Generator, count: int) -> tuple[_Term_co, ...]:
        """Draw ``count`` terms from the posterior."""


@dataclass(frozen=True, eq=False)
class FitResult(Generic[Term]):
    """A fitted term and the evidence for it. As it holds arrays, it is equal to itself alone.

    Attributes:
        name: noise, geometry, wire, psf or backscatter.
        term: the fitted term; the rig description's nominal term where the fit failed.
        status: how the fit ended; NOT_CAPTURED where the session lacks captures of the term, IMPORTED where the term
            is of another program.
        estimates: named numbers of the term, each with its standard deviation.
            An element of the term's arrays has the array's name and its indices: ``fields.3.0.1.2``.
        cov: covariance of the leading estimates, in their units; of all estimates unless a note says otherwise.
        chi2_dof: reduced chi-squared; about 1 where model and noise describe the data.
        samples: number of samples used.
        candidates: the orders that were tried.
        diagnostics: numbers that describe the fit.
        notes: sentences for a person.
        outliers: samples left out, by rule.
        residuals: an even sample of the residuals.
        posterior: distribution of the whole term; None where the fit failed or the result was read from a profile.
        map_sigma: sigma of the term's map, on a coarse grid over the sensor: of the wire, relative; of the panel's
            white in e-/s, by colour. None where none was stated.
        captures: what the fit used; None where that is not known.
        effort: of the fit: full, quick or own (``FitEffort.label``); None where that is not known.
    """

    name: str
    term: Term
    status: FitStatus
    estimates: tuple[Estimate, ...]
    cov: Float[np.ndarray, "n n"]
    chi2_dof: float
    samples: int
    candidates: tuple[Candidate, ...] = ()
    diagnostics: tuple[Diagnostic, ...] = ()
    notes: tuple[str, ...] = ()
    outliers: tuple[Outliers, ...] = ()
    residuals: ResidualSample | None = None
    posterior: TermPosterior[Term] | None = None
    map_sigma: Float32[np.ndarray, "channels grid_rows grid_columns"] | None = None
    captures: Captures | None = None
    effort: Effort | None = None

    @classmethod
    def failed(cls, name: str, term: Term, status: FitStatus, *notes: str) -> FitResult[Term]:
        """A result without estimates: the fit could not begin, or the session has no data for it."""
        return cls(name, term, status, (), np.zeros((0, 0)), 0.0, 0, notes=notes)

    def diagnostic(self, name: str) -> float | None:
        """The diagnostic of this name; None where the fit has none."""
        return next((item.value for item in self.diagnostics if item.name == name), None)

    @property
    def ok(self) -> bool:
        """Whether nothing went wrong: the fit ended well, or there was nothing to fit."""
        return self.status in (FitStatus.CONVERGED, FitStatus.IMPORTED) or self.unfitted

    @property
    def unfitted(self) -> bool:
        """Whether the term was not fitted: the data show no sign of it, or there are none."""
        return self.status in (FitStatus.ABSENT, FitStatus.NOT_CAPTURED)

    @property
    def usable(self) -> bool:
        """Whether the term may go into a profile: the fit ended well, or its error bars can be stated all the same.

        A fit that stopped early has the way that was left in its covariance, a poor one has its misfit there.
        """
        numbers = [number for e in self.estimates for number in (e.value, e.sigma)]
        stated = bool(self.estimates) and self.cov.size > 0 and np.isfinite(self.chi2_dof)
        return self.ok or bool(stated and np.isfinite(numbers).all() and np.isfinite(self.cov).all())

    @property
    def numbers(self) -> tuple[Estimate, ...]:
        """The estimates that have a meaning of their own, without elements of the term's arrays."""
        return tuple(one for one in self.estimates if "." not in one.name)

    @property
    def warning(self) -> str:
        """A sentence for a term that is usable though its fit did not end well; empty for others."""
        if self.ok or not self.usable:
            return ""
        return (
            f"Careful: the {self.name} fit ended as {self.status.name}. {self.status.value} Its error bars include "
            "this; check them before you rely on the term."
        )

    def estimate(self, name: str) -> Estimate:
        """Return an estimate by its name.

        Raises:
            KeyError: when there is none; the message lists the names.
        """
        for item in self.estimates:
            if item.name == name:
                return item
        raise KeyError(f"no estimate '{name}'; there are {', '.join(e.name for e in self.estimates)}")

    def sigma_of(self, f: Callable[[Term], Float[np.ndarray, "*shape"]]) -> Float[np.ndarray, "*shape"]:
        """Return one standard deviation of any function of the term, such as its wire map, a kernel or a ray.

        Args:
            f: pure function from a term to an array. It is called twice for every direction of the posterior.

        Returns:
            an array of the shape and in the units of ``f(term)``.

        Raises:
            FitError: when the fit failed, the result was read from a profile, or ``f`` is no function or gives anything
                but finite real numbers.
        """
        return self._whole_posterior().sigma_of(f)

    def propagate(self, f: Callable[[Term], Float[np.ndarray, "*shape"]]) -> Propagated:
        """Return any function of the term with its sigma and its covariance.

        The covariance is that of the delta method: the function's derivatives along the posterior, which are held
        together. Of a large array, such as a whole map, ``sigma_of`` needs far less memory.

        Args:
            f: pure function from a term to a number or an array. It is called twice for every direction of the
                posterior.

        Returns:
            the value, its sigma and its covariance, in the units of ``f(term)``.

        Raises:
            FitError: when the fit failed, the result was read from a profile, or ``f`` is no function or gives anything
                but finite real numbers.
        """
        return self._whole_posterior().propagate(f)

    def _whole_posterior(self) -> TermPosterior[Term]:
        if self.posterior is None:
            raise FitError(
                f"Expected a {self.name} fit with a posterior, found none: the fit failed, or the result was read from "
                "a profile, which keeps only the covariance of the estimates. Fit the session again."
            )
        return self.posterior

    def or_raise(self) -> FitResult[Term]:
        """Return itself when the fit ended well.

        Raises:
            FitError: when it did not, with the advice of the status.
        """
        if self.ok:
            return self
        raise self.error()

    def error(self) -> FitError:
        """The error of a fit that did not end well, with the advice of its status."""
        detail = f" {' '.join(self.notes)}" if self.notes else ""
        return FitError(f"The {self.name} fit ended as {self.status.name}: {self.status.value}{detail}")


class TermResults(abc.ABC):
    """The results of all five terms: of a calibration, or as a profile keeps them."""

    @property
    @abc.abstractmethod
    def results(self) -> tuple[FitResult, FitResult, FitResult, FitResult, FitResult]:
        """All five results, in the order of ``TermName``."""

    def result(self, term: str) -> FitResult:
        """Return the result of a term by its name.

        Raises:
            UdccalError: when ``term`` is not the name of a term.
        """
        for result in self.results:
            if result.name == term:
                return result
        names = ", ".join(result.name for result in self.results)
        raise UdccalError(f"Expected a term, one of {names}, found '{term}'. Name one of these.")

    @property
    def warnings(self) -> tuple[str, ...]:
        """A sentence for each term that is usable though its fit did not end well."""
        return tuple(result.warning for result in self.results if result.warning)
