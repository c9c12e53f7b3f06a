from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError

import pytest

from udccal.doctor import packages
from udccal.doctor.finding import Status
from udccal.doctor.packages import check_requirements, packages_finding, python_finding

LINES = (
    "jaxlib!=0.10.2,>=0.8",
    "numpy>=2.0",
    'pytest>=8.3; extra == "dev"',
    'winonly>=1; sys_platform == "never"',
)


def installed(versions: Mapping[str, str]):
    def version(name: str) -> str:
        if name not in versions:
            raise PackageNotFoundError(name)
        return versions[name]

    return version


def test_versions_that_fit_are_fine_and_extras_are_left_out() -> None:
    finding = check_requirements(LINES, installed({"jaxlib": "0.10.1", "numpy": "2.4.6"}))
    assert finding.status is Status.OK
    assert finding.found == "all 2 in versions that fit"


@pytest.mark.parametrize(
    ("versions", "found", "advice"),
    [
        ({"jaxlib": "0.10.2", "numpy": "2.4"}, "jaxlib is 0.10.2", "wrongly"),
        ({"jaxlib": "0.10.2", "numpy": "2.4"}, "jaxlib is 0.10.2", "pip install 'jaxlib!=0.10.2,>=0.8'"),
        (
            {"jaxlib": "0.7", "numpy": "1.26"},
            "jaxlib is 0.7, udccal needs !=0.10.2,>=0.8; numpy is 1.26",
            "'numpy>=2.0'",
        ),
        ({"jaxlib": "0.10.1"}, "numpy is not installed", "'numpy>=2.0'"),
        ({"jaxlib": "weird", "numpy": "2.4"}, "jaxlib is weird", "'jaxlib"),
    ],
    ids=["pinned away", "command", "old", "absent", "no version"],
)
def test_versions_that_do_not_fit_are_problems(versions: dict[str, str], found: str, advice: str) -> None:
    finding = check_requirements(LINES, installed(versions))
    assert finding.status is Status.PROBLEM
    assert found in finding.found
    assert advice in finding.advice


def test_this_environment_is_checked_against_the_projects_own_metadata(monkeypatch: pytest.MonkeyPatch) -> None:
    assert packages_finding().status is Status.OK
    assert python_finding().status is Status.OK
    present = packages.version
    monkeypatch.setattr(packages, "version", lambda name: "0.10.2" if name == "jaxlib" else present(name))
    assert packages_finding().status is Status.PROBLEM


def test_a_source_folder_that_is_not_installed_is_a_note(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(packages, "_DISTRIBUTION", "udccal-of-another-name")
    assert packages_finding().status is Status.NOTE
