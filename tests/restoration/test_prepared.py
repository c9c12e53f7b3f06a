"""What is kept between starts is read again, and is made anew whenever it may not be right."""

from __future__ import annotations

import hashlib
import io
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from jaxtyping import Float32, Int

from udccal.restoration import frame_time, prepared
from udccal.restoration.frame_time import PartTimes, part_times
from udccal.restoration.plan import PlanOptions
from udccal.restoration.prepared import kept, prepared_bytes, prepared_folder

_OPTIONS = PlanOptions(grid_rows=2, grid_columns=2, tile_rows=96, tile_columns=128)


@dataclass(frozen=True)
class Pair:
    """Some arrays."""

    values: Float32[np.ndarray, "n 2"]
    places: Int[np.ndarray, " n"]


def pair(value: float) -> Pair:
    return Pair(np.full((500, 2), value, np.float32), np.arange(500))


class Maker:
    """Makes pairs, and counts them."""

    def __init__(self) -> None:
        self.made = 0

    def __call__(self) -> Pair:
        self.made += 1
        return pair(float(self.made))


def entry(folder: Path) -> Path:
    (path,) = folder.iterdir()
    return path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "kept"


def test_an_entry_is_read_again(folder: Path) -> None:
    make = Maker()
    first = kept(folder, Pair, (1, "a"), make)
    again = kept(folder, Pair, (1, "a"), make)
    assert make.made == 1
    assert np.array_equal(first.values, again.values)
    assert np.array_equal(first.places, again.places)
    assert folder.stat().st_mode & 0o077 == 0
    assert prepared_bytes(folder) == entry(folder).stat().st_size > first.values.nbytes + first.places.nbytes


