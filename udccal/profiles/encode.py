"""Conversion between a profile in memory and its stored form in a folder."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32

from udccal.errors import ProfileError
from udccal.fitting.psf.held_out import stated_by
from udccal.io.exr import write_exr
from udccal.io.hashing import sha256_file
from udccal.models.backscatter import Backscatter
from udccal.models.geometry import Geometry
from udccal.models.noise import Noise
from udccal.models.psf import PsfField
from udccal.models.wire import Wire
from udccal.profiles.agreement import check_agreement
from udccal.profiles.arrays import read_checked
from udccal.profiles.evidence import load_fit, store_fit
from udccal.profiles.packing import Packed, pack, unpack
from udccal.profiles.pictures import ATLAS_COLUMNS, ATLAS_ROWS, psf_atlas, tiled
from udccal.profiles.profile import Profile
from udccal.profiles.ranges import check_term
from udccal.profiles.schema import FORMAT, VERSION, Lineage, Section, StoredPicture, StoredProfile, Terms
from udccal.result import FitResult
from udccal.sessions.schema import TermName

Channels = Mapping[str, Float[np.ndarray, "rows columns"]]
# Ranges of the maps: the wire as a factor, backscatter in e-/s, kernels that sum to 1.
_WIRE_RANGE, _RATE_RANGE, _KERNEL_RANGE = (1e-4, 1e4), (-1e10, 1e10), (-10.0, 10.0)
_SIGMA_RANGE = (0.0, 1e20)
_SIGMA_CHANNELS = {"wire": ("sigma",), "backscatter": tuple("RGB")}


def encode(profile: Profile, folder: Path) -> StoredProfile:
    """Write a profile's arrays to ``folder`` and return the content of ``profile.json``.

    Raises:
        ProfileError: when a number is not finite, out of range or not its fit's: such a profile could not be read.
    """
    shared = profile.geometry.term
    for result in profile.results:
        check_term(result.term, result.name, profile.rig)
        check_agreement(result)
    return StoredProfile(
        format=FORMAT,
        version=VERSION,
        rig=profile.rig,
        lineage=Lineage(parent=profile.parent),
        provenance=profile.provenance,
        invalidated_by=profile.invalidated_by,
        terms=Terms(
            noise=_store_section(profile.noise, "noise", folder, shared),
            geometry=_store_section(profile.geometry, "geometry", folder, None),
            wire=_store_section(profile.wire, "wire", folder, shared),
            psf=_store_section(profile.psf, "psf", folder, shared),
            backscatter=_store_section(profile.backscatter, "backscatter", folder, shared),
        ),
        pictures=_store_pictures(profile, folder),
    )


def decode(stored: StoredProfile, folder: Path) -> Profile:
    """Build the profile from its stored form and the arrays in ``folder``.

    Raises:
        ProfileError: when a file is missing or altered, or a value is invalid.
    """
    camera = stored.rig.camera
    geometry = _load_section(stored, "geometry", Geometry, folder, None)
    shared = geometry.term
    pictures: dict[str, StoredPicture] = {picture.name: picture for picture in stored.pictures}
    for name in ("wire_map", "psf_atlas", "backscatter_white"):
        if name not in pictures:
            raise ProfileError(f"Expected the picture '{name}' in {folder}, found none. Make the profile again.")
    size, half_size = (camera.rows, camera.columns), (camera.rows // 2, camera.columns // 2)
    wire_map = _load_picture(pictures["wire_map"], folder, ("wire",), size, _WIRE_RANGE)
    mask = _load_picture(pictures["backscatter_white"], folder, tuple("RGB"), half_size, _RATE_RANGE)
    for name, allowed in (("psf_atlas", _KERNEL_RANGE), ("psf_sigma", _SIGMA_RANGE)):
        if (of_kernels := pictures.get(name)) is not None:
            _load_picture(of_kernels, folder, tuple("RGB"), (of_kernels.rows, of_kernels.columns), allowed)
    return Profile(
        rig=stored.rig,
        provenance=stored.provenance,
        parent=stored.lineage.parent,
        noise=_load_section(stored, "noise", Noise, folder, shared),
        geometry=geometry,
        wire=_with_sigma(_load_section(stored, "wire", Wire, folder, shared), pictures, folder),
        psf=_load_section(stored, "psf", PsfField, folder, shared),
        backscatter=_with_sigma(_load_section(stored, "backscatter", Backscatter, folder, shared), pictures, folder),
        wire_map=np.array(wire_map["wire"], dtype=np.float32),
        backscatter_mask=np.stack([mask[name] for name in "RGB"], axis=-1).astype(np.float32),
        invalidated_by=stored.invalidated_by,
    )


def _store_section(result: FitResult, name: str, folder: Path, geometry: Geometry | None) -> Section:
    packed = pack(result.term, name, result.estimates, folder, geometry)
    return Section(
        model=type(result.term).__name__,
        version=1,
        parameters=packed.parameters,
        arrays=packed.arrays,
        fit=store_fit(result, name, folder),
    )


def _load_section(
    stored: StoredProfile, name: TermName, kind: type, folder: Path, geometry: Geometry | None
) -> FitResult[Any]:
    section: Section = getattr(stored.terms, name)
    if section.model != kind.__name__:
        raise ProfileError(f"Expected the model {kind.__name__}, found '{section.model}'. Update udccal to read it.")
    term = unpack(Packed(section.parameters, section.arrays), kind, folder, geometry)
    check_term(term, name, stored.rig)
    result = load_fit(name, section.fit, term, folder)
    check_agreement(result)
    return result


def _with_sigma(result: FitResult, pictures: Mapping[str, StoredPicture], folder: Path) -> FitResult:
    """The result with the map of its sigma, where the profile has one."""
    picture = pictures.get(f"{result.name}_sigma")
    if picture is None:
        return result
    names, size = _SIGMA_CHANNELS[result.name], (picture.rows, picture.columns)
    channels = _load_picture(picture, folder, names, size, _SIGMA_RANGE)
    return replace(result, map_sigma=np.stack([channels[name] for name in names]).astype(np.float32))


def _store_sigmas(profile: Profile, folder: Path) -> Iterator[StoredPicture]:
    for result, unit, of in ((profile.wire, "1", "the wire map, relative"), (profile.backscatter, "e-/s", "the white")):
        if result.map_sigma is not None:
            channels = dict(zip(_SIGMA_CHANNELS[result.name], result.map_sigma, strict=True))
            what = f"One standard deviation of {of}, RMS over each cell of an even grid over the sensor."
            yield _store_picture(folder, f"{result.name}_sigma", channels, unit, what)


def _store_kernel_sigma(
    result: FitResult[PsfField], atlas: Float32[np.ndarray, "places 3 ky kx"], folder: Path
) -> Iterator[StoredPicture]:
    """The sigma of each sample of the atlas, where the fit states it."""
    if (stated := stated_by(result)) is not None:
        sigma = stated.of_kernels(atlas.astype(np.float64)).astype(np.float32)
        what = "One standard deviation of every sample of psf_atlas, in its unit, tiled as there."
        yield _store_picture(folder, "psf_sigma", tiled(sigma), "1", what)


def _store_pictures(profile: Profile, folder: Path) -> tuple[StoredPicture, ...]:
    mask = {name: profile.backscatter_mask[..., index] for index, name in enumerate("RGB")}
    atlas = psf_atlas(profile.psf.term, profile.rig)
    return (
        _store_picture(folder, "wire_map", {"wire": profile.wire_map}, "1", "The wire at every pixel, mean 1."),
        _store_picture(
            folder,
            "psf_atlas",
            tiled(atlas),
            "1",
            f"Kernels at {ATLAS_COLUMNS} x {ATLAS_ROWS} field positions, from 5 % to 95 % of the sensor's width and "
            "height, tiled as they lie on the sensor. Raise the exposure to view it.",
        ),
        _store_picture(
            folder,
            "backscatter_white",
            mask,
            "e-/s",
            "Backscatter of an all-white panel, one sample per 2 x 2 cell of the sensor, before the wire.",
        ),
        *_store_kernel_sigma(profile.psf, atlas, folder),
        *_store_sigmas(profile, folder),
    )


def _store_picture(folder: Path, name: str, channels: Channels, unit: str, what: str) -> StoredPicture:
    file = f"{name}.exr"
    write_exr(folder / file, channels)
    rows, columns = next(iter(channels.values())).shape
    return StoredPicture.model_validate(
        {
            "name": name,
            "file": file,
            "sha256": sha256_file(folder / file),
            "columns": columns,
            "rows": rows,
            "unit": unit,
            "what": what,
        }
    )


def _load_picture(
    picture: StoredPicture, folder: Path, names: tuple[str, ...], size: tuple[int, int], allowed: tuple[float, float]
) -> Channels:
    channels = read_checked(folder, picture.file, picture.sha256, size)
    found = next(iter(channels.values())).shape
    if set(channels) != set(names) or found != size or (picture.rows, picture.columns) != found:
        raise ProfileError(
            f"Expected {picture.file} to have the channels {', '.join(names)} of {size[1]} x {size[0]} samples, found "
            f"{', '.join(channels)} of {found[1]} x {found[0]}. Restore the profile from a copy."
        )
    low, high = allowed
    for name, values in channels.items():
        wrong = values[~((values >= low) & (values <= high))]
        if wrong.size:
            raise ProfileError(
                f"Expected values from {low:g} to {high:g} in the channel {name} of {picture.file}, found "
                f"{wrong[0]:g}. Make the profile again."
            )
    return channels
