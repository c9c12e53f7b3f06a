from __future__ import annotations

import pytest

from tests.usb_stack.needs import PROMISED, lacking


def test_what_is_lacking_is_skipped_unless_it_was_promised(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(PROMISED, raising=False)
    with pytest.raises(pytest.skip.Exception, match="needs this"):
        lacking("needs this")
    monkeypatch.setenv(PROMISED, "1")
    with pytest.raises(pytest.fail.Exception, match="needs this"):
        lacking("needs this")
