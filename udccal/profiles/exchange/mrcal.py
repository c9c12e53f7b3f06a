"""mrcal's ``.cameramodel``: a Python literal. The lens model is LENSMODEL_OPENCV5, whose five coefficients are ours.

The format is that of https://mrcal.secretsauce.net/cameramodels.html; lengths are in m, and the reference is the
panel's frame.
"""

from __future__ import annotations

import ast
import re
import warnings
from collections.abc import Mapping, Sequence

from scipy.spatial.transform import Rotation

from udccal.errors import ProfileError
from udccal.profiles.exchange.format import ExportFormat, ImportFormat
from udccal.profiles.exchange.lens import Lens, lens_of, lens_with
from udccal.profiles.profile import Profile

NAME = "mrcal"
# Numbers of coefficients that follow fx, fy, cx, cy.
_MODELS: Mapping[str, int] = {
    "LENSMODEL_PINHOLE": 0,
    "LENSMODEL_OPENCV4": 4,
    "LENSMODEL_OPENCV5": 5,
    "LENSMODEL_OPENCV8": 8,
    "LENSMODEL_OPENCV12": 12,
}
# What is left of a file without its words and comments: names of keys, numbers, brackets.
_MOST_LEFT, _DEEPEST = 65536, 4
_LARGEST = 1e30
_WORDS = re.compile(r"#[^\n]*|'[^'\\\n]*'|\"[^\"\\\n]*\"")
_LITERAL = re.compile(r"[\s{}\[\](),:0-9.eE+\-bNone]*")
_SIGNS = re.compile(r"[-+]\s*[-+]")


def _encode(profile: Profile) -> bytes:
    lens = lens_of(profile)
    intrinsics = (*lens.focal_px, *lens.principal_point_px, *lens.distortion)
    lines = [
        f"'lensmodel': 'LENSMODEL_OPENCV5',\n'intrinsics': {_numbers(intrinsics)},",
        f"'imagersize': [{lens.columns}, {lens.rows}],",
    ]
    if lens.pose is not None:
        inverse = lens.pose.R_panel_camera.T
        turn = Rotation.from_matrix(inverse).as_rotvec()
        place_m = -inverse @ lens.pose.pupil_mm / 1000.0
        lines.append(
            f"# from the panel's frame to the camera's, in rad and m\n'extrinsics': {_numbers((*turn, *place_m))},"
        )
    return ("{\n" + "\n".join(lines) + "\n}\n").encode("ascii")


def _numbers(values: Sequence[float]) -> str:
    return f"[{', '.join(repr(float(value)) for value in values)}]"


def _decode(text: str, where: str) -> Lens:
    model = _literal(text, where)
    kind = model.get("lensmodel")
    if not isinstance(kind, str) or kind not in _MODELS:
        raise ProfileError(
            f"Expected one of the lens models {', '.join(_MODELS)} in {where}, found '{str(kind)[:60]}'. Convert it "
            "with mrcal-convert-lensmodel to LENSMODEL_OPENCV5."
        )
    intrinsics = _reals(model, "intrinsics", 4 + _MODELS[kind], where)
    columns, rows = _reals(model, "imagersize", 2, where)
    if columns != int(columns) or rows != int(rows):
        raise ProfileError(f"Expected whole numbers as 'imagersize' in {where}, found others. Correct the file.")
    return lens_with(where, (int(columns), int(rows)), intrinsics[:4], intrinsics[4:])


def _literal(text: str, where: str) -> Mapping[str, object]:
    """The file's mapping; what could make Python's parser work long or deep is refused before it runs."""
    left = _WORDS.sub("", text)
    if len(left) > _MOST_LEFT or not _LITERAL.fullmatch(left) or _SIGNS.search(left) or _depth(left) > _DEEPEST:
        raise _no_literal(where, "another text")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = ast.literal_eval(text.strip())
    except (SyntaxError, ValueError, TypeError, MemoryError, RecursionError) as error:
        raise _no_literal(where, str(error)[:60]) from error
    if not isinstance(found, dict):
        raise _no_literal(where, "another value")
    return found


def _depth(text: str) -> int:
    depth = most = 0
    for letter in text:
        depth += (letter in "{[(") - (letter in "}])")
        most = max(most, depth)
    return most


def _no_literal(where: str, found: str) -> ProfileError:
    return ProfileError(
        f"Expected a camera model of mrcal in {where}, names with numbers in braces, found {found}. Check the format."
    )


def _reals(model: Mapping[str, object], name: str, count: int, where: str) -> list[float]:
    values = model.get(name)
    if isinstance(values, list | tuple) and len(values) == count:
        numbers = [float(value) for value in values if type(value) in (int, float) and abs(value) < _LARGEST]
        if len(numbers) == count:
            return numbers
    raise ProfileError(
        f"Expected {count} finite numbers as '{name}' in {where}, found {str(values)[:60]}. Correct the file."
    )


EXPORT = ExportFormat(
    name=NAME,
    terms=("geometry",),
    not_held=(
        "mrcal's model holds the lens and the camera's pose in the panel's frame. It cannot hold noise, wire, psf and "
        "backscatter.",
        "`udccal profile import` does not read the pose back: other programs' models have other reference frames.",
        "It has no optimization inputs, so that mrcal refuses to tell its uncertainty: that is in the .json beside it.",
    ),
    encode=_encode,
    posed=True,
)
IMPORT = ImportFormat(NAME, _decode)
