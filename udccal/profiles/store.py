"""Reading and writing profiles: whole or not at all, with every file and value checked."""

from __future__ import annotations

import json
import os
from pathlib import Path

from pydantic import ValidationError

from udccal.arguments import check_is_path, check_kind
from udccal.errors import ProfileError, RigError
from udccal.io.atomic import write_atomically
from udccal.io.exr import check_path
from udccal.io.links import is_plain_file
from udccal.io.out_folder import storing_in
from udccal.io.reading import reading
from udccal.io.whole_folder import folder_beside, read_standing, replace_whole, standing
from udccal.profiles.archive import pack_archive, unpacked
from udccal.profiles.encode import decode, encode
from udccal.profiles.profile import Profile
from udccal.profiles.provenance import MAX_JSON_BYTES, PROFILE_NAME
from udccal.profiles.schema import StoredArray, StoredProfile
from udccal.profiles.versions import migrated
from udccal.rig_folders import find_rig, rig_folders, rig_names

# Name of the profile in a rig's folder, next to rig.toml.
RIG_PROFILE = "profile"


def write_profile(path: Path, profile: Profile) -> None:
    """Write a profile as a folder or as one zip file, whole or not at all.

    Args:
        path: where to write; one zip file if it ends in ``.zip``. A profile that is there is replaced.
        profile: what to write.

    Raises:
        ProfileError: when ``path`` holds something that is not a profile; nothing is changed then.
    """
    check_replaceable(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with folder_beside(path) as folder:
        stored = encode(profile, folder)
        write_atomically(folder / PROFILE_NAME, stored.model_dump_json(indent=1).encode() + b"\n")
        put(folder, path)


def save_profile(profile: Profile, path: str | Path) -> Path:
    """Write a profile as a folder, or as one file if ``path`` ends in ``.zip``, whole or not at all.

    Args:
        profile: what to write.
        path: where to; a profile that is there is replaced, anything else is left alone.

    Returns:
        the path that was written.

    Raises:
        ProfileError: as ``write_profile``.
        UdccalError: when it cannot be written.
    """
    check_kind(profile, Profile, "Take a calibration's profile.", ProfileError)
    check_is_path(path, "a profile", ProfileError)
    target = Path(path)
    with storing_in(target.parent):
        write_profile(target, profile)
    return target


def put(folder: Path, path: Path) -> None:
    """Move a profile's files to ``path``, as a folder or as one zip file, in place of what is there.

    Args:
        folder: of ``folder_beside(path)``, with a profile's files and nothing else.
        path: where to; one zip file if it ends in ``.zip``.
    """
    if path.suffix == ".zip":
        pack_archive(folder, folder / path.name)
        replace_whole(folder / path.name, path)
    else:
        replace_whole(folder, path)


def read_profile(path: str | Path) -> Profile:
    """Read a profile.

    Args:
        path: a folder or a zip file; when it is replaced during reading, the new one is read.

    Raises:
        ProfileError: when it is missing, damaged, altered, too large, newer, or does not follow docs/profile.md.
    """
    return read_standing(Path(path), _read)


def _read(path: Path) -> Profile:
    with unpacked(path) as folder:
        return decode(read_stored(folder), folder)


def check_profile(value: object) -> None:
    """Refuse what is no profile, such as its path.

    Raises:
        ProfileError: which says how to read one.
    """
    check_kind(value, Profile, "Read a folder by udccal.load_profile(path).", ProfileError)


def load_profile(name_or_path: str | Path) -> Profile:
    """Read a profile.

    Args:
        name_or_path: as for ``find_profile``.

    Raises:
        ProfileError: as ``read_profile``.
    """
    check_is_path(name_or_path, "a profile", ProfileError)
    return read_profile(find_profile(name_or_path))


def find_profile(name_or_path: str | Path) -> Path:
    """Return the path of a profile.

    Args:
        name_or_path: a path, or the name of a rig whose folder holds a profile as ``profile``. A path that holds a
            profile is preferred, and so is any file.

    Returns:
        the path as given when nothing is found, so that reading it gives the error.
    """
    path = Path(name_or_path)
    place = standing(path)
    # A folder of that name that is no profile, as a rig's own, does not hide the rig's profile.
    if place.is_file() or os.path.lexists(place / PROFILE_NAME):
        return path
    try:
        of_rig = find_rig(name_or_path) / RIG_PROFILE
    except RigError:
        return path
    return of_rig if standing(of_rig).is_dir() else path


def _rigs_with_profiles() -> list[str]:
    each = ((folder / name, name) for folder in rig_folders() for name in rig_names(folder))
    return [name for rig, name in each if standing(rig / RIG_PROFILE).is_dir()]


def read_stored(folder: Path) -> StoredProfile:
    """Read ``profile.json`` of a folder, migrated to the present version and checked; the arrays are not read.

    Raises:
        ProfileError: as ``read_profile``.
    """
    file = folder / PROFILE_NAME
    with reading(file, ProfileError):
        size = file.stat().st_size if is_plain_file(folder, file) else None
    if size is None:
        raise ProfileError(
            f"Expected a profile with a {PROFILE_NAME} at {folder}, found none. Check the path, calibrate the rig, or "
            f"name a rig that has one: {', '.join(_rigs_with_profiles())}."
        )
    if size > MAX_JSON_BYTES:
        raise ProfileError(
            f"Expected {file} to hold at most {MAX_JSON_BYTES} bytes, found {size}. It does not belong to a profile."
        )
    try:
        with reading(file, ProfileError):
            content = file.read_bytes()
        found = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise ProfileError(f"Expected {file} to be JSON, found: {error}. Restore it from a copy.") from error
    if not isinstance(found, dict):
        raise ProfileError(f"Expected {file} to hold a JSON object, found another value. Restore it from a copy.")
    current = migrated(found, str(file))
    try:
        return StoredProfile.model_validate_json(json.dumps(current), strict=True)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"]) or "profile"
        raise ProfileError(
            f"Expected a valid '{where}' in {file}, found: {first['msg']}. Restore it from a copy."
        ) from error


def check_replaceable(path: Path) -> None:
    """Refuse a ``path`` that ``write_profile`` would refuse; call it before the work that leads to a profile.

    Raises:
        ProfileError: when ``path`` holds something other than a profile, has no name by which it can be replaced, or
            lies inside a profile.
        FileFormatError: when it has bytes that are not UTF-8.
    """
    if path.name in ("", ".."):
        raise ProfileError(
            f"Expected the name of a folder to write, found '{path}', which cannot be replaced as a whole. Give the "
            "profile a name."
        )
    check_path(path.absolute())
    check_outside_profiles(path)
    if not path.exists() or (path.is_dir() and not any(path.iterdir())):
        return
    try:
        with unpacked(path, PROFILE_NAME) as folder:
            stored = read_stored(folder)
    except ProfileError as error:
        raise ProfileError(
            f"Expected {path} to be free or to hold a profile that may be replaced, found something else ({error}) "
            "Choose another path."
        ) from error
    if path.is_file():
        return
    ours = {PROFILE_NAME, *stored_files(stored)}
    others = sorted(item.name for item in path.iterdir() if item.name not in ours)
    if others:
        raise ProfileError(
            f"Expected {path} to hold only a profile's files, found '{others[0]}' too. Move it, or choose another path."
        )


def check_outside_profiles(path: Path) -> None:
    """Refuse a ``path`` inside a profile's folder, which then could not be replaced any more.

    Raises:
        ProfileError: which names that profile.
    """
    for folder in Path(os.path.abspath(path)).parents:
        if os.path.lexists(folder / PROFILE_NAME):
            raise ProfileError(
                f"Expected a place outside of any profile, found {path} inside the profile {folder}, which holds its "
                "own files only. Choose another path."
            )


def stored_files(stored: StoredProfile) -> set[str]:
    """Return the names of the EXR files that a profile lists."""
    sections = (getattr(stored.terms, name) for name in type(stored.terms).model_fields)
    files = {picture.file for picture in stored.pictures}
    for section in sections:
        files |= {array.file for array in section.arrays}
        evidence = (section.fit.covariance, section.fit.residuals)
        files |= {array.file for array in evidence if isinstance(array, StoredArray)}
    return files
