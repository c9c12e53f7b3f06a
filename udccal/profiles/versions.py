"""Format versions of ``profile.json``: older ones are migrated step by step, newer ones refused.

To change the format: raise ``schema.VERSION``, and register here the function that takes the JSON object of the version
before to the new one. Each function is kept for good, with a stored profile of its version among the tests.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from udccal.errors import ProfileError
from udccal.profiles.schema import FORMAT, VERSION

# JSON as it is before any schema of ours applies to it; the one place where a profile is an untyped object.
JsonObject = dict[str, Any]
Migration = Callable[[JsonObject], JsonObject]

# Keyed by the version a function starts from; it returns the next version.
MIGRATIONS: Mapping[int, Migration] = {}


def migrated(
    found: JsonObject, where: str, migrations: Mapping[int, Migration] = MIGRATIONS, target: int = VERSION
) -> JsonObject:
    """The JSON object of a profile, taken to version ``target``.

    Raises:
        ProfileError: when it is not a profile, newer than ``target``, or of a version that nothing migrates from.
    """
    if found.get("format") != FORMAT:
        raise ProfileError(f"Expected {where} to have the format '{FORMAT}', found another. Check the path.")
    version = found.get("version")
    if not isinstance(version, int) or isinstance(version, bool) or version < 1:
        raise ProfileError(f"Expected a version number from 1 in {where}, found {version!r}. Restore it from a copy.")
    if version > target:
        raise ProfileError(
            f"Expected {where} to have at most version {target}, found the newer version {version}. "
            "Update udccal to read it."
        )
    while version < target:
        if version not in migrations:
            raise ProfileError(
                f"Expected {where} to have a version that can be brought to {target}, found {version}, which this "
                "udccal no longer reads. Bring it up to date with an older udccal first."
            )
        found = migrations[version](found)
        version += 1
    return found
