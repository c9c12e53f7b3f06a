"""The constants of a fit of stamps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final


@final
@dataclass(frozen=True)
class StampsRules:
    """The constants of a fit of stamps.

    Attributes:
        fewest_stars: that are fitted at all.
        least_snr: light over noise of the median stamp.
        fewest_unclipped: stamps, at least, whose core (``core_px`` about the middle) is neither clipped nor missing.
        outlier_sigma: samples further off, in robust sigma, are left out.
        star_ratio, star_lost: stamps are left out whose mean square is over so many times the median's, or that lose
            more than such a part of their samples.
        coarse: degrees of map and images, and the relative error of the model that is allowed for, of the fits that
            lead from a round star to a field.
        coarse_steps: of each of these.
        spacings_px: of nodes, the coarsest first.
        worth_finer: nodes are made denser again where the criterion may still fall by so much.
        highest_map, highest_image: degrees.
        steps_to_judge, steps_to_judge_new, steps_to_end: of one fit at most: of candidates, of those with a degree that
            comes new, and of the fit that is given.
        gain, evidence: converged when one more step would raise the log posterior by less, and the last one raised the
            log evidence by less.
        beyond_doubt: log evidence; candidates expected to lose more are not fitted.
        worth_fitting: nor those expected to gain less than this part of what their precisions cost.
        first_image, first_map, first_lateral: precisions before the data: of images of degree 0 (size, roughness) and
            of higher ones, of maps and of lateral colour by degree.
        new_image, new_map: of a degree that comes new, relative to the degree below it, and as it is: nearly absent.
            Where the data ask for it, one update makes it appear.
        update_draws, draws: of the posterior: for updates of precisions, and for error bars (5 % of a sigma).
        inflate_above: reduced chi-squared above which every sigma grows with its root. Counts are skewed: theirs
            scatters more than that of normal samples.
        poor_above: reduced chi-squared beyond which this is no psf field.
    """

    fewest_stars: int = 4
    least_snr: float = 10.0
    fewest_unclipped: int = 3
    core_px: float = 1.5
    outlier_sigma: float = 5.0
    star_ratio: float = 3.0
    star_lost: float = 0.2
    coarse: tuple[tuple[int, int, float], ...] = ((0, 0, 0.3), (0, 0, 0.1), (2, 0, 0.05), (2, 1, 0.02))
    coarse_steps: int = 2
    spacings_px: tuple[float, ...] = (1.0, 0.75, 0.5)
    worth_finer: float = 200.0
    highest_map: int = 4
    highest_image: int = 3
    steps_to_judge: int = 2
    steps_to_judge_new: int = 1
    steps_to_end: int = 12
    gain: float = 0.3
    evidence: float = 2.0
    beyond_doubt: float = 200.0
    worth_fitting: float = 0.5
    first_image: tuple[tuple[float, float], tuple[float, float]] = ((1e-3, 1e-4), (30.0, 30.0))
    first_map: float = 100.0
    first_lateral: float = 10.0
    new_image: float = 20.0
    new_map: float = 3e4
    update_draws: int = 16
    draws: int = 192
    inflate_above: float = 1.05
    poor_above: float = 2.0
