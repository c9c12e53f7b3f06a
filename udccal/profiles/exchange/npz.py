"""Every number of a profile as named arrays for ``numpy.load``, without pickled objects."""

from __future__ import annotations

import dataclasses
import io
from collections.abc import Iterator
from typing import get_args

import numpy as np
from jaxtyping import Shaped

from udccal.profiles.exchange.format import ExportFormat
from udccal.profiles.profile import Profile
from udccal.sessions.schema import TermName


def _encode(profile: Profile) -> bytes:
    stream = io.BytesIO()
    np.savez_compressed(stream, allow_pickle=False, **dict(_arrays(profile)))
    return stream.getvalue()


def _arrays(profile: Profile) -> Iterator[tuple[str, Shaped[np.ndarray, "..."]]]:
    yield "wire_map", profile.wire_map
    yield "backscatter_white", profile.backscatter_mask
    for result in profile.results:
        yield from _fields(result.name, result.term)
        fit = f"{result.name}.fit"
        yield f"{fit}.status", np.array(result.status.name)
        yield f"{fit}.estimates", np.array([e.name for e in result.estimates], dtype=np.str_)
        yield f"{fit}.units", np.array([e.unit for e in result.estimates], dtype=np.str_)
        yield f"{fit}.values", np.array([e.value for e in result.estimates], dtype=np.float64)
        yield f"{fit}.sigmas", np.array([e.sigma for e in result.estimates], dtype=np.float64)
        yield f"{fit}.covariance", np.asarray(result.cov, dtype=np.float64)


def _fields(prefix: str, value: object) -> Iterator[tuple[str, Shaped[np.ndarray, "..."]]]:
    """The fields of a term under dotted names, those of terms within it too."""
    if dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            yield from _fields(f"{prefix}.{field.name}", getattr(value, field.name))
    elif isinstance(value, tuple | list):
        for index, item in enumerate(value):
            yield from _fields(f"{prefix}.{index}", item)
    elif value is not None:
        yield prefix, np.asarray(value)


EXPORT = ExportFormat(
    name="npz",
    terms=get_args(TermName),
    not_held=(
        "An npz file holds every number and covariance. It cannot hold notes, candidates, diagnostics and the rig.",
    ),
    encode=_encode,
)
