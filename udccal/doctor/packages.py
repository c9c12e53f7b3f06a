"""Compares Python and the packages that udccal needs with the versions that its own metadata allows."""

from __future__ import annotations

import platform
from collections.abc import Callable, Iterable
from importlib.metadata import PackageNotFoundError, requires, version

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from udccal.doctor.finding import Finding, Status

_DISTRIBUTION = "udccal"
# Explained separately: a version that installs and runs, and gives wrong numbers.
_WHY = {"jaxlib": "It multiplies some matrices wrongly on CPUs.", "jax": "It requires a jaxlib that computes wrongly."}


def python_finding() -> Finding:
    """Return the Python that runs this."""
    return Finding("Python", Status.OK, f"{platform.python_version()} on {platform.system()} {platform.machine()}")


def packages_finding() -> Finding:
    """Check whether every package is installed in a version that udccal can work with."""
    try:
        lines = requires(_DISTRIBUTION) or []
    except PackageNotFoundError:
        return Finding("packages", Status.NOTE, "udccal runs from a folder, not installed", "pip install udccal")
    return check_requirements(lines, version)


def check_requirements(lines: Iterable[str], installed: Callable[[str], str]) -> Finding:
    """Compare requirements, as package metadata writes them, with what is installed; extras are left out."""
    needed = [requirement for requirement in map(Requirement, lines) if _applies(requirement)]
    bad = [(requirement, found) for requirement in needed if (found := _mismatch(requirement, installed))]
    if not bad:
        return Finding("packages", Status.OK, f"all {len(needed)} in versions that fit")
    found = "; ".join(text for _, text in bad)
    why = " ".join(_WHY.get(canonicalize_name(requirement.name), "") for requirement, _ in bad).strip()
    command = "pip install " + " ".join(f"'{requirement.name}{requirement.specifier}'" for requirement, _ in bad)
    return Finding("packages", Status.PROBLEM, found, f"{why}\n{command}".strip())


def _applies(requirement: Requirement) -> bool:
    return requirement.marker is None or requirement.marker.evaluate({"extra": ""})


def _mismatch(requirement: Requirement, installed: Callable[[str], str]) -> str:
    """Return what is wrong with a package; empty when nothing is."""
    try:
        present = installed(requirement.name)
    except PackageNotFoundError:
        return f"{requirement.name} is not installed"
    if requirement.specifier.contains(present, prereleases=True):
        return ""
    return f"{requirement.name} is {present}, udccal needs {requirement.specifier}"
