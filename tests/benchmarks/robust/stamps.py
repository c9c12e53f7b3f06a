"""Stamps of point sources of any shape: numbers of stamps, light, backgrounds, hits, and input that is wrong."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tests.benchmarks.robust.family import WORST_Z, Answer, Case, Family, Number, all_finite
from tests.scenes.stamps import SHAPES, Drawn, drawn
from udccal.fitting.psf_stamps.data import Stamps
from udccal.fitting.psf_stamps.fit import fit_psf_stamps
from udccal.fitting.psf_stamps.term import StampsPsf
from udccal.result import FitResult

_WRONG = ("hits", "positions", "missing", "lost", "noise")
# Of the pixels of held-out kernels, all but one in a thousand count: each kernel has up to 961.
_PART = 0.999
# Where one pattern dominates a kernel's error, such as light that lies evenly all over a stamp, the error is |x| times
# its RMS, x normal. It scatters by this part of the RMS, and |x| of 4.5 is this many times the scatter above the RMS.
# Errors of many patterns scatter less.
_SCATTER = np.sqrt(1 - 2 / np.pi)
_SCATTERS = (WORST_Z - 1) / _SCATTER
_PLACES, _DRAWS = 8, 64


def draw(seed: int) -> Case:
    """A shape, stamps, a background in half of the sets, and in a third of them something wrong."""
    rng = np.random.default_rng([seed, 31])
    name, count, size = str(rng.choice(SHAPES)), int(rng.choice([20, 40, 60, 80])), int(rng.choice([15, 21, 31]))
    light_e, read_e = float(np.exp(rng.uniform(np.log(5e3), np.log(3e5)))), float(rng.uniform(1.0, 8.0))
    level = float(rng.uniform(-20.0, 300.0)) if rng.random() < 0.5 else 0.0
    background = (level, abs(level) * float(rng.choice([0.0, 0.05, 0.2])))
    wrong = str(rng.choice(_WRONG)) if rng.random() < 0.33 else ""
    # Rings and crosses wider than the stamps are not what the fit claims to describe.
    sound = wrong in ("", "hits", "missing") and size == 31 and not level

    def answer() -> Answer:
        data = drawn(name, seed, count, size, light_e, read_e, background, varies=float(rng.uniform(0.0, 1.0)))
        return _answer(replace(data, stamps=_broken(data.stamps, wrong, rng)))

    what = (
        f"{name}, {count} of {size} px, {light_e:.0f} e-, background {background[0]:.0f} e-, {wrong or 'nothing'} wrong"
    )
    return Case(what, answer, sound, work=count / 60)


def _broken(stamps: Stamps, wrong: str, rng: np.random.Generator) -> Stamps:
    """Return the stamps with one thing wrong."""
    values, count = stamps.values_e.copy(), len(stamps.values_e)
    if wrong == "hits":
        values += 5000.0 * (rng.random(values.shape) < 1e-3)
    elif wrong == "missing":
        values[rng.random(values.shape) < 0.03] = rng.choice([np.nan, np.inf])
    elif wrong == "lost":
        values[: count // 4] = np.nan
    elif wrong == "positions":
        return replace(stamps, position_px=stamps.position_px[rng.permutation(count)])
    elif wrong == "noise":
        return replace(stamps, read_e=stamps.read_e / 4)
    return replace(stamps, values_e=values)


def _answer(data: Drawn) -> Answer:
    result = fit_psf_stamps(data.stamps)
    if not result.ok:
        return Answer(False, result.notes, (), all_finite(result.cov, result.chi2_dof))
    found, stated, z = data.errors(result.term, _PLACES)
    off, expected = (float(np.sqrt((part**2).mean())) for part in (found, stated))
    numbers = (
        Number("pixels of held-out kernels", float(np.quantile(np.abs(z), _PART)), 1.0),
        Number("held-out kernels, RMS", max(off - expected, 0.0), _scatter(result, data) * _SCATTERS / WORST_Z),
    )
    return Answer(True, result.notes, numbers, all_finite(found, stated, z, result.cov, result.chi2_dof))


def _scatter(result: FitResult[StampsPsf], data: Drawn) -> float:
    """By how much the relative L2 error of all held-out kernels together scatters, by the result's own posterior."""
    places = data.held_out(_PLACES)
    best, posterior = result.term.predict(places), result.posterior
    assert posterior is not None
    size = np.linalg.norm(best, axis=(1, 2))
    drawn = (term.predict(places) - best for term in posterior.draws(np.random.default_rng(0), _DRAWS))
    return float(np.std([np.sqrt(((np.linalg.norm(off, axis=(1, 2)) / size) ** 2).mean()) for off in drawn]))


# Limits of a fit of 60 stamps.
FAMILY = Family("stamps", draw, most_cpu_s=15.0, most_MiB=1024.0)
