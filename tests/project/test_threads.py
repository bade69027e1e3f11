"""Threads of ours, and those of linear algebra."""

from __future__ import annotations

from threadpoolctl import threadpool_info, threadpool_limits

from iscat_analysis.threads import threads


def _of_linear_algebra() -> list[int]:
    return [found["num_threads"] for found in threadpool_info() if found["user_api"] == "blas"]


def test_linear_algebra_keeps_to_the_thread_that_calls_it() -> None:
    with threadpool_limits(2, user_api="blas"):
        assert set(_of_linear_algebra()) == {2}  # the trap is set
        with threads(3) as pool:
            seen = list(pool.map(lambda _: _of_linear_algebra(), range(6)))
        assert set(_of_linear_algebra()) == {2}
    assert all(set(each) == {1} for each in seen)
