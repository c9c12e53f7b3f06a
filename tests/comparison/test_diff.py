"""The whole comparison: verdicts, mirrored profiles, sentences, and profiles that cannot be compared."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import replace
from typing import Any, get_args

import numpy as np
import pytest

import udccal
from tests.comparison.perturbed import moved, with_estimates, with_result
from udccal.cli.output import plain
from udccal.comparison.comparable import check_comparable
from udccal.comparison.effects import Effect
from udccal.comparison.limits import DiffLimits
from udccal.comparison.maps import difference_maps
from udccal.comparison.term_diff import VERDICTS, verdict_of
from udccal.errors import ProfileError
from udccal.fitting.wire.fit import sensor_map
from udccal.profiles.profile import Profile, build_profile
from udccal.reports.diff_tables import movement_sentence, notes
from udccal.result import Captures, FitStatus
from udccal.sessions.schema import TermName

LIMITS = DiffLimits()


def effect(value: float, limit: float | None = 1.0, error: float | None = None) -> Effect:
    return Effect("map", value, "%", limit, error)


@pytest.mark.parametrize(
    ("chi2", "dof", "effects", "expected"),
    [
        (0.0, 10, (effect(0.0),), "same"),
        (12.0, 10, (effect(0.5),), "same"),
        (12.0, 10, (effect(5.0),), "same"),  # chance explains it, though it would matter: error bars are wide
        (60.0, 10, (effect(0.5),), "changed, harmless"),
        (60.0, 10, (effect(5.0),), "changed"),
        (60.0, 10, (effect(0.5), effect(5.0)), "changed"),
        (60.0, 10, (effect(5.0, limit=None),), "changed, harmless"),
        (12.0, 10, (effect(5.0, error=1.0),), "changed"),  # arrays changed that are in no covariance
        (12.0, 10, (effect(3.0, error=1.0),), "same"),
        (0.0, 0, (effect(0.0),), "same"),
        (0.0, 0, (effect(0.5),), "changed, harmless"),  # no error bars at all: each difference is one
        (0.0, 0, (effect(5.0),), "changed"),
        (0.0, 0, (effect(0.5, error=1.0),), "same"),
    ],
)
def test_a_verdict_needs_significance_and_effect(
    chi2: float, dof: int, effects: tuple[Effect, ...], expected: str
) -> None:
    assert verdict_of(chi2, dof, effects, LIMITS) == expected


def test_verdicts_are_ordered_from_best_to_worst() -> None:
    assert VERDICTS == ("same", "changed, harmless", "not compared", "changed")


def with_rig(profile: Profile, part: str, **changes: Any) -> Profile:
    rig = profile.rig
    return replace(
        profile, rig=rig.model_copy(update={part: getattr(rig, part).model_copy(update=changes)} if part else changes)
    )


@pytest.mark.usefixtures("as_other_programs_call")
def test_limits_of_another_kind_are_refused(toy: Profile) -> None:
    for limits in ("a", {}):
        with pytest.raises(ProfileError, match="Expected a DiffLimits, found"):
            udccal.diff(toy, toy, limits)  # type: ignore[arg-type]


def test_other_rigs_and_sensors_are_refused(measured: Profile) -> None:
    taken_by = measured.provenance.camera
    assert taken_by is not None
    camera = taken_by.model_copy(update={"serial": "other"})
    others = {
        "another rig": with_rig(measured, "", name="mk31"),
        "another size of the sensor": with_rig(measured, "camera", columns=1026),
        "another pattern": with_rig(measured, "camera", cfa="BGGR"),
        "another number of bits": with_rig(measured, "camera", bits=10),
        "another size of the panel": with_rig(measured, "panel", rows=1081),
        "another camera": replace(measured, provenance=measured.provenance.model_copy(update={"camera": camera})),
    }
    for said, other in others.items():
        for pair in ((measured, other), (other, measured)):
            with pytest.raises(ProfileError, match=f"found {said}"):
                check_comparable(*pair)
    check_comparable(measured, measured)
    unknown = replace(measured, provenance=measured.provenance.model_copy(update={"camera": None}))
    check_comparable(measured, unknown)


def numbers(found: udccal.ProfileDiff) -> list[float]:
    """Every number of a comparison that must be 0 for a profile and itself."""
    parts = (*found.movement.parts, found.movement.distance, found.movement.angle)
    return [
        *(one.chi2 for one in found.terms),
        *(e.value for one in found.terms for e in one.effects),
        *(e.difference for one in found.terms for e in one.estimates),
        *(part.value or 0.0 for part in parts),
        found.picture_dB_lost,
        found.movement.chi2,
        found.movement.agreement_chi2,
    ]


@pytest.mark.medium
def test_a_profile_and_itself_are_the_same(toy: Profile) -> None:
    found = udccal.diff(toy, toy)
    assert set(numbers(found)) == {0.0}
    assert (found.verdict, {one.verdict for one in found.terms}) == ("same", {"same"})
    assert found.advice == "Go on with either profile: they agree within their error bars."


@pytest.mark.medium
def test_what_two_profiles_share_is_computed_once(toy: Profile) -> None:
    maps = difference_maps(toy, toy)
    assert maps.kernels_a is maps.kernels_b
    assert maps.light_a is maps.light_b
    brighter = replace(toy.backscatter.term, mask=2 * np.asarray(toy.backscatter.term.mask))
    other = difference_maps(toy, replace(toy, backscatter=replace(toy.backscatter, term=brighter)))
    assert other.kernels_a is other.kernels_b
    np.testing.assert_allclose(other.light_b, 2 * other.light_a)


@pytest.mark.medium
def test_what_chi_squared_leaves_out_is_listed_by_names_that_hold_commas(toy: Profile) -> None:
    term = replace(udccal.diff(toy, toy).terms[1], not_covered=("fx", "fy"))
    assert notes(term)[-1].endswith("no covariance is kept of it: focal length, x; focal length, y.")


@pytest.mark.medium
@pytest.mark.parametrize("lacks", [("wire",), ("wire", "psf"), get_args(TermName)], ids=str)
def test_a_term_that_nobody_captured_is_not_compared(toy: Profile, lacks: tuple[TermName, ...]) -> None:
    lacking = {term: replace(toy.result(term), status=FitStatus.NOT_CAPTURED) for term in lacks}
    found = udccal.diff(toy, replace(toy, **lacking))
    assert [one.term for one in found.terms if one.verdict == "not compared"] == list(lacks)
    assert found.verdict == "not compared"
    assert all("not captured for B" in one.notes[0] for one in found.terms if one.term in lacks)
    assert found.advice.startswith("Capture ")
    assert "either profile" not in found.advice


@pytest.mark.medium
def test_a_newer_profile_that_lacks_a_term_is_not_advised_as_it_is(toy: Profile) -> None:
    other, later = changed(toy), toy.provenance.model_copy(update={"created_at": "2999-01-01T00:00:00+00:00"})
    lacking = replace(other, provenance=later, psf=replace(other.psf, status=FitStatus.NOT_CAPTURED))
    for found, newer in ((udccal.diff(toy, lacking), "B"), (udccal.diff(lacking, toy), "A")):
        assert found.verdict == "changed"
        assert found.advice.startswith(f"Capture psf for {newer}, the newer profile, then use it:")
        assert "psf could not be compared" in found.advice


def changed(toy: Profile) -> Profile:
    """Another wire map, a darker panel, a turned camera and a higher gain."""
    light, noise = toy.backscatter.term, toy.noise.term
    other = moved(toy, (0.0, 0.0, 0.0), (0.5, 0.0, 0.0))
    other = with_estimates(other, "noise", {"K_DN_per_e": 0.02})
    return build_profile(
        toy.rig,
        toy.provenance,
        noise=replace(other.noise, term=replace(noise, K_DN_per_e=noise.K_DN_per_e + 0.02)),
        geometry=other.geometry,
        wire=other.wire,
        psf=other.psf,
        backscatter=replace(other.backscatter, term=replace(light, mask=0.9 * light.mask)),
        wire_map=toy.wire_map[:, ::-1].astype(np.float64),
    )


@pytest.mark.medium
def test_what_changed_is_named_and_mirrored(toy: Profile) -> None:
    other = changed(toy)
    there, back = udccal.diff(toy, other), udccal.diff(other, toy)
    verdicts = {one.term: one.verdict for one in there.terms}
    assert {term for term, verdict in verdicts.items() if verdict == "changed"} == {
        "noise", "geometry", "wire", "backscatter"
    }  # fmt: skip
    assert verdicts == {one.term: one.verdict for one in back.terms}
    assert there.movement.angle.value == pytest.approx(0.5, rel=1e-6)
    assert "turned by 0.5000 ± 0.00" in there.advice
    np.testing.assert_allclose(np.abs(numbers(there)), np.abs(numbers(back)), rtol=1e-5, atol=1e-9)
    for one, same in zip(there.terms, back.terms, strict=True):
        assert [e.difference for e in one.estimates] == pytest.approx([-e.difference for e in same.estimates], rel=1e-9)
    rays = there.terms[1].effects[0]
    focal = float(toy.geometry.term.focal_px[0])
    assert rays.value == pytest.approx(np.deg2rad(0.5) * focal, rel=0.6)
    assert rays.value > np.deg2rad(0.5) * focal  # it is more beside the axis
    assert there.terms[4].effects[0].value == pytest.approx(10.0, rel=0.6)


@pytest.mark.medium
def test_fits_of_the_same_captures_are_not_independent(toy: Profile) -> None:
    """What differs is the fits' doing: no probability is told, and no movement; what matters is still said."""
    other = changed(toy)
    for name in ("noise", "geometry"):
        used = Captures(name[0] * 64, 2, 20, (0.0, 0.0), ("2026-01-02", "2026-01-02"))
        toy, other = (with_result(one, name, captures=used, effort="quick") for one in (toy, other))
    found = udccal.diff(toy, other)
    noise, geometry, wire = found.terms[:3]
    assert [one.same_captures for one in found.terms] == [True, True, False, False, False]
    assert (noise.verdict, geometry.verdict, wire.verdict) == ("changed", "changed", "changed")
    assert "same captures" in noise.notes[0]
    assert noise.notes[1] == "A: The effort of its fit was quick: a full fit may be better."
    assert (found.movement.terms, found.movement.angle.value) == ((), None)
    assert movement_sentence(found) == "Both profiles were fitted to the same captures: they tell no movement."
    harmless = with_estimates(toy, "noise", {"black_DN": 5.0})
    assert udccal.diff(toy, harmless).terms[0].verdict == "same"


