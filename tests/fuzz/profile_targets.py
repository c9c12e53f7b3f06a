"""Profiles whose numbers were changed: read, shown, made ready and used on a frame.

An input says which values of a profile.json to change, and into what: eight bytes for each change. What reads must
restore a small frame to a finite picture, or be refused in words, in the time and memory that any input has.
"""

from __future__ import annotations

import contextlib
import copy
import functools
import io
import json
import struct
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar
from unittest import mock

import jax
import numpy as np

from tests.fuzz.target import Target
from udccal.cli.jobs.show import show_profile
from udccal.cli.output import Output
from udccal.fitting.nominal import absent_backscatter, absent_psf, absent_wire, nominal_geometry
from udccal.fitting.wire.fit import sensor_map
from udccal.kernels import fitted_size
from udccal.models.noise import Noise
from udccal.models.psf import PsfField, psf_kernels
from udccal.numerics import in_float64
from udccal.profiles.profile import Profile, build_profile
from udccal.profiles.provenance import PROFILE_NAME, provenance_now
from udccal.profiles.store import read_profile, write_profile
from udccal.restoration import runtime, view
from udccal.restoration.kernel_grid import KernelGrid
from udccal.restoration.plan import PlanOptions, kernel_grid
from udccal.restoration.view import inscribed_view
from udccal.result import Captures, Estimate, EstimatePrior, FitResult, FitStatus, Outliers, ResidualSample
from udccal.rig import RigDescription, load_rig

T = TypeVar("T")

_CHANGE = struct.Struct("<HHHH")
# One field position and little beyond the frame: what is tried here is numbers, not accuracy.
_OPTIONS = PlanOptions(grid_rows=1, grid_columns=1, tile_rows=96, tile_columns=96, workers=1)
_EXPOSURE_S = 0.02
_BURIED, _DEPTH = "buried", 20_000
_INTERESTING: tuple[Any, ...] = (
    *(0, 1, -1, 2, 3, 0.0, -0.0, 0.5, -0.5, 1e-9, 1e-300, 5e-324, 1e9, -1e9, 1e30, 1e300, -1e300),
    *(sign * 2**k for k in (3, 4, 5, 6, 8, 12, 16, 24, 31, 32, 40, 53, 63, 64, 200) for sign in (1, -1)),
    *(float("nan"), float("inf"), float("-inf"), 10**400, True, False, None),
    *("", "0", "XYZW", "BGGR", "geometry", "ABSENT", "CONVERGED", "Geometry", "\ud800", "\u0394", "a" * 5000),
    *([], {}, [0], [[0]], [1e300] * 3, [0.0] * 700, [1] * 7, {"kind": "choice", "name": "x", "value": 1}),
)


@dataclass(frozen=True)
class _Whole:
    """A whole profile's files, and where the values of its profile.json stand."""

    folder: Path
    text: str
    places: tuple[tuple[str | int, ...], ...]


def _rig() -> RigDescription:
    """The size of the rig of the profiles' tests, so that both use the same compilations."""
    rig = load_rig("lg55-reduced")
    camera = rig.camera.model_copy(update={"columns": 96, "rows": 64, "pitch_um": 69.0})
    panel = rig.panel.model_copy(update={"columns": 32, "rows": 24})
    view = rig.view.model_copy(update={"columns": 64, "rows": 36})
    return rig.model_copy(update={"camera": camera, "panel": panel, "view": view})


def _profile() -> Profile:
    rig = _rig()
    geometry = nominal_geometry(rig)
    noise = Noise(0.355, 64.1, 3969.0, 4.7, 0.08, 0.2, 1.0, 12.0, 2.0, 0.005)
    point, dark = absent_psf(rig, geometry), absent_backscatter(rig, geometry)
    residual = np.pad(np.asarray(point.residual), ((0, 0), (0, 0), (3, 3), (3, 3)))
    mask = np.full(np.shape(dark.mask), 2.0e4)

    def fitted(name: str, term: object, estimates: tuple[Estimate, ...] = ()) -> FitResult:
        return FitResult(
            name, term, FitStatus.CONVERGED, estimates, np.eye(len(estimates)), 1.0, 100,
            outliers=(Outliers("off", 1, ("a",)),),
            residuals=ResidualSample(np.ones((2, 2)), np.ones(2)),
            captures=Captures("ab" * 32, 2, 20, (0.0, 6.0), ("2026-01-01", "2026-01-02"), (20.0, 30.0)),
            effort="quick",
        )  # fmt: skip

    wire = absent_wire(rig, geometry)
    return build_profile(
        rig,
        provenance_now(None, None),
        noise=fitted("noise", noise, (Estimate("K_DN_per_e", 0.355, 1e-3, "DN/e-", EstimatePrior(0.36, 0.02)),)),
        geometry=fitted("geometry", geometry),
        wire=replace(fitted("wire", wire), map_sigma=np.full((1, 2, 3), 1e-4, np.float32)),
        psf=fitted("psf", type(point)(**{**vars(point), "residual": residual})),
        backscatter=fitted("backscatter", type(dark)(**{**vars(dark), "mask": mask, "window": 5})),
        wire_map=sensor_map(wire, rig.camera.rows, rig.camera.columns),
    )


@functools.cache
def _whole() -> _Whole:
    folder = Path(_kept_folder().name) / "whole"
    write_profile(folder, _profile())
    document = json.loads((folder / PROFILE_NAME).read_text())
    return _Whole(folder, json.dumps(document), tuple(_places(document, ())))


