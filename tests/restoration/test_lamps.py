"""Lamps many times beyond the range: their light, the picture beside them, and what is no lamp."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from tests.scenes.grid_blur import blurred
from udccal.cfa import PATTERNS, Cfa
from udccal.restoration.filter_tables import filter_tables
from udccal.restoration.kernel_grid import KernelGrid
from udccal.restoration.lamp_fit import Responses, lamp_light
from udccal.restoration.lamp_pieces import lamp_pieces
from udccal.restoration.lamps import LampFinder, WithoutLamps
from udccal.restoration.mosaic_filter import filtered_and_joined
from udccal.restoration.plan import PlanOptions
from udccal.restoration.sharpen import Sharpener
from udccal.restoration.shrink import measured_noise
from udccal.restoration.tiles import layout_for
from udccal.rig import RigDescription
from udccal.tiers import Tier

ROWS, COLUMNS, RANGE_E, NOISE_E, SCENE_E = 216, 200, 8000.0, 50.0, 2500.0
LAMP = np.s_[100:107, 90:97]
# Around the lamp, where its halo is; the lamp itself with its rim is left out.
BESIDE = np.s_[60:150, 80:110]


@cache
def finder(name: str = "RGGB") -> LampFinder:
    """A kernel with a core, and a tail down the columns that holds a fifth of its light."""
    y, x = np.mgrid[-40:41, -8:9]
    kernel = np.exp(-(x**2) / 1.5 - y**2 / 3.0)
    tail = np.exp(-(x**2) / 1.5 - np.abs(y) / 12.0)
    kernel = 0.8 * kernel / kernel.sum() + 0.2 * tail / tail.sum()
    grid = KernelGrid(np.zeros(1), np.zeros(1), np.stack([kernel] * 3)[None, None].astype(np.float32))
    cfa = PATTERNS[name]
    layout = layout_for(ROWS, COLUMNS, (cfa.rows, cfa.columns), (192, 160), (0, ROWS))
    return LampFinder(grid, layout, filter_tables(grid, layout, cfa, 2), cfa, 24)


def scene() -> np.ndarray:
    """Waves and a step, in all colours."""
    y, x = np.mgrid[:ROWS, :COLUMNS]
    wave, shift = np.random.default_rng(0).uniform(6.0, 12.0, 2)
    light = SCENE_E * (1 + 0.2 * np.sin(x / wave + y / shift) + 0.3 * (y > 130))
    return np.stack([light, 0.9 * light, 0.7 * light], axis=-1)


def lit(light_e: tuple[float, float, float], where: tuple[slice, slice] = LAMP) -> np.ndarray:
    light = scene()
    light[where] = light_e
    return light


def mosaic_of(light: np.ndarray, cfa: Cfa) -> np.ndarray:
    planes = np.stack([blurred(finder().grid, channel, light[..., channel]) for channel in range(3)], axis=-1)
    own = np.take_along_axis(planes, cfa.channel_map(ROWS, COLUMNS)[..., None], axis=2)[..., 0]
    return (own + np.random.default_rng(1).normal(0, NOISE_E, own.shape)).astype(np.float32)


def noise_of(of: LampFinder) -> np.ndarray:
    return np.full((of.layout.count, 3), NOISE_E, np.float32)


def taken_off(light: np.ndarray, of: LampFinder | None = None) -> tuple[WithoutLamps, np.ndarray, np.ndarray]:
    """The frame without its lamps, the frame, and the samples that clip."""
    of = of or finder()
    whole = mosaic_of(light, of.cfa)
    clipped = whole >= RANGE_E
    seen = np.minimum(whole, np.float32(RANGE_E))
    return of.without(seen, noise_of(of), clipped), seen, clipped


def halo_left(found: WithoutLamps, of: LampFinder) -> float:
    """RMS of what the samples beside the lamp have more than those of the scene without it."""
    rest = (found.signal_e - mosaic_of(scene(), of.cfa))[BESIDE]
    rest[LAMP[0].start - 66 : LAMP[0].stop - 54, 4:23] = 0
    return float(np.sqrt(np.mean(rest**2)))


@pytest.mark.parametrize("name", ["RGGB", "mono"])
def test_the_halo_of_a_lamp_is_taken_off(name: str) -> None:
    of = finder(name)
    found, seen, clipped = taken_off(lit((2.4e5, 2.0e5, 1.5e5)), of)
    assert found.white_e is not None
    before = halo_left(WithoutLamps(seen, clipped, None), of)
    assert halo_left(found, of) < before / 8
    assert not found.clipped.any()
    # The lamp is white where it is, and nowhere else.
    assert found.white_e[LAMP][2:5, 2:5].min() >= 0.99 * RANGE_E
    assert found.white_e[:90].max() == found.white_e[120:].max() == 0.0


def test_a_lamp_is_put_back_white_and_the_picture_beside_it_is_clean() -> None:
    of = finder()
    found, seen, _ = taken_off(lit((2.4e5, 2.0e5, 1.5e5)))
    pictures = [
        filtered_and_joined(of.layout.tiles(each), noise_of(of), of.tables, of.layout, of.cfa)[0]
        for each in (seen, found.signal_e)
    ]
    errors = [(each - scene())[BESIDE][:34] for each in pictures]
    assert np.abs(errors[1]).mean() < np.abs(errors[0]).mean() / 3
    back = found.put_back(pictures[1], of.layout.inner)
    np.testing.assert_array_equal(back[:90], pictures[1][:90])
    assert back[LAMP][3, 3].min() >= 0.99 * RANGE_E


@pytest.mark.medium
def test_the_tier_accurate_takes_lamps_off_and_no_other(toy_rig: RigDescription) -> None:
    of = finder()
    rig = toy_rig.model_copy(update={"camera": toy_rig.camera.model_copy(update={"rows": ROWS, "columns": COLUMNS})})
    noise = measured_noise(of.tables, of.layout, of.cfa, 2)
    whole = mosaic_of(lit((2.4e5, 2.0e5, 1.5e5)), of.cfa)
    given = np.minimum(whole, np.float32(RANGE_E)), np.full_like(whole, NOISE_E**2), whole >= RANGE_E

    def error(tier: Tier, lamps: int) -> float:
        options = PlanOptions(lamps=lamps, network_views=1)
        picture = Sharpener(tier, of.grid, rig, of.layout, of.tables, noise, options).apply(*given)
        return float(np.abs(picture - scene())[BESIDE][:34].mean())

    assert error(Tier.accurate, 24) < error(Tier.accurate, 0) / 3
    assert error(Tier.balanced, 24) == error(Tier.balanced, 0)


def test_lamps_whose_halos_overlap_are_told_apart() -> None:
    light = lit((2.4e5, 2.0e5, 1.5e5))
    light[70:76, 92:98] = 1.2e5
    found, seen, clipped = taken_off(light)
    assert found.white_e is not None
    assert min(found.white_e[LAMP].max(), found.white_e[70:76, 92:98].max()) > 0.9 * RANGE_E
    of = finder()
    beside = np.s_[110:140, 86:102]
    left, before = (
        float(np.sqrt(np.mean((each - mosaic_of(scene(), of.cfa))[beside] ** 2))) for each in (found.signal_e, seen)
    )
    assert clipped.any()
    assert left < before / 5


def test_a_halo_that_reaches_beyond_the_lamps_tile_is_taken_off_there_too() -> None:
    rows, cfa, y = 420, PATTERNS["RGGB"], np.abs(np.arange(-120, 121.0))[:, None]
    kernel = np.exp(-(np.arange(-8, 9.0) ** 2) / 1.5) * (np.exp(-(y**2) / 3.0) + 0.02 * np.exp(-y / 60.0))
    grid = KernelGrid(np.zeros(1), np.zeros(1), np.stack([kernel / kernel.sum()] * 3)[None, None].astype(np.float32))
    layout = layout_for(rows, COLUMNS, (2, 2), (192, 160), (0, rows))
    of = LampFinder(grid, layout, filter_tables(grid, layout, cfa, 2), cfa, 4)
    light = np.full((rows, COLUMNS), SCENE_E)
    light[205:212, 90:97] = 2.4e5
    whole = (blurred(grid, 0, light) + np.random.default_rng(2).normal(0, NOISE_E, light.shape)).astype(np.float32)
    found = of.without(np.minimum(whole, np.float32(RANGE_E)), noise_of(of), whole >= RANGE_E)
    assert found.white_e is not None
    for beyond in (np.s_[205 - 110 : 205 - 96, 90:97], np.s_[212 + 96 : 212 + 110, 90:97]):
        before, after = (float(np.mean(each[beyond])) - SCENE_E for each in (whole, found.signal_e))
        assert before > 3 * NOISE_E
        assert abs(after) < before / 5


@pytest.mark.parametrize(
    ("light", "where"),
    [
        pytest.param(1.5e4, LAMP, id="hardly beyond the range"),
        pytest.param(4e4, np.s_[70:130, 60:120], id="a window"),
        pytest.param(2.5e4, np.s_[60:160, 95:96], id="a line along the halo"),
        pytest.param(2.4e5, np.s_[100:102, 90:92], id="too small"),
    ],
)
def test_what_is_no_lamp_stays_as_it_is(light: float, where: tuple[slice, slice]) -> None:
    found, seen, clipped = taken_off(lit((light, light, light), where))
    assert found.white_e is None
    np.testing.assert_array_equal(found.signal_e, seen)
    np.testing.assert_array_equal(found.clipped, clipped)


def test_light_of_one_colour_is_no_lamp() -> None:
    found, seen, _ = taken_off(lit((2.4e5, 1e4, 1e4)))
    np.testing.assert_array_equal(found.signal_e, seen)


def test_a_range_that_the_panel_alone_fills_tells_nothing_of_a_lamp() -> None:
    of, signal = finder(), np.zeros((ROWS, COLUMNS), np.float32)
    clipped = np.zeros(signal.shape, dtype=bool)
    clipped[LAMP], signal[LAMP] = True, -100.0
    found = of.without(signal, noise_of(of), clipped)
    np.testing.assert_array_equal(found.signal_e, signal)


def test_no_piece_is_tried_where_none_is_asked_for_nor_in_a_frame_smaller_than_a_tile() -> None:
    of, clipped = finder(), np.zeros((ROWS, COLUMNS), dtype=bool)
    clipped[LAMP] = True
    assert len(lamp_pieces(clipped, of.layout, 1, 129)) == 1
    assert lamp_pieces(clipped, of.layout, 0, 129) == []
    assert lamp_pieces(clipped[: of.layout.rows - 2], of.layout, 1, 129) == []


def test_the_largest_pieces_are_tried_and_lie_in_tiles_of_their_own() -> None:
    of, clipped = finder(), np.zeros((ROWS, COLUMNS), dtype=bool)
    for size, (y, x) in ((6, (4, 6)), (8, (100, 90)), (7, (200, 180))):
        clipped[y : y + size, x : x + size] = True
    found = lamp_pieces(clipped, of.layout, 2, 129)
    assert [piece.area for piece in found] == [64, 49]
    for piece in found:
        assert piece.tile[0].stop <= ROWS
        assert piece.tile[1].stop <= COLUMNS
        assert piece.tile[0].start % 2 == piece.tile[1].start % 2 == 0
        own = np.zeros_like(clipped)
        own[piece.tile] = piece.own
        assert np.count_nonzero(own & clipped) == piece.area


@pytest.mark.parametrize("name", ["RGGB", "mono"])
def test_responses_are_the_same_at_every_cell(name: str) -> None:
    of = finder(name)
    size = of.layout.rows, of.layout.columns
    responses = Responses.of(of.tables.at(0), np.float32(16), of.grid.kernels[0, 0], of.cfa, size)
    rng = np.random.default_rng(5)
    places = rng.integers(0, size, (6, 2)).T
    to = places[0, :3], places[1, :3]
    source = places[0, 3:], places[1, 3:]
    found = responses.between(responses.to_sample, to, source)
    for index in range(3):
        one = np.zeros(size)
        one[source[0][index], source[1][index]] = 1.0
        np.testing.assert_allclose(found[:, index], responses.precision(one)[to], atol=1e-14)


def test_the_light_found_is_the_least_of_the_cost_over_light_and_hidden_samples() -> None:
    """At the solution no hidden sample, and no light that is not 0, changes the cost to first order."""
    of = finder()
    size = of.layout.rows, of.layout.columns
    responses = Responses.of(of.tables.at(0), np.float32(16), of.grid.kernels[0, 0], of.cfa, size)
    rng = np.random.default_rng(7)
    lamp, hidden = np.zeros(size, dtype=bool), np.zeros(size, dtype=bool)
    lamp[60:63, 50:54], hidden[56:67, 46:58] = True, True
    light = np.zeros((3, *size))
    light[:, lamp] = rng.uniform(4e3, 18e3, (3, 12))
    samples = responses.blurred(light) + rng.normal(size=size)
    samples[hidden] = 1e6  # says nothing: no light is too much for these
    start = np.full((3, 12), 2e3)
    found = lamp_light(samples, np.zeros(size), hidden, ~lamp, lamp, start, responses)
    lit_up = np.zeros_like(light)
    lit_up[:, lamp] = found.light
    halo = responses.blurred(light)
    assert np.abs(responses.blurred(lit_up) - halo)[~hidden].max() < 0.1 * halo[~hidden].max()
    rest = samples - responses.blurred(lit_up)
    rest[hidden] = found.hidden
    answer = responses.precision(rest)
    assert np.abs(answer[hidden]).max() < 1e-5 * np.abs(answer[~hidden]).max()
    slope = responses.gathered(answer)[:, lamp]
    scale = np.abs(responses.gathered(responses.precision(samples * ~hidden))[:, lamp]).max()
    assert np.abs(slope[found.light > 0]).max() < 1e-3 * scale
    assert found.evidence > 1e3
