"""Every number in npz and csv, the covariance beside each file, and no file written over."""

from __future__ import annotations

import csv
import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from udccal.errors import ProfileError
from udccal.profiles.exchange.exports import EXPORTS, covariance_file, export_profile
from udccal.profiles.profile import Profile


def test_npz_has_every_number_and_no_objects(tmp_path: Path, profile: Profile) -> None:
    export_profile(profile, EXPORTS["npz"], tmp_path / "p.npz")
    with np.load(tmp_path / "p.npz", allow_pickle=False) as found:
        arrays = {name: found[name] for name in found.files}
    np.testing.assert_array_equal(arrays["geometry.focal_px"], profile.geometry.term.focal_px)
    np.testing.assert_array_equal(arrays["psf.diffraction.openings"], profile.psf.term.diffraction.openings)
    np.testing.assert_array_equal(arrays["psf.residual"], profile.psf.term.residual)
    np.testing.assert_array_equal(arrays["noise.fit.covariance"], profile.noise.cov)
    np.testing.assert_array_equal(arrays["wire_map"], profile.wire_map)
    assert str(arrays["backscatter.fit.status"]) == "ABSENT"
    assert list(arrays["noise.fit.estimates"]) == ["K_DN_per_e", "black_DN"]


def test_csv_has_every_estimate(tmp_path: Path, profile: Profile) -> None:
    export_profile(profile, EXPORTS["csv"], tmp_path / "p.csv")
    with (tmp_path / "p.csv").open(newline="") as stream:
        lines = list(csv.DictReader(stream))
    wanted = [(r.name, e.name, e.value, e.sigma, e.unit) for r in profile.results for e in r.estimates]
    assert [(x["term"], x["name"], float(x["value"]), float(x["sigma"]), x["unit"]) for x in lines] == wanted


@pytest.mark.parametrize("words", [{"name": "=1+1"}, {"unit": "@SUM(A1)"}])
def test_csv_holds_no_formula(tmp_path: Path, profile: Profile, words: dict[str, str]) -> None:
    first, *others = profile.noise.estimates
    noise = dataclasses.replace(profile.noise, estimates=(dataclasses.replace(first, **words), *others))
    with pytest.raises(ProfileError, match="which a spreadsheet would compute"):
        export_profile(dataclasses.replace(profile, noise=noise), EXPORTS["csv"], tmp_path / "p.csv")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", EXPORTS)
def test_the_covariance_is_beside_and_says_what_is_missing(tmp_path: Path, profile: Profile, name: str) -> None:
    export_profile(profile, EXPORTS[name], tmp_path / "f")
    beside = json.loads(covariance_file(tmp_path / "f").read_text())
    assert [term["term"] for term in beside["terms"]] == list(EXPORTS[name].terms)
    for term in beside["terms"]:
        np.testing.assert_array_equal(np.array(term["covariance"]).reshape(profile.result(term["term"]).cov.shape),
                                      profile.result(term["term"]).cov)  # fmt: skip
    assert any("cannot hold" in sentence for sentence in beside["not_held"])


@pytest.mark.parametrize("taken", ["f", "f.json"])
def test_no_file_is_written_over(tmp_path: Path, profile: Profile, taken: str) -> None:
    (tmp_path / taken).write_text("mine")
    with pytest.raises(ProfileError, match="exists"):
        export_profile(profile, EXPORTS["csv"], tmp_path / "f")
    assert [item.name for item in tmp_path.iterdir()] == [taken]


@pytest.mark.parametrize("end", [OSError(28, "No space left on device"), KeyboardInterrupt("No more")])
def test_a_file_that_cannot_be_written_leaves_nothing(
    tmp_path: Path, profile: Profile, monkeypatch: pytest.MonkeyPatch, end: BaseException
) -> None:
    def write(path: Path, content: bytes) -> None:
        if path.name == "f":
            raise end
        path.write_bytes(content)

    monkeypatch.setattr("udccal.profiles.exchange.exports.write_atomically", write)
    with pytest.raises(type(end), match="No "):
        export_profile(profile, EXPORTS["csv"], tmp_path / "f")
    assert list(tmp_path.iterdir()) == []
