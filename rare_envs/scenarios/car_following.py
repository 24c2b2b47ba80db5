"""Car-following: the ego behind a lead that keeps its speed (Tian et al. 2024, Fig. 3)."""

import torch
from torch import Tensor

from rare_envs.road import straight
from rare_envs.scenarios.base import Others, Scenario, columns
from rare_envs.state import VEHICLE_LENGTH, State


def initial(x: Tensor) -> State:
    """ego_speed, lead_speed [m/s], gap [m]; both vehicles in the middle of the one lane. theta is empty."""
    ego_speed, lead_speed, gap = x.unbind(dim=1)
    zero = torch.zeros_like(gap)
    return State(
        x=columns(zero, gap + VEHICLE_LENGTH),
        y=columns(zero, zero),
        heading=columns(zero, zero),
        speed=columns(ego_speed, lead_speed),
        theta=x[:, :0],
    )


def others(state: State, dt: float) -> Others:
    """The lead keeps its speed."""
    speed = state.speed[:, 1:]
    return Others(state.x[:, 1:] + speed * dt, state.y[:, 1:], state.heading[:, 1:], speed)


def driven(state: State, action: Tensor, dt: float) -> Others:
    """The lead accelerates as its driver wants and stays in the middle of the lane."""
    kept = others(state, dt)
    return kept._replace(speed=(kept.speed + action[..., 0] * dt).clamp(min=0.0))


CAR_FOLLOWING = Scenario(
    "car_following",
    road=straight(1),
    vehicles=2,
    horizon=10.0,
    initial=initial,
    others=others,
    driven=driven,
    size=3,
)
