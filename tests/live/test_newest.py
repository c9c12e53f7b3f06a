from __future__ import annotations

import threading

from udccal.live.newest import Newest


def test_the_newest_item_wins() -> None:
    queue: Newest[int] = Newest()
    assert not queue.put(1)
    assert queue.put(2)
    assert queue.get() == 2
    assert not queue.put(3)


def test_what_is_there_may_be_taken_after_closing_and_nothing_more() -> None:
    queue: Newest[int] = Newest()
    queue.put(1)
    queue.close()
    assert not queue.put(2)
    assert queue.get() == 1
    assert queue.get() is None


def test_who_waits_is_woken_by_an_item_and_by_closing() -> None:
    queue: Newest[int] = Newest()
    got: list[int | None] = []

    def take() -> None:
        got.append(queue.get())
        got.append(queue.get())

    thread = threading.Thread(target=take, daemon=True)
    thread.start()
    thread.join(0.05)
    assert thread.is_alive()
    queue.put(1)
    while not got:
        thread.join(0.01)
    queue.close()
    thread.join(10)
    assert got == [1, None]


def test_between_threads_items_come_in_order_and_each_is_taken_or_lost() -> None:
    queue: Newest[int] = Newest()
    got: list[int] = []

    def take() -> None:
        while (item := queue.get()) is not None:
            got.append(item)

    thread = threading.Thread(target=take, daemon=True)
    thread.start()
    lost = sum(queue.put(number) for number in range(20_000))
    queue.close()
    thread.join(30)
    assert got == sorted(set(got))
    assert len(got) + lost == 20_000
    assert got[-1] == 19_999
