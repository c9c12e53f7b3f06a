"""All targets by name."""

from __future__ import annotations

from tests.fuzz.device_targets import DEVICE_TARGETS
from tests.fuzz.diff_targets import DIFF_TARGETS
from tests.fuzz.exchange_targets import EXCHANGE_TARGETS
from tests.fuzz.file_targets import FILE_TARGETS
from tests.fuzz.plan_targets import PLAN_TARGETS
from tests.fuzz.profile_targets import PROFILE_TARGETS
from tests.fuzz.validate_targets import VALIDATE_TARGETS

_ALL = (
    *DEVICE_TARGETS,
    *FILE_TARGETS,
    *EXCHANGE_TARGETS,
    *PLAN_TARGETS,
    *PROFILE_TARGETS,
    *DIFF_TARGETS,
    *VALIDATE_TARGETS,
)
TARGETS = {target.name: target for target in _ALL}
assert len(TARGETS) == len(_ALL), "two targets have one name, so that one of them would not be tried"
