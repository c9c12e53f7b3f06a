"""Checks of what a caller gives: objects, paths, numbers and arrays. Each refusal is one sentence, and what to do."""

from __future__ import annotations

import os
from typing import Final, Literal

import numpy as np

from udccal.errors import UdccalError

Numbers = Literal["real numbers", "whole numbers", "truth values", "8-bit values"]
_KINDS: Final[dict[Numbers, str]] = {
    "real numbers": "fiu",
    "whole numbers": "iu",
    "truth values": "b",
    "8-bit values": "u",
}
# No sensor has pixels further out.
_FARTHEST_PX: Final = 2**20
_WHOLE = int | np.integer
_NUMBER = _WHOLE | float | np.floating


def found_instead(value: object) -> str:
    """What an argument is that should have been an array, for a message: type and shape."""
    kind, shape = getattr(value, "dtype", None), getattr(value, "shape", None)
    return type(value).__name__ if kind is None else f"{kind} of shape {shape}"


def number_of(value: object) -> object:
    """The number that a 0-d array holds, as terms have them; anything else as it is."""
    return np.asarray(value)[()] if getattr(value, "ndim", None) == 0 else value


def check_kind(value: object, kind: type, advice: str, error: type[UdccalError]) -> None:
    """Refuse what is no object of a class.

    Args:
        value: what was given.
        kind: the class.
        advice: how to get such an object, a sentence.
        error: kind of the error.

    Raises:
        UdccalError: of that kind, with the class of what was given.
    """
    if not isinstance(value, kind):
        raise error(f"Expected a {kind.__name__}, found {_shown(value)}. {advice}")


def check_optional(value: object, kind: type, error: type[UdccalError]) -> None:
    """Refuse what is neither None, which stands for the default, nor an object of a class.

    Raises:
        UdccalError: of the kind ``error``, with the class of what was given.
    """
    if value is not None:
        check_kind(value, kind, "Leave it out for the default.", error)


def check_is_path(value: object, what: str, error: type[UdccalError]) -> None:
    """Refuse what is no path.

    Raises:
        UdccalError: of the kind ``error``; ``what`` names what the path is of.
    """
    if not isinstance(value, str | os.PathLike):
        raise error(f"Expected the path of {what}, found {_shown(value)}. Give a str or a Path.")


def check_number(value: object, what: str, bounds: tuple[float, float], advice: str, error: type[UdccalError]) -> None:
    """Refuse what is no number within bounds, both included; NaN and truth values are none.

    Args:
        value: what was given.
        what: its name and unit, for the message.
        bounds: least and largest value.
        advice: what to do, a sentence.
        error: kind of the error.

    Raises:
        UdccalError: of that kind, with the bounds.
    """
    if isinstance(value, bool) or not isinstance(value, _NUMBER) or not bounds[0] <= value <= bounds[1]:
        raise error(f"Expected {what} from {bounds[0]:g} to {bounds[1]:g}, found {_shown(value)}. {advice}")


def check_count(value: object, what: str, least: int, most: int, error: type[UdccalError]) -> None:
    """Refuse what is no whole number within bounds, both included.

    Raises:
        UdccalError: of the kind ``error``, with the bounds.
    """
    if isinstance(value, bool) or not isinstance(value, _WHOLE) or not least <= value <= most:
        raise error(
            f"Expected {what} as a whole number from {least} to {most}, found {_shown(value)}. Give one of these."
        )


def check_seed(value: object, error: type[UdccalError]) -> None:
    """Refuse what cannot be the seed of random numbers.

    Raises:
        UdccalError: of the kind ``error``, when it is no whole number of 0 or more.
    """
    check_count(value, "a seed", 0, 2**63 - 1, error)


def check_array(
    value: object, what: str, numbers: Numbers, shape: tuple[int | str, ...], advice: str, error: type[UdccalError]
) -> None:
    """Refuse what is no array of such numbers and such a shape.

    Args:
        value: what was given.
        what: its name, for the message.
        numbers: that it holds.
        shape: length of each axis, or the name of one of any length.
        advice: what to do, a sentence.
        error: kind of the error.

    Raises:
        UdccalError: of that kind, with kind and shape of the array, or the number of its masked entries.
    """
    check_unmasked(value, what, error)
    if not (isinstance(value, np.ndarray) and _holds(value, numbers, shape)):
        expected = f"Expected {what} as an array of {numbers}, {' x '.join(map(str, shape))}"
        raise error(f"{expected}, found {found_instead(value)}. {advice}")


def array_of(value: object) -> np.ndarray:
    """Return what numpy makes of a value; an empty array of objects where lists have different lengths."""
    try:
        return np.asarray(value)
    except ValueError:
        return np.empty(0, dtype=object)


def check_positions(value: object, count: int | str, advice: str, error: type[UdccalError]) -> None:
    """Refuse what are no positions (x, y) in px on a sensor, one per row.

    Args:
        value: what was given.
        count: number of positions, or the name of any number.
        advice: what to do, a sentence.
        error: kind of the error.

    Raises:
        UdccalError: of that kind, with the shape, or the span of the positions.
    """
    check_array(value, "positions", "real numbers", (count, 2), advice, error)
    found = np.asarray(value)
    if not (np.abs(found) <= _FARTHEST_PX).all():
        span = f"{found.min():g} to {found.max():g}"
        raise error(f"Expected positions on the sensor of at most {_FARTHEST_PX} px, found {span}. {advice}")


def check_unmasked(value: object, what: str, error: type[UdccalError]) -> None:
    """Refuse a masked array with masked entries: most functions would take what lies under the mask for data.

    Raises:
        UdccalError: of the kind ``error``; ``what`` names the array.
    """
    if isinstance(value, np.ma.MaskedArray) and (masked := int(np.ma.count_masked(value))):
        advice = "Fill them with NaN where NaN is accepted, or leave them out."
        raise error(f"Expected {what} without masked entries, found {masked} of {value.size} masked. {advice}")


def _holds(array: np.ndarray, numbers: Numbers, shape: tuple[int | str, ...]) -> bool:
    if array.dtype.kind not in _KINDS[numbers] or array.ndim != len(shape):
        return False
    sides = all(isinstance(n, str) or n == found for n, found in zip(shape, array.shape, strict=True))
    return sides and (numbers != "8-bit values" or array.itemsize == 1)


def _shown(value: object) -> str:
    return repr(value)[:40] if isinstance(value, str | _NUMBER) else found_instead(value)
