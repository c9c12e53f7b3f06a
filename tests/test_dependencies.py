"""The packages that pyproject.toml declares, against what the sources import and what constraints.txt pins."""

from __future__ import annotations

import ast
import tomllib
from collections.abc import Iterable, Iterator
from importlib.metadata import packages_distributions, requires
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

REPOSITORY = Path(__file__).resolve().parent.parent
PROJECT = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
EXTRAS = PROJECT["optional-dependencies"]
# Never imported by name, and declared for its versions: jax calls it.
BEHIND_ANOTHER = {"jaxlib"}


def names(lines: Iterable[str]) -> set[str]:
    return {canonicalize_name(Requirement(line).name) for line in lines}


def imported(package: Path) -> Iterator[str]:
    for path in package.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                yield from (alias.name.split(".")[0] for alias in node.names)
            elif isinstance(node, ast.ImportFrom):
                yield (node.module or "").split(".")[0]


def needed(lines: Iterable[str]) -> set[str]:
    """These packages and all that they need in turn, here: on this system, with this Python."""
    waiting, found = [Requirement(line) for line in lines], set[str]()
    while waiting:
        requirement = waiting.pop()
        name = canonicalize_name(requirement.name)
        if name not in found:
            found.add(name)
            inner = map(Requirement, requires(name) or ())
            waiting += [other for other in inner if applies(other, ("", *requirement.extras))]
    return found


def applies(requirement: Requirement, extras: Iterable[str]) -> bool:
    return requirement.marker is None or any(requirement.marker.evaluate({"extra": extra}) for extra in extras)


def test_what_users_install_is_what_the_sources_import() -> None:
    modules = {module for package in ("udccal", "procedures") for module in imported(REPOSITORY / package)}
    providers = packages_distributions()
    used = {canonicalize_name(name) for module in modules for name in (module, *providers.get(module, ()))}
    assert names(PROJECT["dependencies"]) - used == BEHIND_ANOTHER


def test_every_package_of_the_development_environment_is_pinned() -> None:
    itself, *dev = sorted(EXTRAS["dev"], key=lambda line: Requirement(line).name != PROJECT["name"])
    groups = (PROJECT["dependencies"], dev, *(EXTRAS[extra] for extra in Requirement(itself).extras))
    pinned = names(line for line in (REPOSITORY / "constraints.txt").read_text().splitlines() if line[0] != "#")
    assert needed(line for group in groups for line in group) - pinned == set()