@pytest.mark.medium
def test_a_term_without_error_bars_is_told(toy: Profile) -> None:
    silent = with_result(toy, "geometry", estimates=(), cov=np.zeros((0, 0)))
    doubtful = with_result(silent, "noise", status=FitStatus.POOR_FIT)
    found = udccal.diff(toy, doubtful)
    assert found.terms[1].notes == ("B: no number of this term was measured; what restoration uses is compared.",)
    assert found.terms[1].effects[0].error is None
    assert found.terms[3].notes[0].startswith("A and B: no number")
    wide = with_result(changed(toy), "geometry", estimates=toy.geometry.estimates, cov=1e12 * toy.geometry.cov)
    told = udccal.diff(toy, wide).terms[1]
    assert told.verdict == "same"
    assert told.notes[-1].endswith("Capture more.")
    assert found.terms[0].notes[0].startswith("B: Careful: the noise fit ended as POOR_FIT.")
    document = json.loads(json.dumps(plain(found), allow_nan=False))
    assert (document["format"], document["version"]) == ("udccal-diff", 1)
    assert set(document) == {field.name for field in dataclasses.fields(udccal.ProfileDiff)}


@pytest.mark.medium
def test_terms_that_give_no_finite_numbers_are_refused(toy: Profile) -> None:
    dark = replace(toy.psf.term, residual=np.zeros_like(toy.psf.term.residual))
    bent = replace(toy.geometry.term, distortion=np.full(5, 1e6))
    for other in (with_result(toy, "psf", term=dark), with_result(toy, "geometry", term=bent)):
        with pytest.raises(ProfileError, match="finite numbers"):
            udccal.diff(toy, other)


