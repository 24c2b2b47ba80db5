"""Threads of torch: one inside, as many as before outside."""

import inspect
from collections.abc import Iterator

import pytest
import torch

from rare_envs.startup import use_one_thread


@pytest.fixture(autouse=True)
def three_threads() -> Iterator[None]:
    """Let torch have three."""
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    yield
    torch.set_num_threads(before)


def test_an_inner_block_does_not_end_the_outer_one_and_an_error_does() -> None:
    with pytest.raises(KeyError), use_one_thread():
        with use_one_thread():
            assert torch.get_num_threads() == 1
        assert torch.get_num_threads() == 1
        raise KeyError
    assert torch.get_num_threads() == 3


def test_a_function_runs_on_one_thread_each_time_and_keeps_its_signature() -> None:
    @use_one_thread()
    def count(steps: int = 5) -> int:
        return torch.get_num_threads()

    assert [count(), count(7)] == [1, 1]
    assert torch.get_num_threads() == 3
    assert list(inspect.signature(count).parameters) == ["steps"]
