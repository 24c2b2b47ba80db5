"""Highway: six vehicles on the six curved lanes of Interstate 80 (O'Kelly et al. 2018, section 4).

Five of them are driven by learned drivers, whose last layer's weights are parameters of the scenario. Where the paper
leaves a choice, ours: every vehicle starts in a lane of its own, the ego in the third from the left, because six cars
within 40 m would often overlap otherwise (the released code doubles three cars instead); an episode is 10 s long, as in
the released code and as long as the drivers were held to recorded traffic, where the paper drives 2 km or 100 s
(`horizon=100`); vehicles are 5 m x 2 m as everywhere here, where the released code has 4 m x 2 m.
"""

import math

import torch
from torch import Tensor

from rare_envs.devices import constant
from rare_envs.distributions.space import Parameter
from rare_envs.scenarios.base import Others, Scenario, base_files, drive_points
from rare_envs.traffic.road import i80
from rare_envs.traffic.state import State

VEHICLE_COUNT = 6
START_LANES = (2, 0, 1, 3, 4, 5)
"""Lane of each vehicle at the start, the ego's first; 0 is the leftmost."""


def initial(x: Tensor) -> State:
    """Place six vehicles; six columns each: s along the road, t off the lane [m], heading [deg], speed [m/s]."""
    s, t, heading, speed = x.view(len(x), 4, VEHICLE_COUNT).unbind(dim=1)
    middle = constant(tuple(i80().centre(lane) for lane in START_LANES), x)
    return State(s.T.contiguous().T, t + middle, heading * (math.pi / 180.0), speed.clone(), theta=x[:, :0])


def driven(state: State, action: Tensor, dt: float) -> Others:
    """Move points that turn at will. Yaw rates are relative to the road: the drivers have learned on a straight one."""
    return drive_points(state, action, dt, i80())


def others(state: State, dt: float) -> Others:
    """Move everybody at its speed and heading relative to the road."""
    return driven(state, torch.zeros_like(state.x[:, 1:, None]).expand(-1, -1, 2), dt)


HIGHWAY = Scenario(
    name="highway",
    road=i80(),
    vehicle_names=("ego", *(f"vehicle_{j}" for j in range(1, VEHICLE_COUNT))),
    labels=("the ego", *(f"lane {lane + 1}'s car" for lane in START_LANES[1:])),
    horizon=10.0,
    # the ranges of the paper, which are those of its Beta variables
    parameters=(
        Parameter("s", "m", 80.0, 120.0, "initial place along the road, the ego's first", VEHICLE_COUNT),
        Parameter("t", "m", -0.25, 0.25, "initial place to the right of the lane's middle", VEHICLE_COUNT),
        Parameter(
            "heading", "deg", -3.6, 3.6, "initial heading relative to the road, positive to the right", VEHICLE_COUNT
        ),
        Parameter("speed", "m/s", 10.0, 20.0, "initial speed", VEHICLE_COUNT),
    ),
    bases=base_files("highway", "okelly2018"),
    initial=initial,
    others=others,
    driven=driven,
    drivers="mgail?rules=0",
)
