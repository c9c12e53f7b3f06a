"""Noise that the pixels of a line share, a row or a column: its variance, and how many lines are independent."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float

from udccal.fitting.engine.misfit import excess_variance
from udccal.fitting.engine.orders import Quantity
from udccal.fitting.noise.frame_moments import Moments
from udccal.fitting.noise.lines import Lines
from udccal.fitting.noise.moments import NoiseMoments

# Lines are independent unless fewer than this part of them are: chance changes the number of a small sensor's lines.
_BANDED = 0.5


@final
@dataclass(frozen=True)
class LineNoise:
    """Variance of the noise that lines share, and how many are ``independent``: fewer where they are ``banded``."""

    DN2: Quantity
    independent: float
    banded: bool

    def drawn_DN4(self, differences: int) -> float:
        """Variance of the variance that so many differences of frames show, as their lines are a draw."""
        return 2 * self.DN2.value**2 / (differences * self.independent)


def row_noise(data: NoiseMoments, row_gains: Float[np.ndarray, " pairs"]) -> tuple[LineNoise, float]:
    """Noise that rows share, and its root in the pairs alone, which is the one that widened their histograms.

    ``row_gains`` are those of the pairs.
    """
    seen, pairs, gains = _dark_frames(data), len(data.darks), row_gains
    if data.dark_seen is not None:
        nearest = int(np.argmin([abs(pair.exposure_s - data.dark_stack.exposure_s) for pair in data.darks]))
        gains = np.append(row_gains, row_gains[nearest])
    rows = [of.rows for of in seen]
    every, paired = (
        _line_noise("row noise", rows[:number], gains[:number], data.rounding_DN2, data.dark_samples)
        for number in (len(seen), pairs)
    )
    return every, float(np.sqrt(paired.DN2.value)) if every.DN2.there else 0.0


def column_noise(data: NoiseMoments) -> LineNoise:
    """Noise that columns share, which is a part of the pixels' temporal variance."""
    columns = [of.columns for of in _dark_frames(data)]
    return _line_noise("column noise", columns, np.ones(len(columns)), data.rounding_DN2, data.dark_samples)


def _dark_frames(data: NoiseMoments) -> tuple[Moments, ...]:
    return data.dark_moments if data.dark_seen is None else (*data.dark_moments, data.dark_seen)


def _line_noise(
    name: str, seen: Sequence[Lines], gains: Float[np.ndarray, " seen"], rounding_DN2: float, samples: int
) -> LineNoise:
    """The variance that lines share in all frames seen.

    Rounding and cut-off codes change the variance by the square of the ``gains``. How much depends on the distribution
    of the read noise, which coarse codes hardly show: half of the change is in the sigma.
    """
    independent, banded = _independent(seen)
    # Frames whose mean code follows black to less than a fifth do not determine row noise.
    used = [i for i, gain in enumerate(gains) if gain >= 0.2 and seen[i].variance_DN2 > 0]
    if not used:
        # Row noise that rounding hides completely may be as large as rounding itself.
        return LineNoise(Quantity.asked(name, 0.0, rounding_DN2**2, samples, 0.0), independent, banded)
    variances, sampling = np.array([(seen[i].variance_DN2, seen[i].sampling_DN2) for i in used]).T
    dof = np.array([(seen[i].frames - 1) * independent for i in used])
    squares = gains[used] ** 2, (0.5 * (1 + gains[used])) ** 2
    (value, variance, gain), (other, _, _) = (excess_variance(variances / of, sampling / of, dof) for of in squares)
    return LineNoise(Quantity.asked(name, value, variance + (value - other) ** 2, samples, gain), independent, banded)


def _independent(seen: Sequence[Lines]) -> tuple[float, bool]:
    """How many lines are as good as independent, and whether these are far fewer than there are.

    A variance of lines of the spectrum P has the relative variance 2 (sum of P^2) / (sum of P)^2, as that of so many
    independent ones. The squares of a spectrum that is an average of n have a mean larger by (n + 1) / n.
    """
    power, number = sum(of.power_DN2 for of in seen), sum(of.frames - 1 for of in seen)
    square = float(np.square(power).sum())
    lines = max(len(seen[0].power_DN2) - 1.0, 1.0)
    found = float(np.sum(power)) ** 2 / square * (number + 1) / number if square > 0 else lines
    return (max(found, 1.0), True) if found < _BANDED * lines else (lines, False)
