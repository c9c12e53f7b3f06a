from __future__ import annotations

from importlib.metadata import EntryPoint, EntryPoints

import pytest

from procedures.base import Procedure
from procedures.psf import PsfProcedure
from procedures.wire import WireProcedure
from udccal import plugins
from udccal.errors import UdccalError

OWN = ("wire", "procedures.wire:WireProcedure")


def install(monkeypatch: pytest.MonkeyPatch, *points: tuple[str, str]) -> None:
    found = EntryPoints(EntryPoint(name, value, plugins.PROCEDURES) for name, value in points)
    monkeypatch.setattr(plugins, "_installed", lambda group: found.select(group=group))


@pytest.mark.parametrize("term", ["noise", "geometry", "wire", "psf", "backscatter"])
def test_the_five_procedures_are_installed(term: str) -> None:
    found = plugins.find_procedure(term)
    assert issubclass(found, Procedure)
    assert found.term == term


@pytest.mark.parametrize("name", ["images", "shm", "v4l2", "video", "window"])
def test_the_five_sinks_are_installed(name: str) -> None:
    assert plugins.find_sink(name).__module__.startswith("udccal.live.sinks.")


def test_another_packages_procedure_goes_first(monkeypatch: pytest.MonkeyPatch) -> None:
    install(monkeypatch, OWN)
    assert plugins.find_procedure("wire") is WireProcedure
    install(monkeypatch, OWN, ("wire", "procedures.psf:PsfProcedure"))
    monkeypatch.setattr(plugins, "_is_our_own", lambda point: "wire" in point.value)
    assert plugins.find_procedure("wire") is PsfProcedure


@pytest.mark.parametrize(
    ("points", "message"),
    [
        ([], "found none in the entry-point group 'udccal.procedures', which has nothing"),
        ([("psf", "other:Psf")], "which has psf"),
        ([OWN, ("wire", "other:Wire"), ("wire", "third:Wire")], "one procedure for the term 'wire', found other:Wire"),
        ([("wire", "no_such_package:Wire")], "procedure for the term 'wire' at no_such_package:Wire, found: No module"),
        ([("wire", "procedures.wire:Nothing")], "Reinstall the package"),
        ([("wire", "procedures.wire:_DARKS")], "to be a class, found 16"),
    ],
)
def test_what_cannot_be_used_is_refused(monkeypatch: pytest.MonkeyPatch, points: list, message: str) -> None:
    install(monkeypatch, *points)
    with pytest.raises(UdccalError, match=message):
        plugins.find_procedure("wire")
