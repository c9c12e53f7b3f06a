"""Terms whose fit stopped early or fits poorly: in the profile with a warning where error bars can be stated."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from udccal.cli.jobs.show import show_profile
from udccal.cli.output import Output
from udccal.errors import FitError, ProfileError
from udccal.profiles.profile import Profile, build_profile
from udccal.profiles.provenance import PROFILE_NAME
from udccal.profiles.store import read_profile, write_profile
from udccal.result import FitResult, FitStatus


def built(profile: Profile, **changed: FitResult[Any]) -> Profile:
    """The profile with other results."""
    terms = {result.name: changed.get(result.name, result) for result in profile.results}
    return build_profile(profile.rig, profile.provenance, **terms, wire_map=profile.wire_map)


@pytest.mark.parametrize("status", [FitStatus.NOT_CONVERGED, FitStatus.POOR_FIT])
def test_a_doubtful_term_is_stored_with_its_status_and_told(
    tmp_path: Path, toy_profile: Profile, status: FitStatus, capsys: pytest.CaptureFixture[str]
) -> None:
    doubtful = replace(toy_profile.noise, status=status)
    assert doubtful.usable
    with pytest.raises(FitError, match=status.name):
        doubtful.or_raise()
    write_profile(tmp_path / "p", built(toy_profile, noise=doubtful))
    found = read_profile(tmp_path / "p")
    assert found.noise.status is status
    (warning,) = found.warnings
    assert "noise fit ended as " + status.name in warning
    show_profile(Output(as_json=True), tmp_path / "p")
    printed = capsys.readouterr()
    assert json.loads(printed.out)["warnings"] == [warning]
    assert warning in printed.err.replace("\n", " ")
    assert not toy_profile.warnings


@pytest.mark.parametrize(
    "broken",
    [
        lambda noise: replace(noise, estimates=(), cov=np.zeros((0, 0))),
        lambda noise: replace(noise, estimates=(replace(noise.estimates[0], sigma=np.nan), *noise.estimates[1:])),
        lambda noise: replace(noise, estimates=(replace(noise.estimates[0], value=np.inf), *noise.estimates[1:])),
        lambda noise: replace(noise, cov=np.full_like(noise.cov, np.nan)),
        lambda noise: replace(noise, chi2_dof=np.inf),
    ],
)
def test_a_term_without_error_bars_is_refused(toy_profile: Profile, broken: Any) -> None:
    noise = broken(replace(toy_profile.noise, status=FitStatus.NOT_CONVERGED))
    assert not noise.usable
    assert not noise.warning
    with pytest.raises(FitError, match="NOT_CONVERGED"):
        built(toy_profile, noise=noise)


def test_a_term_that_could_not_be_read_again_leaves_the_old_profile(tmp_path: Path, toy_profile: Profile) -> None:
    write_profile(tmp_path / "p", toy_profile)
    before = (tmp_path / "p" / PROFILE_NAME).read_bytes()
    wrong = replace(toy_profile.wire, term=replace(toy_profile.wire.term, row_open=np.float64(-0.1)))
    with pytest.raises(ProfileError, match="row_open"):
        write_profile(tmp_path / "p", built(toy_profile, wire=wrong))
    assert (tmp_path / "p" / PROFILE_NAME).read_bytes() == before


@pytest.mark.medium
@pytest.mark.parametrize(("well", "status"), [(False, 3), (True, 0)])
def test_a_profile_with_a_warning_has_an_exit_status_of_its_own(tmp_path: Path, well: bool, status: int) -> None:
    program = (
        "from udccal.cli.jobs import fit\n"
        "from udccal.sessions.store import Session\n"
        "Session.open = lambda *_: None\n"
        f"fit.fit_to_profile = lambda *_: {well}\n"
        "from udccal.cli.main import main\n"
        f"main(['fit', {str(tmp_path)!r}, '--profile', {str(tmp_path / 'p')!r}])"
    )
    assert subprocess.run([sys.executable, "-c", program], timeout=100).returncode == status
