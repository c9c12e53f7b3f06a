"""Draws the maps of a validation."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from udccal.reports.figures import row_of_axes
from udccal.validation.checks import ZMap

# Ends of the colour scale, in sigma: beyond three, noise is rare.
_LEAST = 4.0


def z_figure(found: ZMap) -> Figure:
    """Draw errors in sigma; white is 0, grey is where nothing was seen."""
    rows, columns = found.z.shape
    # Narrow maps would be thin stripes at their own proportions.
    narrow = not 0.3 < columns / rows < 3.0
    figure, (axis,) = row_of_axes(1, 5.2, 3.6)
    reach = max(_LEAST, float(np.nanpercentile(np.abs(found.z), 99.5)))
    axis.set_facecolor("0.8")
    image = axis.imshow(
        found.z, cmap="RdBu_r", vmin=-reach, vmax=reach, aspect="auto" if narrow else "equal", interpolation="nearest"
    )
    axis.set(xlabel=found.across, ylabel=found.down, xticks=[], yticks=[])
    figure.colorbar(image, ax=axis, shrink=0.8, label="σ")
    return figure
