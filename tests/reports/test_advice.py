"""What a report begins with, for every way in which fits may end."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from udccal.profiles.profile import Profile
from udccal.profiles.store import load_profile
from udccal.reports.advice import advice
from udccal.result import FitStatus


@pytest.fixture(scope="module")
def whole() -> Profile:
    """A profile whose five terms converged, without notes."""
    profile = load_profile("lg55-reduced")
    return replace(profile, **{result.name: replace(result, notes=()) for result in profile.results})


def ended(profile: Profile, **statuses: FitStatus) -> Profile:
    return replace(profile, **{term: replace(profile.result(term), status=s) for term, s in statuses.items()})


def failed(profile: Profile, term: str, status: FitStatus) -> Profile:
    """Without error bars, so that the term cannot be used."""
    result = replace(profile.result(term), status=status, cov=np.zeros((0, 0)), estimates=())
    return replace(profile, **{term: result})


def test_a_good_calibration_is_told_to_be_used_and_until_when(whole: Profile) -> None:
    found = advice(whole)
    assert (found.headline, found.mood) == ("All five terms can be used.", "good")
    (sentence,) = found.sentences
    assert sentence.startswith("Restore with this profile until the lens is refocused")


def test_notes_of_good_terms_are_named(whole: Profile) -> None:
    noted = replace(whole, wire=replace(whole.wire, notes=("A note.",)), psf=replace(whole.psf, notes=("A note.",)))
    assert advice(noted).headline == "All five terms can be used. Read the notes of wire and psf."


@pytest.mark.parametrize(
    ("term", "status", "told"),
    [
        ("noise", FitStatus.TOO_FEW_DATA, "flats and darks at more exposures"),
        ("geometry", FitStatus.TOO_FEW_DATA, "views of the board"),
        ("wire", FitStatus.SATURATED, "Capture wire again with less light"),
        ("psf", FitStatus.TOO_DARK, "Capture psf again with more light"),
        ("backscatter", FitStatus.POOR_FIT, "compare rig.toml with the rig"),
        ("psf", FitStatus.NOT_CONVERGED, "Look at the residuals of psf"),
    ],
)
def test_a_term_that_cannot_be_used_comes_first(whole: Profile, term: str, status: FitStatus, told: str) -> None:
    found = advice(failed(ended(whole, noise=FitStatus.CONVERGED), term, status))
    assert (found.headline, found.mood) == (f"Not usable: {term}.", "bad")
    assert told in found.sentences[0]
    assert not any("Restore with this profile" in sentence for sentence in found.sentences)


def test_a_doubtful_term_may_be_used_meanwhile(whole: Profile) -> None:
    found = advice(ended(whole, psf=FitStatus.NOT_CONVERGED))
    assert (found.headline, found.mood) == ("Usable with care: psf.", "careful")
    assert found.sentences[0].startswith("Look at the residuals of psf")
    assert found.sentences[1].startswith("Until then restore with this profile")


def test_what_was_not_captured_is_asked_for_by_its_command(whole: Profile) -> None:
    found = advice(ended(whole, wire=FitStatus.NOT_CAPTURED, psf=FitStatus.NOT_CAPTURED))
    assert found.mood == "absent"
    assert found.headline.endswith("can be used: noise, geometry, backscatter. Not captured: wire, psf.")
    assert found.sentences[0] == (
        "Capture wire and psf, where nobody looked yet: udccal calibrate with --term wire --term psf."
    )


@pytest.mark.parametrize("term", ["wire", "psf", "backscatter"])
@pytest.mark.parametrize("noise", [FitStatus.CONVERGED, FitStatus.NOT_CONVERGED])
def test_nobody_is_told_to_restore_what_was_not_measured(whole: Profile, term: str, noise: FitStatus) -> None:
    found = advice(ended(whole, noise=noise, **{term: FitStatus.NOT_CAPTURED}))
    assert not any("estore with this profile" in sentence for sentence in found.sentences)


@pytest.mark.parametrize("term", ["wire", "psf", "backscatter"])
def test_a_poor_fit_without_the_lens_asks_for_the_geometry(whole: Profile, term: str) -> None:
    found = advice(ended(whole, geometry=FitStatus.NOT_CAPTURED, **{term: FitStatus.POOR_FIT}))
    assert found.sentences[0].startswith(f"Capture geometry, then fit {term} again")
    found = advice(ended(whole, geometry=FitStatus.NOT_CAPTURED, noise=FitStatus.POOR_FIT))
    assert found.sentences[0].startswith("For noise, compare rig.toml")


def test_what_is_to_be_done_comes_before_what_is_good_to_know(whole: Profile) -> None:
    found = advice(ended(whole, psf=FitStatus.NOT_CONVERGED, geometry=FitStatus.NOT_CAPTURED))
    assert [sentence.split()[0] for sentence in found.sentences] == ["Look", "Capture", "Until"]


def test_there_are_never_more_than_three_sentences(whole: Profile) -> None:
    worst = whole
    for term in ("noise", "geometry", "wire", "psf", "backscatter"):
        worst = failed(worst, term, FitStatus.POOR_FIT)
    found = advice(worst)
    assert len(found.sentences) == 3
    assert found.sentences[-1] == "The sections of the other terms say what else to do."
