"""Which order of a model the data ask for: the candidates, their evidence, and how probable each is.

One criterion for all terms: -2 ln of the probability of the data, parameters integrated out. Where parameters have a
proper prior that is Laplace's approximation; where they have none, each parameter is priced at ln(samples), which is
what the approximation comes to for a prior as wide as one sample's information (Schwarz, Annals of Statistics 6, 1978).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Generic, TypeVar, final

import numpy as np
from jaxtyping import Float

from udccal.result import Candidate

Fit = TypeVar("Fit")


@final
@dataclass(frozen=True)
class Attempt(Generic[Fit]):
    """One order, fitted.

    Attributes:
        name: of the order, for a person.
        parameters: how many it has.
        criterion: lower is better; infinite where the fit failed.
        fit: whatever the adapter needs of it.
    """

    name: str
    parameters: int
    criterion: float
    fit: Fit


@final
@dataclass(frozen=True)
class Choice(Generic[Fit]):
    """The best of the orders that were tried, and all of them."""

    best: Attempt[Fit]
    tried: tuple[Attempt[Fit], ...]

    @property
    def candidates(self) -> tuple[Candidate, ...]:
        """For the result's table."""
        return tuple(Candidate(t.name, t.parameters, t.criterion, t is self.best) for t in self.tried)

    @property
    def probabilities(self) -> Float[np.ndarray, " tried"]:
        """How probable each order is, by its criterion (Hoeting et al., Statistical Science 14, 1999)."""
        criteria = np.array([t.criterion for t in self.tried])
        odds = np.exp(-0.5 * (criteria - self.best.criterion))
        return np.asarray(odds / odds.sum())


def choose(tried: Iterable[Attempt[Fit]]) -> Choice[Fit]:
    """The order with the lowest criterion; of equals, the first."""
    found = tuple(tried)
    return Choice(min(found, key=lambda t: t.criterion), found)


def rising(
    orders: Iterable[Callable[[], Attempt[Fit]]],
    beats: Callable[[Attempt[Fit], Attempt[Fit]], bool],
    patience: int = 2,
) -> tuple[Attempt[Fit], ...]:
    """Attempts of rising order, until ``patience`` of them in a row do not beat the best before them.

    More than one, since what grows from one side of the field to the other has no mean.
    """
    tried: list[Attempt[Fit]] = []
    best, in_vain = None, 0
    for attempt in orders:
        tried.append(attempt())
        if best is None or beats(tried[-1], best):
            best, in_vain = tried[-1], 0
        elif (in_vain := in_vain + 1) == patience:
            break
    return tuple(tried)


def bic(cost: float, parameters: float, samples: int) -> float:
    """Criterion of an order whose parameters have no prior."""
    return cost + parameters * float(np.log(max(samples, 2)))


def evidence(
    cost: float, cov: Float[np.ndarray, "n n"], prior_sigma: Float[np.ndarray, " n"], against: float = 0.0
) -> float:
    """Criterion of an order whose parameters have independent priors: -2 ln of the evidence by Laplace's method.

    A parameter that the data cannot tell costs nothing and stays, with its true error bar.

    Args:
        cost: chi-squared at the minimum, what the prior adds included.
        cov: of the free parameters, after the data.
        prior_sigma: of the same.
        against: -2 ln of how probable the order is beforehand.
    """
    narrowed = cov / np.outer(prior_sigma, prior_sigma)
    return cost - float(np.linalg.slogdet(narrowed)[1]) + against


def held_out_beats(
    losses: Float[np.ndarray, " groups"], before: Float[np.ndarray, " groups"], worth: float = 0.0
) -> bool:
    """Whether data held out are predicted better, by more than ``worth`` and than what their groups leave in doubt.

    Args:
        losses: minus twice the log likelihood per sample, by independent group (position, view).
        before: the same of the order to beat.
        worth: the least gain that counts.
    """
    gain = before - losses
    doubt = float(gain.std(ddof=1) / np.sqrt(gain.size)) if gain.size > 1 else np.inf
    return float(gain.mean()) > max(doubt, worth)


@final
@dataclass(frozen=True)
class Quantity:
    """A value with its variance; where ``there`` is False the data do not ask for it and the value is that without."""

    value: float
    variance: float
    there: bool = True
    candidates: tuple[Candidate, ...] = ()

    @classmethod
    def asked(
        cls, name: str, value: float, variance: float, samples: int, gain: float | None = None, without: float = 0.0
    ) -> Quantity:
        """The value where the likelihood gains more by it (minus twice the logarithm) than BIC asks.

        Args:
            name: for the table of candidates.
            value, variance: as the data have them; the variance is kept where the value is not.
            samples: data that bear on it.
            gain: of the likelihood; by default that of a normal estimate, which is none below 0.
            without: the value where the data do not ask for it.
        """
        own = value**2 / variance if value > 0 and variance > 0 else 0.0
        simple = Attempt(f"without {name}", 0, own if gain is None else gain, without)
        choice = choose((simple, Attempt(f"with {name}", 1, bic(0.0, 1.0, samples), value)))
        return cls(choice.best.fit, variance, choice.best.parameters > 0, choice.candidates)

    def root(self) -> tuple[float, float]:
        """Where the value is a variance: the standard deviation, and its derivative by the variance.

        Where the value is lost in its error the root is that far from zero at most, not to first order.
        """
        value, error = float(np.sqrt(max(self.value, 0.0))), float(np.sqrt(self.variance))
        return value, 0.5 / value if value**2 > error else float(1 / np.sqrt(max(error, 1e-300)))
