"""Loads pypylon when it is used and not before, since it is large. The only module that imports it."""

from __future__ import annotations

import importlib
import warnings
from dataclasses import dataclass
from typing import Any, final

from udccal.errors import CameraError


@final
@dataclass(frozen=True)
class Sdk:
    """pypylon's two modules; their classes are made at run time and have no types."""

    pylon: Any
    genicam: Any


def load_sdk() -> Sdk:
    """Return the SDK, loaded once per process.

    Raises:
        CameraError: when pypylon is not installed, is too old, or its native library cannot be loaded.
    """
    try:
        with warnings.catch_warnings():
            # Its extension warns while it loads; where warnings are errors, that ends the process without a message.
            warnings.simplefilter("ignore", DeprecationWarning)
            sdk = Sdk(importlib.import_module("pypylon.pylon"), importlib.import_module("pypylon.genicam"))
    except ImportError as error:
        raise CameraError(
            f"Expected Basler's SDK for the pylon cameras, found that pypylon cannot be loaded ({error}). "
            "Install it with: pip install 'udccal[pylon]'."
        ) from error
    if not hasattr(sdk.pylon, "PlaceholderParameter"):  # since 26.6 it represents a feature that is not there
        raise CameraError(
            "Expected pypylon 26.6 or newer, found an older one. Update it with: pip install -U 'udccal[pylon]'."
        )
    return sdk
