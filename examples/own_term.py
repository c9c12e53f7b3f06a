"""Fit a term of your own with udccal's engine, and compute the sigma of anything that follows from it.

python examples/own_term.py        # the term: how light falls off from a picture's centre, as cos^4 of the angle
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

import udccal
from udccal.fitting.engine.gaussian import Posterior
from udccal.fitting.engine.least_squares import Blocks, Step, minimise
from udccal.result import Estimate

TRUTH, NOISE_E = np.array([9000.0, 62.0, 50.0, 110.0]), 40.0
NAMES, UNITS = ("light_e", "centre_x_px", "centre_y_px", "focal_px"), ("e-", "px", "px", "px")
PIXELS = np.stack(np.meshgrid(np.arange(128.0), np.arange(96.0)), axis=-1).reshape(-1, 2)


@dataclass(frozen=True)
class Falloff:
    numbers: np.ndarray  # those of NAMES

    def at(self, pixels: np.ndarray) -> np.ndarray:
        light, x, y, focal = self.numbers
        return light / (1 + ((pixels - [x, y]) ** 2).sum(axis=-1) / focal**2) ** 2


@dataclass(frozen=True)
class Problem:
    seen_e: np.ndarray
    name: str = "falloff"

    def errors(self, place: np.ndarray) -> np.ndarray:
        return (Falloff(place).at(PIXELS) - self.seen_e) / NOISE_E

    def equations_at(self, place: np.ndarray) -> Blocks:
        slopes = [(self.errors(place + e) - self.errors(place - e)) / 0.02 for e in 0.01 * np.eye(4)]
        return Blocks.of_errors(self.errors(place), np.transpose(slopes))

    def moved(self, place: np.ndarray, step: Step) -> np.ndarray:
        return place + step.shared


seen = Falloff(TRUTH).at(PIXELS) + NOISE_E * np.random.default_rng(0).standard_normal(len(PIXELS))
found = minimise(Problem(seen), np.array([8000.0, 63.5, 47.5, 128.0]))
cov, chi2_dof = found.equations.cov(), found.equations.cost / (len(seen) - len(TRUTH))
status = udccal.FitStatus.CONVERGED if found.converged else udccal.FitStatus.NOT_CONVERGED
sigmas, posterior = np.sqrt(np.diag(cov)), Posterior.from_cov(found.place, cov, Falloff)
numbers = tuple(Estimate(*each) for each in zip(NAMES, found.place, sigmas, UNITS, strict=True))
term = Falloff(found.place)
result = udccal.FitResult("falloff", term, status, numbers, cov, chi2_dof, len(seen), posterior=posterior)
corner = result.propagate(lambda term: term.at(np.zeros(2)) / term.numbers[0])
for each in result.estimates:
    print(f"{each.name} {each.value:.4f} ± {each.sigma:.4f} {each.unit}")
print(f"{status.name}: the corner has {corner.value:.4f} ± {corner.sigma:.4f} of the light at the centre")