@functools.cache
def _kept_folder() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="udccal-fuzz-")


def _places(node: Any, path: tuple[str | int, ...]) -> Iterator[tuple[str | int, ...]]:
    """Of every entry of a document, objects and lists too; twice of what restoring uses."""
    if path:
        yield path
        if path[0] in ("terms", "rig") and "fit" not in path and path[-1] not in ("name", "unit", "kind"):
            yield path
    inner = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    for key, value in inner:
        yield from _places(value, (*path, key))


def _changed(data: bytes) -> bytes:
    """A profile.json with as many changes as the bytes say, up to eight."""
    whole = _whole()
    document = json.loads(whole.text)
    for where, how, what, other in _CHANGE.iter_unpack(data[: len(data) // _CHANGE.size * _CHANGE.size][:64]):
        *path, last = whole.places[where % len(whole.places)]
        with contextlib.suppress(LookupError, TypeError):  # what an earlier change took away
            holder = _at(document, path)
            holder[last] = _new(
                holder[last], how, what, lambda at=other: _at(document, whole.places[at % len(whole.places)])
            )
    # As text: what writes JSON does not go so deep.
    return json.dumps(document).replace(f'"{_BURIED}"', "[" * _DEPTH + "]" * _DEPTH).encode()


def _at(node: Any, path: Any) -> Any:
    for key in path:
        node = node[key]
    return node


def _new(old: Any, how: int, what: int, other: Any) -> Any:
    """Another value in place of one: near it, far from it, of another type, another's, or buried."""
    number = isinstance(old, int | float) and not isinstance(old, bool)
    match how % 8:
        case 0 if number:
            return -old
        case 7:
            return old
        case 1 if number:
            return old + (what % 7 - 3)
        case 2 if number:
            return old * 2.0 ** (what % 41 - 20)
        case 3:
            return copy.deepcopy(other())
        case 4 if isinstance(old, list) and old:
            return [*old[: what % len(old)], *old[what % len(old) + 1 :]] if what % 2 else old * (what % 5)
        case 5 if what % 16 == 0:
            return _BURIED
        case _:
            return copy.deepcopy(_INTERESTING[what % len(_INTERESTING)])


_first: dict[str, tuple[Any, Any]] = {}


def _remembered(function: Callable[..., T]) -> Callable[..., T]:
    """The function, which does not work out again what it was first asked for: mostly the whole profile's."""

    def remembering(*arguments: Any) -> T:
        leaves = jax.tree.leaves(arguments)
        key = tuple(leaf.tobytes() if isinstance(leaf, np.ndarray) else repr(leaf) for leaf in leaves)
        own = _first.setdefault(function.__name__, (key, None))
        if own[0] != key or own[1] is None:
            result = function(*arguments)
            if own[0] == key:
                _first[function.__name__] = (key, result)
            return result
        return own[1]

    return remembering


@in_float64
def _kernels(psf: PsfField, rig: RigDescription, options: PlanOptions) -> KernelGrid:
    """``kernel_grid`` of kernels and terms as large as the whole profile's: others would be compiled for a minute.

    Of others the evaluation is only gone through in shapes, and the kernel is a point.
    """
    rows, columns = fitted_size(psf, rig, options.kernel_rows, options.kernel_columns)
    sizes = (rows, columns, psf.degree, psf.fine, *(np.shape(leaf) for leaf in jax.tree.leaves(psf)))
    if sizes == _first.setdefault("sizes", (sizes, None))[0]:
        return kernel_grid(psf, rig, options)
    shape = jax.eval_shape(lambda field: psf_kernels(field, np.zeros((1, 2)), rows, columns), psf).shape
    point = np.zeros((1, *shape), np.float32)
    point[..., rows // 2, columns // 2] = 1.0
    return KernelGrid(np.zeros(1), np.zeros(1), point)


def _restore(data: bytes) -> None:
    folder = _whole().folder
    (folder / PROFILE_NAME).write_bytes(data)
    profile = read_profile(folder)
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        show_profile(Output(as_json=False, debug=False), folder)
    with (
        mock.patch.object(runtime, "kernel_grid", _remembered(_kernels)),
        mock.patch.object(view, "inscribed_view", _remembered(inscribed_view)),
    ):
        restorer = runtime.Restorer.from_profile(profile, options=_OPTIONS)
    camera, panel = profile.rig.camera, profile.rig.panel
    frame = np.random.default_rng(2).integers(60, 250, (camera.rows, camera.columns)).astype(np.uint16)
    frame[5:8, 5:8] = 2**camera.bits - 1
    for shown in (None, np.full((panel.rows, panel.columns, 3), 130, np.uint8)):
        picture = restorer.restore(frame, _EXPOSURE_S, shown)
        assert np.all(np.isfinite(picture)), "expected a finite picture"


def _change_and_restore(data: bytes) -> None:
    _restore(_changed(data))


def _seeds() -> tuple[bytes, ...]:
    """Changes that change nothing."""
    return tuple(b"".join(_CHANGE.pack(97 * at, 7, at, at) for at in range(count)) for count in (1, 2, 3))


# A change of a size is compiled anew, which takes seconds.
PROFILE_TARGETS = (Target("profile", _change_and_restore, _seeds, 64, one_in=20, longest_s=40.0),)
