"""Played captures behind pages."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.web.serving import Served, played


@pytest.fixture
def served() -> Iterator[Served]:
    with played() as one:
        yield one


@pytest.fixture(scope="module")
def waiting() -> Iterator[Served]:
    """One for all tests of a module that answer nothing."""
    with played() as one:
        yield one