def with_wire_map(profile: Profile) -> Profile:
    camera = profile.rig.camera
    return replace(profile, wire_map=sensor_map(profile.wire.term, camera.rows, camera.columns).astype(np.float32))


@pytest.mark.medium
def test_a_knock_of_a_measured_rig_is_found(measured: Profile) -> None:
    other = with_wire_map(moved(measured, (0.0, 0.05, 0.0), (0.0, 0.0, 0.0)))
    found = udccal.diff(measured, other)
    verdicts = {one.term: one.verdict for one in found.terms}
    assert verdicts["wire"] == verdicts["backscatter"] == found.verdict == "changed"
    assert verdicts["noise"] == verdicts["geometry"] == verdicts["psf"] == "same"
    assert found.movement.parts[1].value == pytest.approx(0.05, abs=1e-4)
    assert found.movement.whole_pitches == (0, 0)
    assert found.advice.startswith("Use B, the newer profile: the other one no longer describes wire (")
    assert "the camera moved by 0.0500 ± 0.000" in found.advice
    assert found.terms[2].effects[0].value == pytest.approx(0.98, rel=0.05)  # % of the wire map


@pytest.mark.medium
def test_five_micrometres_are_significant_and_harmless(measured: Profile) -> None:
    found = udccal.diff(measured, with_wire_map(moved(measured, (0.0, 0.005, 0.0), (0.0, 0.0, 0.0))))
    assert found.terms[2].verdict == found.verdict == "changed, harmless"
    assert found.terms[2].effects[0].value == pytest.approx(0.099, rel=0.05)
    assert found.movement.p_value < 1e-6
    assert found.picture_dB_lost < 0.05
    assert found.advice.startswith("Go on with either profile: wire changed, too little to matter; the camera moved by")


@pytest.mark.medium
@pytest.mark.parametrize(("part", "verdict"), [(0.0001, "changed"), (0.01, "same")])
def test_light_in_electrons_is_as_uncertain_as_the_gain(measured: Profile, part: float, verdict: str) -> None:
    numbers = measured.noise.estimates
    known = tuple(replace(one, sigma=part * one.value) if one.name == "K_DN_per_e" else one for one in numbers)
    measured = with_result(measured, "noise", estimates=known)
    light = measured.backscatter.term
    other = with_result(measured, "backscatter", term=replace(light, mask=1.015 * light.mask), captures=None)
    assert udccal.diff(measured, other).terms[4].verdict == verdict


@pytest.mark.medium
def test_profiles_that_tell_no_place_are_not_said_to_share_captures(toy: Profile) -> None:
    silent = with_result(toy, "geometry", estimates=(), cov=np.zeros((0, 0)))
    silent = with_result(silent, "noise", estimates=(), cov=np.zeros((0, 0)))
    found = udccal.diff(silent, silent)
    assert movement_sentence(found) == "No term of both profiles tells where the camera was."
