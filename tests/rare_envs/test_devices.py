"""Devices: their names, values on them, and how much is simulated at once."""

import inspect
from collections.abc import Iterator

import pytest
import torch

import rare_envs
from rare_envs.devices import (
    CAMERA_TILE,
    LIDAR_TILE,
    POLICY_CHUNK,
    POLICY_TILE,
    RULE_CHUNK,
    RULE_TILE,
    constant,
    find_device,
)
from rare_envs.startup import use_one_thread


def test_what_is_no_device_or_not_here_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("gpu", "", "mps", "meta", "cuda:x", None, 3):
        with pytest.raises(ValueError, match="Expected device 'cpu', 'cuda' or 'cuda:1', got"):
            find_device(name)  # type: ignore[arg-type]
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    assert find_device("cuda").type == "cuda"
    with pytest.raises(ValueError, match=r"device='cuda:1' is not here: torch .* sees 1 GPUs; take 'cpu'"):
        find_device("cuda:1")


def test_a_constant_is_one_tensor_of_each_dtype_and_can_be_differentiated_through() -> None:
    with torch.inference_mode():
        made = constant((2.0, 3.0), torch.zeros(1))
    assert constant((2.0, 3.0), torch.ones(5)) is made
    assert constant((2.0, 3.0), torch.ones(5, dtype=torch.float64)).dtype == torch.float64
    x = torch.ones(2, requires_grad=True)
    (slope,) = torch.autograd.grad((x * made).sum(), x)
    assert torch.equal(slope, made)


def stands_still(observation):
    return 0.0


def sizes(**settings):
    problem = rare_envs.DrivingProblem("rare_envs/CutIn-v0", **settings)
    return problem.tile, problem.chunk_size


def test_what_costs_more_memory_is_simulated_in_smaller_tiles():
    assert sizes() == (RULE_TILE, RULE_CHUNK)
    assert sizes(observation="camera") == (RULE_TILE, RULE_CHUNK)  # nobody looks at it
    assert sizes(ego=stands_still) == (POLICY_TILE, POLICY_CHUNK)
    assert sizes(ego=stands_still, observation="lidar") == (LIDAR_TILE, POLICY_CHUNK)
    assert sizes(ego=stands_still, observation="camera") == (CAMERA_TILE, CAMERA_TILE)  # a chunk is a tile at most


@pytest.fixture(autouse=True)
def three_threads() -> Iterator[None]:
    """Let torch have three."""
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    yield
    torch.set_num_threads(before)


def test_one_thread_lasts_for_a_block_or_a_call_whatever_ends_it() -> None:
    @use_one_thread()
    def count(steps: int = 5) -> int:
        return torch.get_num_threads()

    assert list(inspect.signature(count).parameters) == ["steps"]
    with pytest.raises(KeyError), use_one_thread():
        assert [count(), count(7)] == [1, 1]
        assert torch.get_num_threads() == 1
        raise KeyError
    assert torch.get_num_threads() == 3
