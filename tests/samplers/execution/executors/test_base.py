"""Limits of executors: which are refused."""

import pytest

from samplers.execution.executors.base import check_limits


def test_no_limit_and_limits_above_zero_are_taken() -> None:
    check_limits(None, time_limit=None)
    check_limits(1, time_limit=0.5, memory_limit=1e9)


@pytest.mark.parametrize(
    ("workers", "limit", "name"), [(0, None, "workers"), (2, 0.0, "time_limit"), (2, -1.0, "time")]
)
def test_others_are_refused_by_name(workers: int, limit: float | None, name: str) -> None:
    with pytest.raises(ValueError, match=name):
        check_limits(workers, time_limit=limit)
