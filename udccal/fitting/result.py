"""What a fit returns: the term, how sure it is, how it got there, and what to do when it failed."""

from __future__ import annotations

import enum
from dataclasses import dataclass, field
from typing import Generic, TypeVar

import numpy as np
from jaxtyping import Float

from udccal.errors import FitError

Term = TypeVar("Term")


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


@dataclass(frozen=True)
class FitResult(Generic[Term]):
    """A fitted term and the evidence for it.

    ``estimates`` and ``cov`` are in the same order; ``cov`` may cover the leading estimates only when the term has
    thousands of field coefficients (then ``notes`` says so).
    """

    term: Term
    status: FitStatus
    estimates: tuple[Estimate, ...]
    cov: Float[np.ndarray, "n n"]
    chi2_dof: float
    samples: int
    candidates: tuple[Candidate, ...] = ()
    diagnostics: tuple[Diagnostic, ...] = ()
    notes: tuple[str, ...] = field(default=())
    outliers: tuple[Outliers, ...] = ()
    residuals: ResidualSample | None = None

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

    def or_raise(self, term_name: str) -> FitResult[Term]:
        """Itself when usable.

        Raises:
            FitError: with the advice of the status otherwise.
        """
        if self.ok:
            return self
        detail = f" {' '.join(self.notes)}" if self.notes else ""
        raise FitError(f"The {term_name} fit ended as {self.status.name}: {self.status.value}{detail}")
