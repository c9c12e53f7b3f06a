"""Format versions of ``profile.json``: older ones are migrated step by step, newer ones refused.

To change the format, raise ``schema.VERSION`` and register here the function that converts the JSON object from the
previous version to the new one. Each function is kept for good, with a stored profile of its version among the tests.
"""

from __future__ import annotations

import reprlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from udccal.errors import ProfileError
from udccal.profiles.schema import FORMAT, VERSION
from udccal.quantities import quantity

# JSON before a schema applies to it: the only place where a profile is an untyped object.
JsonObject = dict[str, Any]
Migration = Callable[[JsonObject], JsonObject]

# New names of parameters from version 1 to 2, by section and by the last part of their dotted names.
_GEOMETRY = {"focal": "focal_px", "centre": "principal_point_px", "rotation": "rotation_rad", "pupil": "pupil_mm"}
_PARAMETERS_OF_2: Mapping[str, Mapping[str, str]] = {
    "geometry": _GEOMETRY,
    "wire": {**_GEOMETRY, "offset": "offset_periods", "pupil_per_pitch": "footprint_per_pitch"},
    "psf": {
        **_GEOMETRY,
        "open_fraction": "openings",
        "thickness_mm": "depth_mm",
        "pupil_mm": "pupil_diameter_mm",
        "offset": "offset_periods",
        "diffraction_share": "diffraction_fraction",
    },
    "backscatter": {**_GEOMETRY, "pupil_mm": "pupil_diameter_mm", "distance_mm": "standoff_mm"},
}
_ESTIMATES_OF_2: Mapping[str, Mapping[str, str]] = {
    "wire": {
        "offset_x": "offset_x_periods",
        "offset_y": "offset_y_periods",
        "pupil_per_pitch": "footprint_per_pitch",
    },
    "psf": {
        "pitch": "pitch_mm",
        "column_open_fraction": "column_open",
        "row_open_fraction": "row_open",
        "structure_thickness": "depth_mm",
        "pupil_diameter": "pupil_diameter_mm",
        "blur": "blur_px",
    },
    "backscatter": {"pupil_mm": "pupil_diameter_mm", "distance_mm": "standoff_mm"},
}


def _first_to_second(found: JsonObject) -> JsonObject:
    """Rename parameters; numbers do not change. The rig migrates its own versions (``udccal/rig_versions.py``)."""
    terms = found.get("terms")
    if isinstance(terms, dict):
        terms = {name: _renamed_section(name, section) for name, section in terms.items()}
    return {**found, "version": 2, "terms": terms}


def _renamed_section(name: str, section: Any) -> Any:
    if not isinstance(section, dict):
        return section
    parameters = _PARAMETERS_OF_2.get(name, {})
    found = {
        **section,
        **{key: _renamed(section[key], parameters) for key in ("parameters", "arrays") if key in section},
    }
    fit = found.get("fit")
    if isinstance(fit, dict) and "estimates" in fit:
        found["fit"] = {**fit, "estimates": _renamed(fit["estimates"], _ESTIMATES_OF_2.get(name, {}))}
    return found


def _renamed(entries: Any, names: Mapping[str, str]) -> Any:
    """Return entries with their names replaced; the schema refuses anything but a list of named objects later."""
    return [_renamed_entry(entry, names) for entry in entries] if isinstance(entries, list) else entries


def _renamed_entry(entry: Any, names: Mapping[str, str]) -> Any:
    if not isinstance(entry, dict) or not isinstance(entry.get("name"), str):
        return entry
    group, dot, own = entry["name"].rpartition(".")
    name = names.get(own, own)
    unit = {"unit": "period"} if name == "offset_periods" and "unit" in entry else {}
    return {**entry, "name": f"{group}{dot}{name}", **unit}


def _second_to_third(found: JsonObject) -> JsonObject:
    """Say what each estimate is; what was not kept before is null: priors, outliers, residuals, captures, effort."""
    terms = found.get("terms")
    if isinstance(terms, dict):
        terms = {name: _third_section(name, section) for name, section in terms.items()}
    return {**found, "version": 3, "terms": terms}


def _third_section(term: str, section: Any) -> Any:
    if not isinstance(section, dict) or not isinstance(section.get("fit"), dict):
        return section
    fit = {**section["fit"], **dict.fromkeys(("outliers", "residuals", "captures", "effort"))}
    if isinstance(fit.get("estimates"), list):
        fit["estimates"] = [
            {**one, "what": quantity(term, str(one.get("name"))).what, "prior": None} if isinstance(one, dict) else one
            for one in fit["estimates"]
        ]
    return {**section, "fit": fit}


