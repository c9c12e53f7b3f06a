from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.benchmarks.efficiency.trials import Trials, column, figure, table, write_json

_COUNT = 2000


def _draw(
    spread: float = 1.0, offset: float = 0.0, claimed: float = 1.0, places: int = 1, shared: float = 0.0
) -> Trials:
    rng = np.random.default_rng(7)
    common, own = rng.standard_normal((_COUNT, 1)), rng.standard_normal((_COUNT, places))
    error = offset + spread * (np.sqrt(shared) * common + np.sqrt(1 - shared) * own)
    return Trials("a", error, np.full(error.shape, claimed), np.ones(error.shape))


def test_an_efficient_and_honest_fit_passes() -> None:
    found = figure(_draw())
    assert found.ok
    assert found.efficiency == pytest.approx(1.0, abs=0.1)
    assert found.efficiency_error == pytest.approx(np.sqrt(2 / _COUNT), rel=0.2)


@pytest.mark.parametrize(
    "bad",
    [
        _draw(spread=1.15, claimed=1.15),  # honest, but 30 % above the bound
        _draw(offset=0.3),  # biased
        _draw(claimed=0.8),  # sigma too small
        _draw(claimed=1.3),  # sigma too large
        Trials("nan", np.full((9, 1), np.nan), np.ones((9, 1)), np.ones((9, 1))),
    ],
)
def test_a_wasteful_biased_or_dishonest_fit_does_not(bad: Trials) -> None:
    assert not figure(bad).ok


def test_one_fit_that_is_far_off_does_not_hide_in_the_standard_errors_that_it_widens() -> None:
    sound = _draw()
    sound.error[7] = 30.0
    assert not figure(sound).ok
    assert figure(sound).z_worst == 30.0


def test_places_that_share_their_noise_do_not_count_as_many() -> None:
    alone, apart = figure(_draw(places=50, shared=0.99)), figure(_draw(places=50))
    assert alone.efficiency_error > 5 * apart.efficiency_error


def test_realisations_that_share_a_truth_do_not_count_as_many() -> None:
    rng = np.random.default_rng(3)
    truth = np.repeat(np.arange(20), 100)
    error = (rng.standard_normal(20)[truth] + 0.1 * rng.standard_normal(2000))[:, None]
    alike = Trials("a", error, np.ones_like(error), np.ones_like(error))
    counted, apart = figure(replace(alike, truth=truth)), figure(alike)
    assert (counted.truths, apart.truths) == (20, 2000)
    assert counted.efficiency_error > 5 * apart.efficiency_error
    with pytest.raises(ValueError, match="several truths"):
        figure(replace(alike, truth=np.zeros(2000, dtype=int)))


def test_what_users_get_is_of_all_data() -> None:
    """A fit of every tenth sample is efficient for these, and has a tenth of all information."""
    tenth = _draw()
    found = figure(replace(tenth, bound_of_all=tenth.bound / np.sqrt(10)))
    assert found.ok
    assert found.of_all == pytest.approx(found.efficiency / 10)
    assert figure(tenth).of_all == figure(tenth).efficiency
    unknown = figure(replace(tenth, bound_of_all=np.full_like(tenth.bound, np.nan)))
    assert unknown.of_all is None
    assert "| – |" in table([unknown])


def test_table_and_file_show_what_was_missed(tmp_path: Path) -> None:
    figures = [figure(_draw()), figure(column("b", [5.0, 6.0, 5.0], [1.0, 1.0, 1.0], 1.0))]
    assert table(figures).count("**missed**") == 1
    write_json(figures, tmp_path / "efficiency.json")
    kept = json.loads((tmp_path / "efficiency.json").read_text())
    names = ["efficiency", "efficiency_error", "name", "of_all", "ok", "truths", "z_mean", "z_std", "z_worst"]
    assert [sorted(one) for one in kept] == [names] * 2
    assert [one["ok"] for one in kept] == [True, False]
