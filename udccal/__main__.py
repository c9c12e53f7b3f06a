"""The command ``udccal``, for computers where only ``python -m udccal`` is found."""

from __future__ import annotations

from udccal.cli.main import main

main()
