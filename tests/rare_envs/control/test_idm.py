"""The Intelligent Driver Model by pencil and paper."""

import math

import pytest
import torch

from rare_envs.control.idm import IDM
from rare_envs.traffic.neighbours import Lead
from tests.rare_envs.traffic_states import F64, tensor


def test_idm_equilibrium() -> None:
    # at equal speeds below v0, a = 0 where gap = s* / sqrt(1 - (v/v0)^4)
    idm, v = IDM(), 15.0
    wanted = 1.0 + 2.0 * math.sqrt(v / 21.72) + 1.2 * v
    gap = wanted / math.sqrt(1.0 - (v / 21.72) ** 4)
    acceleration = idm.acceleration(tensor(v), Lead(tensor(gap), tensor(0.0)))
    assert acceleration.item() == pytest.approx(0.0, abs=1e-12)


def test_idm_by_hand() -> None:
    # v = 20, dv = 5, gap = 40: s* = 1 + 2 sqrt(20/21.72) + 24 + 100 / (2 sqrt(5.328))
    wanted = 1 + 2 * math.sqrt(20 / 21.72) + 24 + 100 / (2 * math.sqrt(2.22 * 2.4))
    expected = 2.22 * (1 - (20 / 21.72) ** 4 - (wanted / 40) ** 2)
    assert -5.0 < expected < 0.0
    acceleration = IDM().acceleration(tensor(20.0), Lead(tensor(40.0), tensor(5.0)))
    assert acceleration.item() == pytest.approx(expected, rel=1e-14)


def test_idm_limits() -> None:
    idm = IDM()
    emergency = idm.acceleration(tensor(20.0), Lead(tensor(2.0), tensor(10.0)))
    start = idm.acceleration(tensor(0.0), Lead(tensor(math.inf), tensor(0.0)))
    side_by_side = idm.acceleration(tensor(20.0), Lead(tensor(-3.0), tensor(0.0)))
    assert (emergency.item(), side_by_side.item()) == (-5.0, -5.0)
    assert start.item() == pytest.approx(2.22)


def test_idm_has_a_finite_slope_wherever_a_follower_may_be() -> None:
    """At standstill, at the desired speed, touching and without a lead."""
    speed, gap = tensor(0.0, 21.72, 5.0, 5.0), tensor(10.0, 10.0, 0.0, math.inf)
    inputs = [speed.requires_grad_(), gap.clamp(max=1e6).requires_grad_(), torch.zeros(4, dtype=F64).requires_grad_()]
    acceleration = IDM().acceleration(inputs[0], Lead(*inputs[1:]))
    gradients = torch.autograd.grad(acceleration.sum(), inputs)
    assert all(torch.isfinite(gradient).all() for gradient in gradients)


def test_each_follower_may_have_a_desired_speed_of_its_own() -> None:
    lead = Lead(tensor(math.inf, math.inf), tensor(0.0, 0.0))
    acceleration = IDM().acceleration(tensor(10.0, 10.0), lead, tensor(10.0, 20.0))
    assert acceleration.tolist() == pytest.approx([0.0, 2.22 * (1 - 0.5**4)])


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("max_acceleration", 0.0),
        ("desired_speed", -1.0),
        ("exponent", math.nan),
        ("jam_distance", -0.1),
        ("time_headway", math.inf),
    ],
)
def test_parameters_without_meaning_are_refused(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"^Expected {name} of the IDM to be a number .*, got {value!r}\\.$"):
        IDM(**{name: value})  # type: ignore[arg-type]


def test_an_idm_without_headway_or_distance_is_one() -> None:
    assert IDM(time_headway=0.0, jam_distance=0.0, jam_distance_speed=0.0).jam_distance == 0.0
