import threading
import time

import pytest

from gsplat_tools import parallel


@pytest.mark.parametrize("jobs", [1, 2, 5])
def test_map_ordered__keeps_the_order_of_the_items(jobs: int) -> None:
    with parallel.use_jobs(jobs):
        results = list(parallel.map_ordered(lambda i: (time.sleep(0.001 * (i % 3)), i)[1], range(40)))

    assert results == list(range(40))


def test_map_ordered__bounds_the_items_in_flight() -> None:
    running, peak, lock = 0, 0, threading.Lock()

    def work(_item: int) -> None:
        nonlocal running, peak
        with lock:
            running += 1
            peak = max(peak, running)
        time.sleep(0.002)
        with lock:
            running -= 1

    with parallel.use_jobs(3):
        list(parallel.map_ordered(work, range(30)))

    assert 1 <= peak <= 3


def test_run_blocks__covers_everything_once_whatever_the_threads() -> None:
    for jobs in (1, 4):
        seen = [0] * 1000

        def mark(start: int, stop: int, seen: list[int] = seen) -> None:
            for i in range(start, stop):
                seen[i] += 1

        with parallel.use_jobs(jobs):
            parallel.run_blocks(mark, 1000, 64)
        assert seen == [1] * 1000


def test_for_each__raises_the_first_exception_in_item_order() -> None:
    def fail(item: int) -> None:
        if item in (3, 7):
            raise ValueError(f"item {item}")

    with parallel.use_jobs(2), pytest.raises(ValueError, match="item 3"):
        parallel.for_each(fail, range(20))


def test_nested_work__runs_in_the_worker_and_does_not_deadlock() -> None:
    def outer(item: int) -> int:
        return sum(parallel.map_ordered(lambda x: x * item, range(10)))

    with parallel.use_jobs(2):
        assert list(parallel.map_ordered(outer, range(8))) == [45 * i for i in range(8)]


def test_use_jobs__refuses_none_at_all() -> None:
    with pytest.raises(ValueError, match="at least 1"), parallel.use_jobs(0):
        pass