def _third_to_fourth(found: JsonObject) -> JsonObject:
    """Say that the psf's further blur is the same all over the field and in all colours, as it was before."""
    new = (("blur_growth", (2,)), ("blur_colour", (3,)))
    return {**_with_zeros(found, "diffraction.blur_px", new), "version": 4}


def _with_zeros(found: JsonObject, after: str, new: Sequence[tuple[str, tuple[int, ...]]]) -> JsonObject:
    """The psf with new parameters of diffraction (names, shapes) after another one; all are without unit, and 0."""
    terms = found.get("terms")
    psf = terms.get("psf") if isinstance(terms, dict) else None
    if not isinstance(psf, dict) or not isinstance(psf.get("parameters"), list):
        return found
    zeros: list[JsonObject] = [
        {"kind": "numbers", "name": f"diffraction.{name}", "dtype": "float64", "shape": list(shape)}
        | {"value": [0.0] * shape[0], "unit": "1", "sigma": None}
        if shape
        else {"kind": "number", "name": f"diffraction.{name}", "value": 0.0, "unit": "1", "sigma": None}
        for name, shape in new
    ]
    names = [one.get("name") if isinstance(one, dict) else None for one in psf["parameters"]]
    at = names.index(after) + 1 if after in names else len(names)
    parameters = [*psf["parameters"][:at], *zeros, *psf["parameters"][at:]]
    return {**found, "terms": {**found["terms"], "psf": {**psf, "parameters": parameters}}}


def _fourth_to_fifth(found: JsonObject) -> JsonObject:
    """Say that frames are taken as linear, as they were before."""
    terms = found.get("terms")
    noise = terms.get("noise") if isinstance(terms, dict) else None
    if isinstance(noise, dict) and isinstance(noise.get("parameters"), list):
        linear = {"kind": "number", "name": "nonlinearity", "value": 0.0, "unit": "1", "sigma": None}
        terms = {**found["terms"], "noise": {**noise, "parameters": [*noise["parameters"], linear]}}
    return {**found, "version": 5, "terms": terms}


def _fifth_to_sixth(found: JsonObject) -> JsonObject:
    """Say that it is not known which steps each fit used: one digest of all of them was kept."""
    terms = found.get("terms")
    if isinstance(terms, dict):
        terms = {name: _sixth_section(section) for name, section in terms.items()}
    return {**found, "version": 6, "terms": terms}


def _sixth_section(section: Any) -> Any:
    fit = section.get("fit") if isinstance(section, dict) else None
    if not isinstance(fit, dict) or not isinstance(fit.get("captures"), dict):
        return section
    return {**section, "fit": {**fit, "captures": {**fit["captures"], "steps": None}}}


def _sixth_to_seventh(found: JsonObject) -> JsonObject:
    """Say that rows are as deep as columns, and openings rectangles that no bar crosses, as it was before."""
    new = (("depth_ratio", ()), ("bar_width", (2,)), ("bar_place", (2,)), ("corner_radius", ()))
    return {**_with_zeros(found, "diffraction.depth_mm", new), "version": 7}


def _seventh_to_eighth(found: JsonObject) -> JsonObject:
    """Say that openings are as wide at either end, as it was before."""
    return {**_with_zeros(found, "diffraction.corner_radius", (("slant", (2,)),)), "version": 8}


# By the version that a function starts from; it returns the next version.
MIGRATIONS: Mapping[int, Migration] = {
    1: _first_to_second,
    2: _second_to_third,
    3: _third_to_fourth,
    4: _fourth_to_fifth,
    5: _fifth_to_sixth,
    6: _sixth_to_seventh,
    7: _seventh_to_eighth,
}


def migrated(
    found: JsonObject, where: str, migrations: Mapping[int, Migration] = MIGRATIONS, target: int = VERSION
) -> JsonObject:
    """Migrate the JSON object of a profile to version ``target``.

    Raises:
        ProfileError: when it is not a profile, newer than ``target``, or of a version without a migration.
    """
    if found.get("format") != FORMAT:
        raise ProfileError(f"Expected {where} to have the format '{FORMAT}', found another. Check the path.")
    version = found.get("version")
    found_version = reprlib.repr(version)
    if not isinstance(version, int) or isinstance(version, bool) or version < 1:
        raise ProfileError(
            f"Expected a version number from 1 in {where}, found {found_version}. Restore it from a copy."
        )
    if version > target:
        raise ProfileError(
            f"Expected {where} to have at most version {target}, found the newer version {found_version}. "
            "Update udccal to read it."
        )
    while version < target:
        if version not in migrations:
            raise ProfileError(
                f"Expected {where} to have a version that can be migrated to {target}, found {version}, which this "
                "udccal no longer reads. Migrate it with an older udccal first."
            )
        found = migrations[version](found)
        version += 1
    return found
