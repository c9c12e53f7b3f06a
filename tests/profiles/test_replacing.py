"""A process that writes a profile ends at every step in turn: a reader finds the old profile or the new one."""

from __future__ import annotations

import dataclasses
import os
import shutil
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from udccal.errors import ProfileError
from udccal.io import whole_folder
from udccal.profiles import store
from udccal.profiles.profile import Profile
from udccal.profiles.provenance import PROFILE_NAME
from udccal.profiles.schema import StoredProfile
from udccal.profiles.store import find_profile, read_profile, read_stored, write_profile

OLD, NEW = "0" * 64, "1" * 64
STEPS = ("open", "os.mkdir", "os.rename", "os.remove", "os.rmdir", "ctypes.dlsym")
KILLED = 9


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory, toy_profile: Profile) -> Path:
    folder = tmp_path_factory.mktemp("both")
    for parent in (OLD, NEW):
        write_profile(folder / parent, dataclasses.replace(toy_profile, parent=parent))
    return folder


@pytest.fixture(autouse=True)
def quick(both: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Arrays are copied: a forked child may not run the programs that make them."""

    def encode(profile: Profile, folder: Path) -> StoredProfile:
        source = both / str(profile.parent)
        for file in source.glob("*.exr"):
            shutil.copy(file, folder)
        return read_stored(source)

    monkeypatch.setattr(store, "encode", encode)


@pytest.fixture(params=["exchanged", "renamed"])
def way(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """With a system and a disk that let names change places at once, and without."""
    if request.param == "renamed":
        monkeypatch.setattr(whole_folder, "_exchange", lambda new, path: False)
    return request.param


def killed_at(step: int, work: Callable[[], None], place: Path) -> bool:
    """Do the work in a child process that ends before its step of that number; whether it got as far."""
    child = os.fork()
    if child == 0:
        left = step

        def count(event: str, arguments: tuple[object, ...]) -> None:
            nonlocal left
            concerns = event == "ctypes.dlsym" or str(place) in str(arguments[:1])
            if event in STEPS and concerns and (event != "open" or arguments[1] != "r"):
                left -= 1
                if left < 0:
                    os._exit(KILLED)

        sys.addaudithook(count)
        try:
            work()
        finally:
            os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == KILLED


def rounds(work: Callable[[], None], place: Path, prepare: Callable[[], None]) -> Iterator[int]:
    """Each step at which the work can be ended; afterwards what it left lies in ``place``."""
    for step in range(1000):
        shutil.rmtree(place, ignore_errors=True)
        place.mkdir()
        prepare()
        if not killed_at(step, work, place):
            return
        yield step


@pytest.mark.parametrize("name", ["p", "p.zip"])
@pytest.mark.medium
def test_a_killed_writer_leaves_the_old_profile_or_the_new(
    tmp_path: Path, toy_profile: Profile, way: str, name: str
) -> None:
    old, new = (dataclasses.replace(toy_profile, parent=parent) for parent in (OLD, NEW))
    place = tmp_path / "place"
    path, found, leftovers = place / name, [], 0

    for step in rounds(lambda: write_profile(path, new), place, lambda: write_profile(path, old)):
        found.append(read_profile(find_profile(path)).parent)
        leftovers += len(list(place.iterdir())) > 1
        if step % 3 == 0:  # by turns, as it takes time
            write_profile(path, new)
            assert read_profile(path).parent == NEW
            assert [item.name for item in place.iterdir()] == [name]
    assert found == sorted(found)  # first the old one, at last the new one
    assert set(found) == {OLD, NEW}
    assert len(found) > 12
    assert leftovers > 5


@pytest.mark.medium
def test_a_killed_first_write_leaves_none_or_the_whole(tmp_path: Path, toy_profile: Profile) -> None:
    new = dataclasses.replace(toy_profile, parent=NEW)
    place, found = tmp_path / "place", []
    for _ in rounds(lambda: write_profile(place / "p", new), place, lambda: None):
        found.append((place / "p").exists())
        if found[-1]:
            assert read_profile(place / "p").parent == NEW
    assert not found[0]
    write_profile(place / "p", new)
    assert [item.name for item in place.iterdir()] == ["p"]


@pytest.mark.medium
def test_a_reader_beside_a_writer_finds_one_or_the_other(tmp_path: Path, toy_profile: Profile, way: str) -> None:
    profiles = [dataclasses.replace(toy_profile, parent=parent) for parent in (OLD, NEW)]
    write_profile(tmp_path / "p", profiles[0])
    done = threading.Event()

    def replace_often() -> None:
        for number in range(40):
            write_profile(tmp_path / "p", profiles[number % 2])
        done.set()

    writer = threading.Thread(target=replace_often)
    writer.start()
    found = {read_profile(tmp_path / "p").parent for _ in iter(done.is_set, True)}
    writer.join()
    assert found == {OLD, NEW}


def test_writers_beside_each_other_do_not_remove_each_others_work(tmp_path: Path, toy_profile: Profile) -> None:
    failed: list[BaseException] = []

    def write(name: str) -> None:
        try:
            for _ in range(10):
                write_profile(tmp_path / name, dataclasses.replace(toy_profile, parent=NEW))
        except BaseException as error:
            failed.append(error)

    writers = [threading.Thread(target=write, args=(name,)) for name in ("p", "p", "q")]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
    assert failed == []
    assert sorted(item.name for item in tmp_path.iterdir()) == ["p", "q"]


def test_nothing_but_leftovers_is_cleaned_up(tmp_path: Path, toy_profile: Profile) -> None:
    kept = [".p-0123456789ab.partial.png", ".q-0123456789ab.partial", ".p-mine.partial", ".p-0123456789ab.oldest"]
    gone = [".p-0123456789ab.partial", ".p-0123456789ab.old"]
    write_profile(tmp_path / "p", dataclasses.replace(toy_profile, parent=OLD))
    for name in (*kept, *gone):
        (tmp_path / name).mkdir()
    write_profile(tmp_path / "p", dataclasses.replace(toy_profile, parent=NEW))
    assert sorted(item.name for item in tmp_path.iterdir()) == sorted(["p", *kept])


def test_the_names_are_on_disk_before_the_old_profile_is_removed(
    tmp_path: Path, toy_profile: Profile, way: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_profile(tmp_path / "p", dataclasses.replace(toy_profile, parent=OLD))
    events: list[str] = []
    sync, remove = os.fsync, shutil.rmtree

    def fsync(descriptor: int) -> None:
        if os.fstat(descriptor).st_ino == tmp_path.stat().st_ino:
            events.append(f"folder with {read_stored(tmp_path / 'p').lineage.parent}")
        sync(descriptor)

    def rmtree(path: Path, ignore_errors: bool) -> None:
        events.append("removed")
        remove(path, ignore_errors)

    monkeypatch.setattr(os, "fsync", fsync)
    monkeypatch.setattr(shutil, "rmtree", rmtree)
    write_profile(tmp_path / "p", dataclasses.replace(toy_profile, parent=NEW))
    assert events == [f"folder with {NEW}", "removed"]


def test_a_refused_exchange_leaves_the_old_profile(
    tmp_path: Path, toy_profile: Profile, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_profile(tmp_path / "p", dataclasses.replace(toy_profile, parent=OLD))
    monkeypatch.setattr(whole_folder, "_exchange", lambda new, path: False)
    real = os.replace

    def replace(source: Path, target: Path) -> None:
        if source.suffix == ".partial":
            raise OSError(13, "Permission denied")
        real(source, target)

    monkeypatch.setattr(os, "replace", replace)
    with pytest.raises(OSError, match="Permission denied"):
        write_profile(tmp_path / "p", dataclasses.replace(toy_profile, parent=NEW))
    assert read_profile(tmp_path / "p").parent == OLD
    assert [item.name for item in tmp_path.iterdir()] == ["p"]


def test_a_link_to_a_profile_is_replaced_and_not_followed(tmp_path: Path, toy_profile: Profile, way: str) -> None:
    write_profile(tmp_path / "mine", dataclasses.replace(toy_profile, parent=OLD))
    (tmp_path / "p").symlink_to(tmp_path / "mine")
    write_profile(tmp_path / "p", dataclasses.replace(toy_profile, parent=NEW))
    assert [read_profile(tmp_path / name).parent for name in ("mine", "p")] == [OLD, NEW]
    assert sorted(item.name for item in tmp_path.iterdir()) == ["mine", "p"]


@pytest.mark.parametrize("name", [PROFILE_NAME, "psf_residual.exr"])
def test_links_in_a_profile_are_not_read(tmp_path: Path, toy_profile: Profile, name: str) -> None:
    write_profile(tmp_path / "p", dataclasses.replace(toy_profile, parent=OLD))
    (tmp_path / "p" / name).rename(tmp_path / name)
    (tmp_path / "p" / name).symlink_to(tmp_path / name)
    with pytest.raises(ProfileError, match="found none"):
        read_profile(tmp_path / "p")


@pytest.mark.parametrize("left_as", [".p-0123456789ab.old", "p"])
def test_a_profile_replaced_during_reading_is_read_anew(tmp_path: Path, left_as: str) -> None:
    """The folder that reading began with is gone before its end, wherever it stood."""
    old, new = tmp_path / left_as, tmp_path / "p"
    old.mkdir()
    read: list[Path] = []

    def replaced_meanwhile(place: Path) -> Path:
        read.append(place)
        if len(read) == 1:
            shutil.rmtree(place)
            new.mkdir()
            raise FileNotFoundError(place)
        return place

    assert whole_folder.read_standing(new, replaced_meanwhile) == new
    assert read == [old, new]


def test_a_profile_that_nobody_replaces_is_read_once(tmp_path: Path) -> None:
    read: list[Path] = []

    def damaged(place: Path) -> Path:
        read.append(place)
        raise ProfileError("Expected a profile, found none.")

    for path in (tmp_path, tmp_path / "missing"):
        with pytest.raises(ProfileError):
            whole_folder.read_standing(path, damaged)
    assert read == [tmp_path, tmp_path / "missing"]
