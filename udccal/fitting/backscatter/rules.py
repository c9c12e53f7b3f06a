"""The documented constants of the backscatter fit."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import final

from udccal.fitting.engine.least_squares import SolverRules


@final
@dataclass(frozen=True)
class BackscatterRules:
    """What a backscatter fit looks at, what it leaves out, and when it is content.

    Attributes:
        positions: places on the sensor that the footprint is fitted at.
        fewest_pictures: beside white and dark.
        most_clipped: a shot with a larger share of clipped bins is left out whole; of others, the clipped bins are.
        visible_sigma, present_sigma: white that is below this many sigma of a bin at the 90th percentile of bins, or of
            all bins together, is no light.
        slack_px: room that a window of panel pixels leaves for the footprint to move during a fit.
        most_wider: a fit whose footprints want a window this many times as wide has gone astray.
        first_error: model error, as a share of white, that a fit from far away is taken to have.
        settled: such a fit goes on while its model error shrinks by more than this factor, ...
        first_fits: ... and at most so often.
        reflections: light of the second plane over that of the first, where fits of two planes start. Where the farther
            one is the brighter, a fit that begins with the nearer one brighter may end at its mirror image.
        worse_pictures: a picture described so many times worse than the others does not belong.
        sample_rounds: outliers of a bin are taken out one by one, at most so many.
        lost_bin: a bin goes altogether when more than this share of its shots is left out: dust, or a hot sample.
        nothing_fits: model error, as a share of white, from which orders are not compared.
        hopeless: rise of chi-squared from which an order is not fitted any more.
        held_out: every so-manyth picture is predicted by a fit without it.
        cells: residuals are averaged over so many parts of the sensor, across and down, in search of a pattern.
        narrow: a sigma of ln(reflection) below this makes its posterior normal: the mean is off by a twentieth of a
            sigma at most.
        negligible: parts of the posterior below exp of this, relative to its top, weigh nothing.
        most_nodes: values of the reflection that the posterior is worked out at, to either side.
        worst_error: of held-out pictures, noise apart, as a share of their peak.
        undetermined: sigma of where footprints lie, over that of the prior, from which pictures say too little, ...
        known: ... unless it is as well known as this: ln of distance and pupil, offsets in panel pixels.
        steady: variance between frames of a picture, over noise, from which the panel may flicker.
        most_outliers: share of the pictures.
        solver: of every descent.
    """

    positions: int = 96
    fewest_pictures: int = 6
    most_clipped: float = 0.02
    visible_sigma: float = 2.0
    present_sigma: float = 5.0
    slack_px: float = 0.7
    most_wider: float = 3.0
    first_error: float = 0.3
    settled: float = 0.7
    first_fits: int = 4
    reflections: tuple[float, ...] = (4.0, 1.0, 0.2)
    worse_pictures: float = 4.0
    sample_rounds: int = 4
    lost_bin: float = 0.5
    nothing_fits: float = 0.05
    hopeless: float = 1000.0
    held_out: int = 4
    cells: int = 3
    narrow: float = 0.1
    negligible: float = -6.0
    most_nodes: int = 12
    worst_error: float = 0.05
    undetermined: float = 0.5
    known: tuple[float, float, float, float] = (0.1, 0.1, 0.5, 0.5)
    steady: float = 1.3
    most_outliers: float = 0.25
    solver: SolverRules = field(default_factory=lambda: SolverRules(iterations=60))
