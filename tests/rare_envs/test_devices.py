"""Devices: their names, values on them, and how much is simulated at once."""

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
    are_zero,
    constant,
    find_device,
    may_hold,
    move_to,
    scalars,
)


@pytest.mark.parametrize("name", ["gpu", "", "mps", "meta", "cuda:x", None, 3])
def test_what_is_no_name_of_a_device_is_refused(name: object) -> None:
    with pytest.raises(ValueError, match="Expected device 'cpu', 'cuda' or 'cuda:1', got"):
        find_device(name)  # type: ignore[arg-type]


def test_a_gpu_that_is_not_here_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    assert find_device("cuda").type == "cuda"
    with pytest.raises(ValueError, match=r"device='cuda:1' is not here: torch .* sees 1 GPUs; take 'cpu'"):
        find_device("cuda:1")


def test_zeros_are_looked_for_only_where_nothing_is_differentiated() -> None:
    zero = torch.zeros(3)
    assert not are_zero(zero)
    with torch.no_grad():
        assert are_zero(zero, -zero)
        assert not are_zero(zero, torch.tensor([0.0, torch.nan]))


def test_a_constant_is_one_tensor_of_each_dtype_and_can_be_differentiated_through() -> None:
    with torch.inference_mode():
        made = constant((2.0, 3.0), torch.zeros(1))
    assert constant((2.0, 3.0), torch.ones(5)) is made
    assert constant((2.0, 3.0), torch.ones(5, dtype=torch.float64)).dtype == torch.float64
    x = torch.ones(2, requires_grad=True)
    (slope,) = torch.autograd.grad((x * made).sum(), x)
    assert torch.equal(slope, made)


def test_numbers_as_tensors_give_the_bits_of_numbers() -> None:
    x = torch.rand(1000, generator=torch.Generator().manual_seed(0))
    tenth, one = scalars((0.1, 1.0), x)
    assert torch.equal(x * tenth, x * 0.1)
    assert torch.equal(x / tenth, x / 0.1)
    assert torch.equal(one - x, 1.0 - x)
    assert torch.equal(x > tenth, x > 0.1)
    assert scalars((0.1, 1.0), x.double())[0].dtype == torch.float64


def test_where_values_are_not_at_hand_conditions_may_hold_and_nothing_is_zero() -> None:
    elsewhere = torch.zeros(2, dtype=torch.bool, device="meta")
    assert may_hold(elsewhere)
    assert not may_hold(torch.zeros(2, dtype=torch.bool))
    with torch.no_grad():
        assert not are_zero(elsewhere)


def test_a_module_is_copied_and_the_caller_s_stays_where_it_is() -> None:
    module = torch.nn.Linear(2, 2)
    moved = move_to(torch.device("meta"), module)
    assert moved.weight.device.type == "meta"
    assert module.weight.device.type == "cpu"


def stands_still(observation):
    return 0.0


def sizes(**settings):
    problem = rare_envs.DrivingProblem("rare_envs/CutIn-v0", **settings)
    return problem.tile, problem.chunk_size


def test_what_costs_more_memory_is_simulated_in_smaller_tiles():
    assert sizes() == (RULE_TILE, RULE_CHUNK)
    assert sizes(ego=stands_still) == (POLICY_TILE, POLICY_CHUNK)
    assert sizes(ego=stands_still, observation="lidar") == (LIDAR_TILE, POLICY_CHUNK)
    assert sizes(ego=stands_still, observation="camera") == (CAMERA_TILE, CAMERA_TILE)  # a chunk is a tile at most


def test_nobody_looks_at_the_camera_of_a_rule_based_ego():
    assert sizes(observation="camera") == (RULE_TILE, RULE_CHUNK)
