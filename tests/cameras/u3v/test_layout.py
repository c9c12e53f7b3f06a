from __future__ import annotations

import pytest

from udccal.cameras.u3v.layout import StreamLayout, plan_layout
from udccal.errors import CameraProtocolError

MIB = 1 << 20


def test_full_frame_of_twelve_bits_packed() -> None:
    assert plan_layout(4718592, 52, 32, 1024) == StreamLayout(1024, 1024, 4718592, MIB, 4, 524288, 0)


@pytest.mark.parametrize("payload", [1, 1023, 1024, 1025, MIB - 1, MIB, MIB + 1, 3 * MIB, 6_291_500, 1 << 28])
@pytest.mark.parametrize("alignment", [1, 4, 512, 1024, 4096, 1 << 20])
def test_transfers_hold_the_payload_and_are_aligned(payload: int, alignment: int) -> None:
    layout = plan_layout(payload, 52, 36, alignment)
    assert payload <= sum(layout.transfers) < payload + alignment
    assert all(size % alignment == 0 for size in (*layout.transfers, layout.leader, layout.trailer))
    assert max(layout.transfers) <= MIB
    assert 0 not in layout.transfers
    assert layout.leader >= 52
    assert layout.trailer >= 36


def test_required_sizes_of_zero_still_hold_leader_and_trailer() -> None:
    layout = plan_layout(100, 0, 0, 512)
    assert (layout.leader, layout.trailer) == (512, 512)


@pytest.mark.parametrize(
    ("payload", "leader", "trailer"),
    [(0, 52, 32), (-1, 52, 32), ((1 << 28) + 1, 52, 32), (9, 1 << 31, 32), (9, 52, 65537)],
)
def test_refuses_sizes_out_of_all_reason(payload: int, leader: int, trailer: int) -> None:
    with pytest.raises(CameraProtocolError, match=r"Expected .* found .*\. \w+"):
        plan_layout(payload, leader, trailer, 1024)
