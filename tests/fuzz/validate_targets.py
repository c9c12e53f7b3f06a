"""A session against a profile whose numbers were changed."""

from __future__ import annotations

import functools
import math
from pathlib import Path

from tests.fuzz.profile_targets import _changed, _kept_folder, _rig, _seeds, _whole
from tests.fuzz.target import Target
from udccal.benches.bench import simulate
from udccal.benches.capture import capture
from udccal.profiles.provenance import PROFILE_NAME
from udccal.profiles.store import read_profile
from udccal.sessions.store import Session
from udccal.validation.validate import validate


@functools.cache
def _session() -> Session:
    """Noise and wire of the whole profile's rig, with few frames."""
    few = {"flats": 10, "noise_levels": 4, "noise_stack": 2}
    rig = _rig().model_copy(update={"captures": _rig().captures.model_copy(update=few)})
    with simulate(rig) as bench:
        return capture(Path(_kept_folder().name) / "session", bench, ["noise", "wire"])


def _validate(data: bytes) -> None:
    session, folder = _session(), _whole().folder
    (folder / PROFILE_NAME).write_bytes(_changed(data))
    found = validate(read_profile(folder), session)
    numbers = [number for check in found.checks for number in (check.value, check.limit) if number is not None]
    assert all(math.isfinite(number) for number in numbers), "expected finite numbers"


# A change of a size is compiled anew, which takes seconds.
VALIDATE_TARGETS = (Target("validate", _validate, _seeds, 64, one_in=20, longest_s=40.0),)
