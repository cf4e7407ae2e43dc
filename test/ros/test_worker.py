"""The worker's queue: the newest wins where work may give way, and every item has its turn where not."""

from __future__ import annotations

import threading

from rcseg_ros.live.worker import Worker


def test_the_oldest_gives_way():
    gate, begun, done = threading.Event(), threading.Event(), []
    worker = Worker(lambda item: (begun.set(), gate.wait(5), done.append(item)), "test")
    worker.put(0, 1)
    assert begun.wait(5)
    dropped = [worker.put(item, 1) for item in (1, 2, 3)]
    assert dropped == [[], [1], [2]]
    gate.set()
    worker.put_in_turn(4)
    worker.put_in_turn(5)
    assert worker.stop(5)
    assert done[:3] == [0, 3, 4]


def test_in_turn_nothing_gives_way_and_at_most_one_waits():
    done = []
    worker = Worker(done.append, "test")
    for item in range(50):
        worker.put_in_turn(item)
        assert len(worker._queue) <= 1
    worker.put_in_turn(None)  # returns when all before it are done
    assert done[:50] == list(range(50))
    assert worker.stop(5)


def test_an_item_that_waits_for_its_turn_does_not_outlast_a_stop():
    gate, begun = threading.Event(), threading.Event()
    worker = Worker(lambda item: (begun.set(), gate.wait(5)), "test")
    worker.put_in_turn(0)
    assert begun.wait(5)
    waiting = threading.Thread(target=worker.put_in_turn, args=(1,))
    waiting.start()
    assert not worker.stop(0.05)
    waiting.join(2)
    assert not waiting.is_alive()
    gate.set()
