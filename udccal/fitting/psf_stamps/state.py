"""What a fit of stamps works on, and where it has come to."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from udccal.fitting.psf_stamps.data import Plane
from udccal.fitting.psf_stamps.field import PlaneField
from udccal.fitting.psf_stamps.prior import Envelope, Precisions


@dataclass(frozen=True)
class Scene:
    """What does not change during a fit.

    Attributes:
        planes: samples by colour. unit: positions scaled to about [-1, 1].
        read_e, clip_e: of the samples' noise.
    """

    planes: tuple[Plane, ...]
    unit: Float[np.ndarray, "stars 2"]
    read_e: float
    clip_e: float


@dataclass(frozen=True)
class State:
    """Where a fit has come to.

    Attributes:
        fields: by colour. centre_px: of the stars, from their middle samples. flux_e: by star and colour.
        precisions, envelopes: of the priors, by colour.
        keep: samples that are not outliers, by colour.
        model_error: relative error of the model that is allowed for beside the noise, while it is still coarse.
    """

    fields: tuple[PlaneField, ...]
    centre_px: Float[np.ndarray, "stars 2"]
    flux_e: Float[np.ndarray, "stars planes"]
    precisions: tuple[Precisions, ...]
    envelopes: tuple[Envelope, ...]
    keep: tuple[Bool[np.ndarray, "stars _samples"], ...]
    model_error: float = 0.0

    @property
    def maps_from(self) -> int:
        """Index in the border of the first coefficient of a map: behind places and light of the stars."""
        return self.flux_e.shape[0] * (2 + self.flux_e.shape[1])


def shifted(
    state: State, nodes: tuple[Float[np.ndarray, "_n"], ...], border: Float[np.ndarray, " border"], share: float = 1.0
) -> State:
    """The state with a share of changes added."""
    stars, planes = state.flux_e.shape
    start = state.maps_from
    own = share * border[:start].reshape(stars, 2 + planes)
    fields = []
    for field, change in zip(state.fields, nodes, strict=True):
        terms, rows, columns = field.nodes.shape
        warp, lateral = np.size(field.warp), np.size(field.lateral)
        fields.append(
            replace(
                field,
                nodes=field.nodes + share * change.reshape(rows, columns, terms).transpose(2, 0, 1),
                warp=field.warp + share * border[start : start + warp].reshape(-1, 2, 2),
                lateral=field.lateral + share * border[start + warp : start + warp + lateral].reshape(-1, 2),
            )
        )
        start += warp + lateral
    return replace(
        state,
        fields=tuple(fields),
        centre_px=state.centre_px + own[:, :2],
        flux_e=state.flux_e * np.exp(own[:, 2:]),
    )