def test_times_are_those_of_a_processor_with_so_many_cores(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A cache folder may be shared by computers."""
    monkeypatch.setattr(frame_time, "_measured", lambda options: PartTimes(*(np.array(1e-8) for _ in range(10))))
    part_times(_OPTIONS, folder)
    part_times(_OPTIONS, folder)
    assert len(list(folder.iterdir())) == 1
    monkeypatch.setattr("os.cpu_count", lambda: 1000)
    part_times(_OPTIONS, folder)
    monkeypatch.setattr(frame_time, "processor_key", lambda: "another")
    part_times(_OPTIONS, folder)
    assert len(list(folder.iterdir())) == 3


def test_without_a_folder_nothing_is_kept() -> None:
    make = Maker()
    kept(None, Pair, (1,), make)
    kept(None, Pair, (1,), make)
    assert make.made == 2


@pytest.mark.parametrize(
    "other",
    [
        (1, "a", np.zeros(3), _OPTIONS),
        (1.0, "a", np.zeros(2), _OPTIONS),
        (1, "b", np.zeros(2), _OPTIONS),
        (1, "a", np.zeros((2, 1)), _OPTIONS),
        (1, "a", np.full(2, 1e-30), _OPTIONS),
        (1, "a", np.zeros(2), replace(_OPTIONS, grid_rows=3)),
        (1, ("a", np.zeros(2)), _OPTIONS),
    ],
)
def test_whatever_differs_is_made_anew(folder: Path, other: tuple[object, ...]) -> None:
    make = Maker()
    kept(folder, Pair, (1, "a", np.zeros(2), _OPTIONS), make)
    kept(folder, Pair, other, make)
    assert make.made == 2


def test_other_code_makes_anew(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make = Maker()
    kept(folder, Pair, (1,), make)
    monkeypatch.setattr(prepared, "_code", lambda: "changed")
    kept(folder, Pair, (1,), make)
    assert make.made == 2


def test_the_precision_of_equal_numbers_does_not_matter(folder: Path) -> None:
    make = Maker()
    kept(folder, Pair, (np.float32([0.5, 2.0]),), make)
    kept(folder, Pair, (np.float64([0.5, 2.0]),), make)
    assert make.made == 1


def test_what_has_no_bytes_of_its_own_is_refused(folder: Path) -> None:
    with pytest.raises(TypeError, match="expected a number"):
        kept(folder, Pair, (object(),), Maker())


def sealed(content: bytes) -> Callable[[bytes], bytes]:
    """An entry with a right checksum."""
    return lambda _: hashlib.sha256(content).digest() + content


def forged(*arrays: np.ndarray) -> Callable[[bytes], bytes]:
    stream = io.BytesIO()
    for array in arrays:
        np.save(stream, array)
    return sealed(stream.getvalue())


def without_samples(rows: int) -> bytes:
    """The header of an array of so many rows."""
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": "<f4", "fortran_order": False, "shape": (rows, 2)})
    return stream.getvalue()


GOOD = pair(9.0)
DAMAGES: dict[str, Callable[[bytes], bytes]] = {
    "empty": lambda _: b"",
    "cut": lambda found: found[: len(found) // 2],
    "cut in the checksum": lambda found: found[:10],
    "one bit": lambda found: found[:1000] + bytes([found[1000] ^ 1]) + found[1001:],
    "one bit of a header": lambda found: found[:80] + bytes([found[80] ^ 4]) + found[81:],
    "foreign": lambda _: b"PK\x03\x04 something else entirely" * 100,
    "an array too few": forged(GOOD.values),
    "another type": forged(GOOD.values.astype(np.float64), GOOD.places),
    "another number of axes": forged(GOOD.values[0], GOOD.places),
    "another size": forged(GOOD.values[:, :1], GOOD.places),
    "sizes that disagree": forged(GOOD.values, GOOD.places[:-1]),
    "more than any memory": sealed(without_samples(2**50)),
    "a zip file": sealed(b"PK\x03\x04" + bytes(100)),
    "not a number": forged(GOOD.values * np.float32(np.nan), GOOD.places),
}


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
def test_a_damaged_entry_is_made_anew(folder: Path, damage: Callable[[bytes], bytes]) -> None:
    make = Maker()
    kept(folder, Pair, (1,), make)
    path = entry(folder)
    path.write_bytes(damage(path.read_bytes()))
    assert kept(folder, Pair, (1,), make).values[0, 0] == 2.0
    assert kept(folder, Pair, (1,), make).values[0, 0] == 2.0
    assert make.made == 2


def test_an_entry_that_runs_code_is_not_run(folder: Path) -> None:
    kept(folder, Pair, (1,), Maker())
    stream, ran = io.BytesIO(), folder / "ran"

    class Trap:
        def __reduce__(self) -> tuple[object, tuple[str]]:
            return os.mkdir, (str(ran),)

    np.save(stream, np.array([Trap()], dtype=object), allow_pickle=True)
    entry(folder).write_bytes(hashlib.sha256(stream.getvalue()).digest() + stream.getvalue())
    make = Maker()
    kept(folder, Pair, (1,), make)
    assert make.made == 1
    assert not ran.exists()


def test_a_forged_entry_of_right_arrays_would_be_read(folder: Path) -> None:
    """So the refusals above are of what they name."""
    kept(folder, Pair, (1,), Maker())
    entry(folder).write_bytes(forged(GOOD.values, GOOD.places)(b""))
    assert kept(folder, Pair, (1,), Maker()).values[0, 0] == 9.0


def test_the_oldest_use_goes_first(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kept(folder, Pair, (0,), Maker())
    size = prepared_bytes(folder)
    monkeypatch.setattr(prepared, "_MOST_BYTES", 3 * size)
    kept(folder, Pair, (1,), Maker())
    (folder / ".left-by-a-killed-program.partial.prepared").write_bytes(bytes(size))
    for index, path in enumerate(sorted(folder.iterdir(), key=lambda path: (path.name.startswith("Pair"), path.name))):
        os.utime(path, (index, index))
    oldest, youngest = sorted(folder.glob("Pair*"), key=lambda path: path.stat().st_mtime)
    first = (0,) if str(prepared._key(Pair, (0,))) in oldest.name else (1,)
    kept(folder, Pair, first, Maker())  # is used, and so is the youngest now
    kept(folder, Pair, (2,), Maker())
    assert prepared_bytes(folder) == 3 * size
    kept(folder, Pair, (3,), Maker())
    left = {path.name for path in folder.iterdir()}
    assert len(left) == 3
    assert oldest.name in left
    assert youngest.name not in left


def test_many_at_once_find_whole_entries(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kept(folder, Pair, (0,), lambda: pair(0.0))
    monkeypatch.setattr(prepared, "_MOST_BYTES", 3 * prepared_bytes(folder))

    def one(turn: int) -> bool:
        value = turn % 5
        return float(kept(folder, Pair, (value,), lambda: pair(float(value))).values[7, 1]) == value

    with ThreadPoolExecutor(8) as pool:
        assert all(pool.map(one, range(200)))
    assert len(list(folder.iterdir())) <= 3


def test_what_alone_is_too_large_is_not_kept(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(prepared, "_MOST_BYTES", 1000)
    assert kept(folder, Pair, (1,), Maker()).values[0, 0] == 1.0
    assert prepared_bytes(folder) == 0


def test_a_folder_that_cannot_be_made_costs_time_only(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    assert kept(tmp_path / "file" / "kept", Pair, (1,), Maker()).values[0, 0] == 1.0
    assert prepared_bytes(tmp_path / "absent") == 0


def test_a_full_disk_costs_time_only(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "save", full)
    assert kept(folder, Pair, (1,), Maker()).values[0, 0] == 1.0
    assert list(folder.iterdir()) == []


def test_a_folder_that_others_may_write_is_not_read(folder: Path) -> None:
    make = Maker()
    kept(folder, Pair, (1,), make)
    folder.chmod(0o777)
    kept(folder, Pair, (1,), make)
    assert make.made == 2


def test_the_folder_is_beside_the_compilations(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("UDCCAL_COMPILATIONS", str(tmp_path))
    assert prepared_folder() == tmp_path / "prepared"
