import threading
import time

import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from sfm_app.progress import Progress
from sfm_app.runtime.parallel import make_executor, open_executor, ordered_map, worker_count
from sfm_app.settings import Settings

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("workers", [1, 3])
def test_results_keep_the_order_of_the_items(workers):
    def slow_first(item):
        time.sleep(0.02 if item == 0 else 0)
        return item * 10

    with make_executor(workers) as executor:
        assert list(ordered_map(executor, slow_first, range(7), ahead=3)) == [0, 10, 20, 30, 40, 50, 60]


def test_linear_algebra_has_one_thread_during_a_run(tmp_path):
    def threads():
        return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}

    with threadpool_limits(2, user_api="blas"):
        with open_executor(Settings(), tmp_path, Progress()):
            assert threads() == {1}
        assert threads() == {2}


def test_no_more_than_ahead_items_are_under_way():
    begun = []
    with make_executor(2) as executor:
        results = ordered_map(executor, begun.append, range(100), ahead=4)
        next(results)
        assert len(begun) <= 4
        results.close()
    assert len(begun) <= 5


def test_an_error_cancels_what_has_not_begun():
    gate, ran = threading.Event(), []

    def work(item):
        if item == 0:
            raise ValueError("bad item")
        gate.wait(1)
        ran.append(item)

    with make_executor(1) as executor:
        with pytest.raises(ValueError, match="bad item"):
            list(ordered_map(executor, work, range(10), ahead=10))
        gate.set()
    assert len(ran) <= 1


def test_zero_workers_means_one_per_core():
    assert worker_count(0) >= 1
    assert worker_count(5) == 5
