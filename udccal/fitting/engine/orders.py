"""Choice of a model's order by the data: the candidates, their evidence, and how probable each is.

All terms use one criterion: -2 ln of the probability of the data, parameters integrated out. Where parameters have a
proper prior, Laplace's approximation gives it. Where they have none, each parameter costs ln(samples): the
approximation for a prior as wide as one sample's information (BIC: Schwarz, Annals of Statistics 6, 1978).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Generic, TypeVar, final

import numpy as np
from jaxtyping import Float

from udccal.fitting.engine.gaussian import square_root
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
        fit: the result of the fit, of a type that the adapter chooses.
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

    def spread(
        self,
        samples: int,
        values: Callable[[Fit], Float[np.ndarray, " values"]],
        against: Float[np.ndarray, " tried"] | float = 0.0,
        cov: Callable[[Fit], Float[np.ndarray, "values values"]] | None = None,
        least: float = 0.0,
    ) -> Float[np.ndarray, "values values"]:
        """Spread of values about the chosen order's, by Akaike's weights (Buckland et al., Biometrics 53, 1997).

        BIC drops parameters that are small and not 0. Others then take their part, which no order's own error shows.

        Args:
            samples: number of data of the criteria, which are those of ``bic``; an infinite one counts for nothing.
            values: of a fit, those whose spread is asked for.
            against: part of each criterion that is no cost of its parameters.
            cov: of these values in one order. A parameter that the data hardly determine may be found near 0 by chance:
                what the orders above the chosen one do not know of it is then added.
            least: part of what the order with the most parameters does not know that is added in any case: a mixture
                of orders has wider tails than a normal distribution of its variance.
        """
        parameters = np.array([one.parameters for one in self.tried])
        akaike = np.array([one.criterion for one in self.tried]) - against - (np.log(max(samples, 2)) - 2) * parameters
        away = np.array([values(one.fit) for one in self.tried]) - values(self.best.fit)
        weight = np.exp(-0.5 * (akaike - akaike.min())) if np.isfinite(akaike.min()) else np.zeros(len(akaike))
        weight /= max(weight.sum(), 1.0)
        found = np.asarray((away.T * weight) @ away)
        if cov is not None:
            own = cov(self.best.fit)
            for w, one in zip(weight, self.tried, strict=True):
                if one.parameters > self.best.parameters:
                    # The part that is a covariance: at another place an order above may know more.
                    root = square_root(cov(one.fit) - own)
                    found = found + w * root @ root.T
            most = max(self.tried, key=lambda one: one.parameters if np.isfinite(one.criterion) else -1)
            root = square_root(cov(most.fit) - own - found)
            found = found + least * root @ root.T
        return found


def choose(tried: Iterable[Attempt[Fit]]) -> Choice[Fit]:
    """Choose the order with the lowest criterion, of at least one; of equal ones, the first."""
    found = tuple(tried)
    return Choice(min(found, key=lambda t: t.criterion), found)


def rising(
    orders: Iterable[Callable[[], Attempt[Fit]]],
    beats: Callable[[Attempt[Fit], Attempt[Fit]], bool],
    patience: int = 2,
) -> tuple[Attempt[Fit], ...]:
    """Try rising orders until ``patience`` of them in a row do not beat the best one before them; return all attempts.

    Args:
        orders: functions that fit one order each, simplest first.
        beats: whether its first argument, the later attempt, is better than the second.
        patience: more than 1, since an effect that is odd over the field needs a further order to show.
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
    """Bayesian information criterion of an order whose parameters have no prior (Schwarz, Ann. Stat. 6, 1978).

    Args:
        cost: minus twice the log likelihood at its maximum, such as chi-squared.
        parameters: how many the order has.
        samples: how many data the fit uses.
    """
    return cost + parameters * float(np.log(max(samples, 2)))


def evidence(
    cost: float, cov: Float[np.ndarray, "n n"], prior_sigma: Float[np.ndarray, " n"], against: float = 0.0
) -> float:
    """Criterion of an order whose parameters have independent priors: -2 ln of the evidence by Laplace's method.

    A parameter that the data do not determine costs nothing and stays, with its true error bar.

    Args:
        cost: chi-squared at the minimum, the prior's part included.
        cov: covariance of the n free parameters after the data.
        prior_sigma: sigma of the same parameters before the data.
        against: -2 ln of how probable the order is beforehand.
    """
    narrowed = cov / np.outer(prior_sigma, prior_sigma)
    return cost - float(np.linalg.slogdet(narrowed)[1]) + against


def held_out_beats(
    losses: Float[np.ndarray, " groups"], before: Float[np.ndarray, " groups"], worth: float = 0.0
) -> bool:
    """Whether an order predicts held-out data better, by more than ``worth`` and than the scatter of the groups.

    Args:
        losses: minus twice the log likelihood per sample, by independent group (position, view).
        before: the same of the order to beat.
        worth: the least gain that counts, in the unit of the losses.
    """
    gain = before - losses
    doubt = float(gain.std(ddof=1) / np.sqrt(gain.size)) if gain.size > 1 else np.inf
    return float(gain.mean()) > max(doubt, worth)


@final
@dataclass(frozen=True)
class Quantity:
    """A value with its variance; where ``there`` is False the data do not support it, and the value is the default."""

    value: float
    variance: float
    there: bool = True
    candidates: tuple[Candidate, ...] = ()

    @classmethod
    def asked(cls, name: str, value: float, variance: float, samples: int, gain: float | None = None) -> Quantity:
        """The value if it raises the likelihood (minus twice the logarithm) by more than BIC requires.

        The variance includes that the choice may be wrong (``Choice.spread``): a value that is there but too small to
        be asked for is further from its default than its own error says.

        Args:
            name: for the table of candidates.
            value, variance: the estimate; without ``gain`` it cannot be negative.
            samples: number of data that determine it.
            gain: of the likelihood; by default that of a normal estimate, 0 for a value below 0.
        """
        own = value**2 / variance if value > 0 and variance > 0 else 0.0
        simple = Attempt(f"without {name}", 0, own if gain is None else gain, 0.0)
        there = max(value, 0.0) if gain is None else value
        choice = choose((simple, Attempt(f"with {name}", 1, bic(0.0, 1.0, samples), there)))
        spread = float(choice.spread(samples, np.atleast_1d)[0, 0])
        return cls(choice.best.fit, variance + spread, choice.best.parameters > 0, choice.candidates)

    def root(self) -> tuple[float, float]:
        """The standard deviation, and its derivative by the variance, where the value is a variance.

        To first order a variance below its own sigma s would give the root far too large a sigma; there it is sqrt(s).
        Down to a variance three sigma lower, the root falls faster than to first order: its mean slope counts.
        """
        value, error = float(np.sqrt(max(self.value, 0.0))), float(np.sqrt(self.variance))
        if value**2 <= error:
            return value, float(1 / np.sqrt(max(error, 1e-300)))
        lower = float(np.sqrt(max(self.value - 3 * error, 0.0)))
        return value, max(0.5 / value, (value - lower) / max(3 * error, 1e-300))
