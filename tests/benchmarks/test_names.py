"""Linters take shapes in annotations for names, so that a name which is not defined would show only when it is read."""

from __future__ import annotations

import builtins
import dis
import importlib
from collections.abc import Iterator
from pathlib import Path
from types import CodeType, ModuleType

import pytest

_HERE = Path(__file__).resolve().parent
_MODULES = sorted(one.relative_to(_HERE.parents[1]) for one in _HERE.rglob("[a-z]*.py"))


def _codes(code: CodeType) -> Iterator[CodeType]:
    yield code
    for inner in code.co_consts:
        if isinstance(inner, CodeType):
            yield from _codes(inner)


def undefined(source: str, module: ModuleType) -> set[str]:
    """Global names that some function of a module reads, and that neither the module nor Python has."""
    own = (code for code in _codes(compile(source, module.__name__, "exec")))
    read = {i.argval for code in own for i in dis.get_instructions(code) if i.opname == "LOAD_GLOBAL"}
    return {name for name in read if not hasattr(module, name) and not hasattr(builtins, name)}


@pytest.mark.medium
@pytest.mark.parametrize("path", _MODULES, ids=str)
def test_every_name_that_a_benchmark_reads_is_defined(path: Path) -> None:
    try:
        module = importlib.import_module(".".join(path.with_suffix("").parts))
    except ModuleNotFoundError as missing:
        if missing.name != "torch":  # an extra that only training needs
            raise
        pytest.skip("pip install 'udccal[train]'")
    assert not undefined((_HERE.parents[1] / path).read_text(encoding="utf-8"), module)


def test_a_name_that_is_not_defined_is_found() -> None:
    source = "def f(x: Float[Array, 'rows']):\n    return [shape + len(x) for _ in x]"
    assert undefined(source, ModuleType("made")) == {"shape"}
