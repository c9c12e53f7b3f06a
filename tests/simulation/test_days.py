"""The same simulated rig on another day: other noise, the same specimen."""

from __future__ import annotations

import numpy as np

from tests.simulation.toy import toy_rig
from udccal.arrangements import FlatLight
from udccal.benches.bench import simulated_bench, simulated_rig
from udccal.cameras.protocol import Region, Settings


def test_another_noise_seed_is_the_same_rig_on_another_day() -> None:
    one, other, again = (simulated_rig(toy_rig(), 3, noise_seed) for noise_seed in (None, 4, 3))
    region = Region(0, 0, 128, 96)
    frames = []
    for world in (one, other, again):
        world.arrange(FlatLight())
        frames.append(world.develop(world.expected_rate(region), Settings(8e-3, 0.0, region), 0))
    assert np.array_equal(one.expected_rate(region), other.expected_rate(region))
    assert np.array_equal(frames[0], frames[2])
    assert not np.array_equal(frames[0], frames[1])
    with simulated_bench(one) as first, simulated_bench(other) as second:
        assert first.camera.identity == second.camera.identity
