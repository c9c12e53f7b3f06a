"""What a restorer computes at its start, and what it takes from the folder where earlier starts kept it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from udccal.profiles.profile import Profile
from udccal.restoration import backscatter, rectify, runtime, sharpen, view
from udccal.restoration.backscatter import PanelLight
from udccal.restoration.plan import PlanOptions
from udccal.restoration.rectify import Interpolation
from udccal.restoration.runtime import Restorer
from udccal.restoration.sharpen import Sharpener
from udccal.tiers import Tier

_OPTIONS = PlanOptions(grid_rows=2, grid_columns=2, tile_rows=96, tile_columns=128)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "kept"


def _refuse(monkeypatch: pytest.MonkeyPatch, *names: str) -> None:
    """Let these computations fail."""
    for module, name in (
        (runtime, "kernel_grid"),
        (sharpen, "filter_tables"),
        (sharpen, "measured_noise"),
        (backscatter, "panel_response"),
        (view, "inscribed_view"),
        (rectify, "_sensor_pixels"),
    ):
        if name in names:
            monkeypatch.setattr(module, name, lambda *_, name=name: pytest.fail(f"computed {name}"))


def _changed_psf(profile: Profile) -> Profile:
    psf = profile.psf.term
    changed = replace(psf, residual=np.asarray(psf.residual) + 1e-4)
    return replace(profile, psf=replace(profile.psf, term=changed))


@pytest.fixture(scope="module")
def filled(profile: Profile, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Restorer]:
    """A folder in which everything is kept, and the restorer that computed it."""
    folder = tmp_path_factory.mktemp("kept", numbered=True)
    return folder, Restorer.from_profile(profile, Tier.balanced, _OPTIONS, folder)


def test_the_second_start_computes_nothing(
    profile: Profile, filled: tuple[Path, Restorer], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, first = filled
    _refuse(
        monkeypatch,
        "kernel_grid",
        "filter_tables",
        "measured_noise",
        "panel_response",
        "inscribed_view",
        "_sensor_pixels",
    )
    second = Restorer.from_profile(profile, Tier.balanced, replace(_OPTIONS, workers=1), folder)
    assert isinstance(first.sharpener, Sharpener)
    assert isinstance(second.sharpener, Sharpener)
    for part in ("grid", "tables", "noise"):
        one, other = vars(getattr(first.sharpener, part)), vars(getattr(second.sharpener, part))
        assert all(np.array_equal(one[name], other[name]) for name in one)
    assert second.panel is not None
    frame = np.full((profile.rig.camera.rows, profile.rig.camera.columns), 900, np.uint16)
    frame[20:30, 40:60] = 3000
    shown = np.full((profile.rig.panel.rows, profile.rig.panel.columns, 3), 200, np.uint8)
    assert np.array_equal(first.restore(frame, 0.02, shown), second.restore(frame, 0.02, shown))


def test_kept_sums_give_the_terms_light(profile: Profile, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rig = profile.rig
    pitch_mm, term = rig.panel.pitch_mm.value, profile.backscatter.term
    before_panel = replace(term.geometry, pupil_mm=np.array([16 * pitch_mm, 12 * pitch_mm, -14.0]))
    term = replace(term, geometry=before_panel)
    shown = np.random.default_rng(5).integers(0, 256, (rig.panel.rows, rig.panel.columns, 3)).astype(np.uint8)
    expected = PanelLight.of(term, rig).rate(shown)
    assert expected.mean() > 100
    PanelLight.of(term, rig, folder)
    _refuse(monkeypatch, "panel_response")
    assert np.array_equal(PanelLight.of(term, rig, folder).rate(shown), expected)


def test_tiers_share_what_both_need(
    profile: Profile, filled: tuple[Path, Restorer], monkeypatch: pytest.MonkeyPatch
) -> None:
    _refuse(monkeypatch, "kernel_grid", "filter_tables", "panel_response")
    Restorer.from_profile(profile, Tier.fast, _OPTIONS, filled[0])
    Restorer.from_profile(profile, Tier.fast, _OPTIONS, str(filled[0]))


_USED_LATER = {
    "interpolation": Interpolation.LINEAR,
    "network_views": 1,
    "kernel_rows": 301,  # the psf has fewer
    "workers": 3,
}


@pytest.mark.parametrize("name", _USED_LATER)
def test_what_kernels_do_not_depend_on_computes_none(
    profile: Profile, filled: tuple[Path, Restorer], monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    _refuse(monkeypatch, "kernel_grid", "filter_tables", "measured_noise", "inscribed_view", "_sensor_pixels")
    Restorer.from_profile(profile, Tier.balanced, replace(_OPTIONS, **{name: _USED_LATER[name]}), filled[0])


def test_other_tiles_share_the_kernels(
    profile: Profile, filled: tuple[Path, Restorer], monkeypatch: pytest.MonkeyPatch
) -> None:
    _refuse(monkeypatch, "kernel_grid", "filter_tables")
    with pytest.raises(pytest.fail.Exception, match="filter_tables"):
        Restorer.from_profile(profile, Tier.fast, replace(_OPTIONS, tile_columns=144), filled[0])


def test_a_rig_of_another_name_shares_all(
    profile: Profile, filled: tuple[Path, Restorer], monkeypatch: pytest.MonkeyPatch
) -> None:
    _refuse(monkeypatch, "kernel_grid", "filter_tables", "measured_noise", "panel_response", "_sensor_pixels")
    renamed = replace(profile, rig=profile.rig.model_copy(update={"name": "another"}))
    Restorer.from_profile(renamed, Tier.balanced, _OPTIONS, filled[0])


@pytest.mark.parametrize("name", ["grid_rows", "grid_columns"])
def test_kernels_at_other_places_are_computed_anew(
    profile: Profile, filled: tuple[Path, Restorer], monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    _refuse(monkeypatch, "kernel_grid")
    with pytest.raises(pytest.fail.Exception, match="kernel_grid"):
        Restorer.from_profile(profile, Tier.fast, replace(_OPTIONS, **{name: 3}), filled[0])


def test_a_changed_psf_computes_its_kernels_anew(
    profile: Profile, filled: tuple[Path, Restorer], monkeypatch: pytest.MonkeyPatch
) -> None:
    _refuse(monkeypatch, "kernel_grid", "panel_response")
    with pytest.raises(pytest.fail.Exception, match="kernel_grid"):
        Restorer.from_profile(_changed_psf(profile), Tier.fast, _OPTIONS, filled[0])


def test_changed_kernels_compute_their_tables_anew(
    profile: Profile, filled: tuple[Path, Restorer], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, restorer = filled
    _refuse(monkeypatch, "filter_tables")
    assert restorer.sharpener is not None
    grid, rows = restorer.sharpener.grid, restorer.rectification.rows
    Sharpener.of(grid, profile.rig, rows, Tier.fast, _OPTIONS, folder)
    changed = replace(grid, kernels=grid.kernels * np.float32(1.001))
    with pytest.raises(pytest.fail.Exception, match="filter_tables"):
        Sharpener.of(changed, profile.rig, rows, Tier.fast, _OPTIONS, folder)


def test_other_options_compute_anew(
    profile: Profile, filled: tuple[Path, Restorer], monkeypatch: pytest.MonkeyPatch
) -> None:
    _refuse(monkeypatch, "kernel_grid")
    with pytest.raises(pytest.fail.Exception, match="kernel_grid"):
        Restorer.from_profile(profile, Tier.fast, replace(_OPTIONS, grid_columns=3), filled[0])


def test_libraries_keep_nothing_unasked(
    profile: Profile, filled: tuple[Path, Restorer], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("UDCCAL_COMPILATIONS", str(filled[0].parent))
    _refuse(monkeypatch, "kernel_grid")
    with pytest.raises(pytest.fail.Exception, match="kernel_grid"):
        Restorer.from_profile(profile, Tier.fast, _OPTIONS)
