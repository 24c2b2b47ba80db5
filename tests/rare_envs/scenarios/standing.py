"""A scenario of one's own, small enough to work out by hand: an ego comes upon a vehicle that stands."""

import torch
from torch import Tensor

from rare_envs.distributions.space import Parameter
from rare_envs.scenarios.base import Others, Scenario, columns
from rare_envs.traffic.road import straight
from rare_envs.traffic.state import VEHICLE_LENGTH, State


def initial(x: Tensor) -> State:
    """Columns of x: speed [m/s] and distance [m], bumper to bumper."""
    speed, distance = x.unbind(dim=1)
    zero = torch.zeros_like(speed)
    return State(
        columns(zero, distance + VEHICLE_LENGTH),
        columns(zero, zero),
        columns(zero, zero),
        columns(speed, zero),
        theta=x[:, :0],
    )


def others(state: State, dt: float) -> Others:
    """Let the other vehicle stand."""
    return Others(state.x[:, 1:], state.y[:, 1:], state.heading[:, 1:], state.speed[:, 1:])


def driven(state: State, action: Tensor, dt: float) -> Others:
    """Let it stand whatever its driver wants."""
    return others(state, dt)


STANDING = Scenario(
    name="standing",
    road=straight(1),
    vehicle_names=("ego", "stalled"),
    horizon=6.0,
    parameters=(
        Parameter("speed", "m/s", 5.0, 30.0, "of the ego"),
        Parameter("distance", "m", 10.0, 150.0, "bumper to bumper"),
    ),
    bases={"even": {"alpha": [1.0, 1.0], "beta": [1.0, 1.0]}},
    initial=initial,
    others=others,
    driven=driven,
)
