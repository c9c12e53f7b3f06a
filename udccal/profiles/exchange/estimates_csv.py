"""Every estimate of a profile as a line of comma-separated values."""

from __future__ import annotations

import csv
import io
from typing import get_args

from udccal.profiles.exchange.format import ExportFormat
from udccal.profiles.profile import Profile
from udccal.sessions.schema import TermName


def _encode(profile: Profile) -> bytes:
    stream = io.StringIO(newline="")
    lines = csv.writer(stream, lineterminator="\n")
    lines.writerow(["term", "name", "value", "sigma", "unit"])
    for result in profile.results:
        for one in result.estimates:
            lines.writerow([result.name, one.name, repr(float(one.value)), repr(float(one.sigma)), one.unit])
    return stream.getvalue().encode("utf-8")


EXPORT = ExportFormat(
    name="csv",
    terms=get_args(TermName),
    not_held=("A table holds the named quantities with their sigmas. It cannot hold maps, kernels and fields.",),
    encode=_encode,
)
