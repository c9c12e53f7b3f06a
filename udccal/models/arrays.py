"""The array type of parameters and arguments: numpy or JAX, in single or double precision, or a plain number."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    # Shapes and types are checked at run time by jaxtyping; a union of all of them tells a static checker nothing.
    Arrayish = Any
else:
    from jaxtyping import ArrayLike as Arrayish

__all__ = ["Arrayish"]
