from __future__ import annotations

import pytest

from udccal.cameras.u3v import polling
from udccal.cameras.u3v.polling import comes_true


class Time:
    """A clock that the test moves on; ``time`` in the module under test."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def monotonic(self) -> float:
        return self.now_s

    def sleep(self, duration_s: float) -> None:
        self.now_s += duration_s


class Device:
    """Says yes to the ``ready_at``-th question; each takes some time."""

    def __init__(self, time: Time, answer_s: float, ready_at: int = 1 << 30) -> None:
        self.time, self.answer_s, self.ready_at, self.asked = time, answer_s, ready_at, 0

    def __call__(self) -> bool:
        self.asked += 1
        self.time.now_s += self.answer_s
        return self.asked >= self.ready_at


@pytest.fixture
def time(monkeypatch: pytest.MonkeyPatch) -> Time:
    made = Time()
    monkeypatch.setattr(polling, "time", made)
    return made


def test_a_device_that_gets_ready_is_waited_for(time: Time) -> None:
    assert comes_true(Device(time, 0.0, ready_at=5), 1.0, 0.1)
    assert time.now_s == pytest.approx(100.4)


def test_slow_answers_do_not_draw_out_the_wait(time: Time) -> None:
    device = Device(time, 15.0)
    assert not comes_true(device, 20.0, 0.1)
    assert device.asked == 2


def test_a_clock_that_stands_still_does_not_either(time: Time, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(time, "sleep", lambda duration_s: None)
    device = Device(time, 0.0)
    assert not comes_true(device, 1.0, 0.1)
    assert device.asked == 10


def test_it_is_asked_at_least_once(time: Time) -> None:
    assert comes_true(Device(time, 5.0, ready_at=1), 0.0, 0.1)
