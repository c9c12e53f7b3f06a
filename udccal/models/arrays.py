"""The array type of parameters and arguments: numpy or JAX, in single or double precision, or a plain number."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    # jaxtyping checks shapes and types at run time; a union of all types would not help a static checker.
    Arrayish = Any
else:
    from jaxtyping import ArrayLike as Arrayish

__all__ = ["Arrayish"]
