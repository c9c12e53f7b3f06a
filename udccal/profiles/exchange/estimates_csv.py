"""Every estimate of a profile as a line of comma-separated values."""

from __future__ import annotations

import csv
import io
from typing import get_args

from udccal.errors import ProfileError
from udccal.profiles.exchange.format import ExportFormat
from udccal.profiles.profile import Profile
from udccal.sessions.schema import TermName

# A cell that begins so is a formula to spreadsheets.
_FORMULA = ("=", "+", "-", "@", "\t", "\r")


def _encode(profile: Profile) -> bytes:
    stream = io.StringIO(newline="")
    lines = csv.writer(stream, lineterminator="\n")
    lines.writerow(["term", "name", "value", "sigma", "unit"])
    for result in profile.results:
        for one in result.estimates:
            for text in (one.name, one.unit):
                _refuse_formula(text)
            lines.writerow([result.name, one.name, repr(float(one.value)), repr(float(one.sigma)), one.unit])
    return stream.getvalue().encode("utf-8")


def _refuse_formula(text: str) -> None:
    if text.startswith(_FORMULA):
        raise ProfileError(
            f"Expected names and units of quantities in the profile, found '{text[:60]}', which a spreadsheet would "
            "compute. Do not trust this profile, or export it to npz."
        )


EXPORT = ExportFormat(
    name="csv",
    terms=get_args(TermName),
    not_held=("A table holds the named quantities with their sigmas. It cannot hold maps, kernels and fields.",),
    encode=_encode,
)
