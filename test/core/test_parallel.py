"""Bands and tasks: all of them, once, on any number of threads; errors come out; nesting never locks up."""

import threading
import time
import weakref

import cv2
import pytest

from rcseg_core import ConfigError
from rcseg_core.compute import parallel

#: What OpenCV takes by itself.
cv2.setNumThreads(-1)
OPENCV_THREADS = cv2.getNumThreads()


@pytest.fixture(params=[1, 2, 4])
def number(request):
    parallel.set_threads(request.param)
    yield request.param
    parallel.set_threads(0)


def test_bands_cover_all_rows_once():
    for height in (3, 4, 5, 480, 481):
        rows = [row for first, last in parallel.bands(height) for row in range(first, last)]
        assert rows == list(range(height))


def test_every_task_runs_once(number):
    done = []
    parallel.together(*(lambda i=i: done.append(i) for i in range(50)))
    assert sorted(done) == list(range(50))
    bands = []
    parallel.over_bands(100, lambda *band: bands.append(band), least=1)
    assert sorted(bands) == [(0, 0, 25), (1, 25, 50), (2, 50, 75), (3, 75, 100)]


def test_tasks_run_at_once_where_there_are_threads():
    parallel.set_threads(2)
    try:
        meet = threading.Barrier(2, timeout=10)  # breaks unless both are there
        parallel.together(meet.wait, meet.wait)
    finally:
        parallel.set_threads(0)


def test_an_error_of_a_task_is_raised(number):
    def fail():
        raise KeyError("here")

    with pytest.raises(KeyError, match="here"):
        parallel.together(*[fail, lambda: None] * 3)
    done = []
    parallel.together(lambda: done.append(1))
    assert done == [1]


def test_nested_passes_of_many_callers_end(number):
    """More callers than workers, each waiting for tasks of its own."""
    done = []

    def caller():
        parallel.together(
            *(lambda: parallel.over_bands(8, lambda *_: done.append(1), least=1) for _ in range(6))
        )

    threads = [threading.Thread(target=caller, daemon=True) for _ in range(12)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(30)
        assert not thread.is_alive()
    assert len(done) == 12 * 6 * 4


def test_threads_come_from_the_environment(monkeypatch):
    for text, wanted in (
        ("3", 3),
        ("", parallel.cores()),
        (" 2 ", 2),
        ("0", parallel.cores()),
    ):
        monkeypatch.setenv("RCSEG_THREADS", text)
        parallel.set_threads(0)
        assert parallel.threads() == wanted
        assert cv2.getNumThreads() == (wanted if text.strip() not in ("", "0") else OPENCV_THREADS)
    for text in ("none", "-1", "1.5", "two"):
        monkeypatch.setenv("RCSEG_THREADS", text)
        parallel.set_threads(0)
        with pytest.raises(ConfigError, match=f"RCSEG_THREADS is '{text}'.*whole number"):
            parallel.threads()
    monkeypatch.delenv("RCSEG_THREADS")
    parallel.set_threads(1)
    assert cv2.getNumThreads() == 1
    parallel.set_threads(0)
    assert cv2.getNumThreads() == OPENCV_THREADS
    with pytest.raises(ValueError, match="threads"):
        parallel.set_threads(-1)


def test_small_images_stay_on_one_thread(number):
    seen = set()
    parallel.over_bands(parallel.LEAST_ROWS - 1, lambda *_: seen.add(threading.get_ident()))
    assert seen == {threading.get_ident()}


@pytest.mark.parametrize(
    ("count", "terms", "parts"), [(1, 25, 1), (2, 3, 1), (20, 25, 1), (33, 25, 2), (900, 25, 4)]
)
def test_regions_are_covered_once_and_few_are_not_parted(number, count, terms, parts):
    done = []
    parallel.over_regions(count, terms, lambda first, last: done.append((first, last)))
    assert len(done) == parts
    assert sorted(k for first, last in done for k in range(first, last)) == list(range(1, count))


def test_threads_that_wait_hold_on_to_nothing(number):
    """The arrays of a frame must not live until the next one."""

    class Frame:
        pass

    frame = Frame()
    gone = weakref.ref(frame)
    parallel.together(*(lambda kept=frame: time.sleep(0.01) for _ in range(8)))
    del frame
    deadline = time.monotonic() + 5
    while gone() is not None and time.monotonic() < deadline:
        time.sleep(0.01)
    assert gone() is None


def test_the_error_of_a_helper_is_raised_where_the_tasks_were_given():
    here = threading.get_ident()
    meet = threading.Barrier(2, timeout=10)

    def fail_elsewhere():
        meet.wait()
        if threading.get_ident() != here:
            raise KeyError("elsewhere")

    parallel.set_threads(2)
    try:
        with pytest.raises(KeyError, match="elsewhere"):
            parallel.together(fail_elsewhere, fail_elsewhere)
    finally:
        parallel.set_threads(0)
