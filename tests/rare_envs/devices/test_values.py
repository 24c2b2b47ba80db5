"""Constants are made once per device, and branches are looked at where values are at hand."""

import torch

from rare_envs.devices import are_zero, constant, may_hold, move_to, scalars


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


def test_what_has_nothing_on_a_device_stays_itself() -> None:
    policy = object()
    assert move_to(torch.device("meta"), policy) is policy


def test_a_module_is_copied_and_the_caller_s_stays_where_it_is() -> None:
    module = torch.nn.Linear(2, 2)
    moved = move_to(torch.device("meta"), module)
    assert moved.weight.device.type == "meta"
    assert module.weight.device.type == "cpu"


def test_numbers_beside_integers_stay_numbers() -> None:
    (half,) = scalars((0.5,), torch.arange(3))
    assert half.item() == 0.5
