"""``udccal profile prepare`` with a profile of which only the noise was measured."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from udccal.cli.jobs.prepare import prepare_profile
from udccal.cli.output import Output
from udccal.errors import RestorationError
from udccal.restoration.runtime import Restorer
from udccal.tiers import Tier


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of compilations of its own, which JAX is not told of."""
    folder = tmp_path / "cache"
    monkeypatch.setenv("UDCCAL_COMPILATIONS", str(folder))
    monkeypatch.setattr("udccal.cli.jobs.prepare.keep_compilations", lambda: None)
    return folder


def test_it_prepares_into_the_folder_that_restore_reads(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: list[tuple[object, ...]] = []

    def load(profile: Path, tier: Tier, keep: Path) -> None:
        asked.append((profile, tier, keep))
        (keep / "entry.prepared").write_bytes(bytes(2_500_000))

    monkeypatch.setattr(Restorer, "load", load)
    prepare_profile(Output(as_json=True), Path("some"), Tier.fast)
    assert asked == [(Path("some"), Tier.fast, folder / "prepared")]
    written = capsys.readouterr()
    shown = json.loads(written.out)
    assert shown["seconds"] > 0
    assert (shown["tier"], shown["bytes"], shown["folder"]) == ("fast", 2_500_000, str(folder / "prepared"))
    assert "2.5 MB" in written.err


def test_a_folder_that_others_may_write_is_refused(folder: Path) -> None:
    (folder / "prepared").mkdir(parents=True)
    (folder / "prepared").chmod(0o777)
    with pytest.raises(RestorationError, match="its owner alone may write to") as error:
        prepare_profile(Output(), Path("some"), Tier.fast)
    assert "UDCCAL_COMPILATIONS" in str(error.value)
