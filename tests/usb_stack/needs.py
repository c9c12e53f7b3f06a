"""What a test needs and may not have."""

from __future__ import annotations

import os
from typing import NoReturn

import pytest

PROMISED = "UDCCAL_USB_STACK"


def lacking(what: str) -> NoReturn:
    """Skip a test for want of something, or fail it where everything was promised to be there."""
    if os.environ.get(PROMISED):
        pytest.fail(what)
    pytest.skip(what)
