"""Car-following: the ego behind a lead that keeps its speed (Tian et al. 2024, Fig. 3)."""

import torch
from torch import Tensor

from rare_envs.devices import scalars
from rare_envs.distributions.space import Parameter
from rare_envs.scenarios.base import SPEED_RANGE, Others, Scenario, base_files, columns, keep_lane
from rare_envs.traffic.road import straight
from rare_envs.traffic.state import VEHICLE_LENGTH, State


def initial(x: Tensor) -> State:
    """Place both vehicles in the middle of the one lane: ego_speed, lead_speed [m/s], gap [m]. theta is empty."""
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
    """Move the lead at its speed."""
    speed, (tick,) = state.speed[:, 1:], scalars((dt,), state.speed)
    return Others(state.x[:, 1:] + speed * tick, state.y[:, 1:], state.heading[:, 1:], speed)


CAR_FOLLOWING = Scenario(
    name="car_following",
    road=straight(1),
    vehicle_names=("ego", "lead"),
    horizon=10.0,
    # Gaps: under 1 m is below IDM's standstill distance and of the order of the position error of the recordings (1.2 m
    # along the road); beyond 150 m the lead no longer matters within 10 s.
    parameters=(
        Parameter("ego_speed", *SPEED_RANGE, "initial speed of the ego"),
        Parameter("lead_speed", *SPEED_RANGE, "speed of the lead, which keeps it"),
        Parameter("gap", "m", 1.0, 150.0, "initial gap from ego to lead, bumper to bumper"),
    ),
    bases=base_files("car_following", "us101", "us101-gap", "us101-log-gap", "i80", "i80-all-pairs", "i24", "highway"),
    initial=initial,
    others=others,
    driven=keep_lane,
)
