"""What a fit returns: the term, how sure it is, how it got there, and what to do when it failed."""

from __future__ import annotations

import enum
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar, runtime_checkable

import numpy as np
from jaxtyping import Float

from udccal.errors import FitError

Term = TypeVar("Term")
_Term_co = TypeVar("_Term_co", covariant=True)


class FitStatus(enum.Enum):
    """How a fit ended; the value tells a person what to do next."""

    CONVERGED = "The fit converged."
    ABSENT = "The data show no sign of this term; it is left out and costs nothing later."
    NOT_CONVERGED = "The solver stopped before it converged. Check the residual map, or allow more iterations."
    TOO_FEW_DATA = "There are fewer usable samples than parameters. Capture more positions, exposures or views."
    SATURATED = "Too much of the data is clipped. Capture again with a shorter exposure or less light."
    TOO_DARK = "The signal is buried in noise. Capture again with a longer exposure or more light."
    POOR_FIT = "The model does not describe the data. Check the rig description and the listed residuals."


@dataclass(frozen=True)
class Estimate:
    """One named quantity with its unit and one standard deviation."""

    name: str
    value: float
    sigma: float
    unit: str


@dataclass(frozen=True)
class Candidate:
    """One order that was tried: a lower criterion is better."""

    name: str
    parameters: int
    criterion: float
    chosen: bool


@dataclass(frozen=True)
class Diagnostic:
    """A number about the fit itself (residual RMS, rejected samples, iterations, ...)."""

    name: str
    value: float
    unit: str


@dataclass(frozen=True)
class Outliers:
    """Samples left out of a fit by a stated rule.

    Attributes:
        rule: what made them outliers, such as "off by more than 5 robust sigma of their view".
        count: how many.
        places: the first of them by name or position, for a person to look at.
    """

    rule: str
    count: int
    places: tuple[str, ...] = ()


@dataclass(frozen=True)
class ResidualSample:
    """Some of a fit's residuals, evenly drawn: where on the sensor they lie, and their size in units of their sigma."""

    positions_px: Float[np.ndarray, "n 2"]
    z: Float[np.ndarray, " n"]


@runtime_checkable
class TermPosterior(Protocol[_Term_co]):
    """How sure a fit is of its whole term, field coefficients included."""

    def sigma_of(self, f: Callable[[_Term_co], Float[np.ndarray, "*shape"]]) -> Float[np.ndarray, "*shape"]:
        """One standard deviation of every number that ``f`` makes of the term."""

    def draws(self, rng: np.random.Generator, count: int) -> tuple[_Term_co, ...]:
        """Terms drawn from the posterior."""


@dataclass(frozen=True)
class FitResult(Generic[Term]):
    """A fitted term and the evidence for it.

    Attributes:
        name: of the term: noise, geometry, wire, psf or backscatter.
        term: as fitted, or as the rig description has it where the fit failed.
        status: how the fit ended.
        estimates: named numbers of the term with one standard deviation each.
        cov: covariance of the leading estimates, in their units; all of them unless a note says otherwise.
        chi2_dof: reduced chi-squared, 1 where model and noise describe the data.
        samples: how many took part.
        candidates: the orders that were tried.
        diagnostics: numbers about the fit.
        notes: sentences for a person.
        outliers: what was left out, by rule.
        residuals: some of them, evenly drawn.
        posterior: of the whole term; None where the fit failed, and in a profile that was read from a file.
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

    @classmethod
    def failed(cls, name: str, term: Term, status: FitStatus, *notes: str) -> FitResult[Term]:
        """A result without estimates: the fit could not begin, or the session has no data for it."""
        return cls(name, term, status, (), np.zeros((0, 0)), 0.0, 0, notes=notes)

    @property
    def ok(self) -> bool:
        """Whether the term can be used."""
        return self.status in (FitStatus.CONVERGED, FitStatus.ABSENT)

    def estimate(self, name: str) -> Estimate:
        """The estimate of that name; raises KeyError naming those there are."""
        for item in self.estimates:
            if item.name == name:
                return item
        raise KeyError(f"no estimate '{name}'; there are {', '.join(e.name for e in self.estimates)}")

    def sigma_of(self, f: Callable[[Term], Float[np.ndarray, "*shape"]]) -> Float[np.ndarray, "*shape"]:
        """One standard deviation of any function of the term, such as its wire map, a kernel or a ray.

        Args:
            f: pure function from a term to an array. It is called twice for every direction of the posterior.

        Returns:
            an array of the shape and in the units of ``f(term)``.

        Raises:
            FitError: when the fit failed, or when the result was read from a profile.
        """
        if self.posterior is None:
            raise FitError(
                f"Expected a {self.name} fit with a posterior, found none: the fit failed, or the result was read from "
                "a profile, which keeps the covariance of the estimates alone. Fit the session again."
            )
        return self.posterior.sigma_of(f)

    def or_raise(self) -> FitResult[Term]:
        """Itself when usable.

        Raises:
            FitError: with the advice of the status otherwise.
        """
        if self.ok:
            return self
        detail = f" {' '.join(self.notes)}" if self.notes else ""
        raise FitError(f"The {self.name} fit ended as {self.status.name}: {self.status.value}{detail}")
