from __future__ import annotations

import numpy as np

from tests.benchmarks.pareto import TierResult, judged
from tests.benchmarks.pictures import Score
from udccal.tiers import Tier

EMPTY = np.zeros((1, 1, 3), np.float32)


def result(tier: Tier, *after_dB: float) -> TierResult:
    scores = tuple(Score(str(i), 20.0, dB, 0.5, 0.9, 1.0, EMPTY, EMPTY, EMPTY) for i, dB in enumerate(after_dB))
    return TierResult(tier, 1.0, 1.0, 1.0, scores)


def test_tiers_in_their_order_pass() -> None:
    rows = judged([result(Tier.preview, 25, 26), result(Tier.fast, 30, 29), result(Tier.balanced, 31, 31)])
    assert len(rows) == 4
    assert all(row.ok for row in rows)


def test_a_tier_that_spoils_one_scene_or_gains_nothing_is_told() -> None:
    rows = judged([result(Tier.preview, 25, 26), result(Tier.fast, 33, 25), result(Tier.balanced, 28, 29)])
    assert [row.ok for row in rows] == [True, False, False, True]
