"""Names after the GenICam Pixel Format Naming Convention (PFNC) for mosaics that come without one."""

from __future__ import annotations

from typing import Final

from udccal.cfa import cfa_named

_BITS: Final = (8, 10, 12, 14, 16)


def unpacked_format_name(cfa: str, bits: int) -> str:
    """Return the name of unpacked samples of pattern ``cfa``, at the convention's smallest size for ``bits``."""
    return f"{cfa_named(cfa).family}{next(size for size in _BITS if size >= bits)}"
