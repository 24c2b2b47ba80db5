"""Hard brake: a lead that brakes to a standstill in front of an ego that followed it at its speed.

The deceleration scenario of UN Regulation 157 (annex 4, appendix 3) and Euro NCAP's CCRb test: ego and lead drive at
one speed, then the lead brakes at a constant rate until it stands. Euro NCAP lets the braking build up within 1 s; here
it is there at once, which leaves less time.
"""

import torch
from torch import Tensor

from rare_envs.distributions.space import Parameter
from rare_envs.scenarios.base import Others, Scenario, base_files, columns, keep_lane, keep_straight
from rare_envs.traffic.road import straight
from rare_envs.traffic.state import VEHICLE_LENGTH, State


def initial(x: Tensor) -> State:
    """Place both in the lane: speed [m/s] of both, gap [m], deceleration [m/s^2] of the lead, theta's only column."""
    speed, gap, deceleration = x.unbind(dim=1)
    zero = torch.zeros_like(gap)
    return State(
        x=columns(zero, gap + VEHICLE_LENGTH),
        y=columns(zero, zero),
        heading=columns(zero, zero),
        speed=columns(speed, speed),
        theta=deceleration[:, None],
    )


def others(state: State, dt: float) -> Others:
    """Move the lead, which brakes until it stands."""
    return keep_straight(state, -state.theta, dt)


HARD_BRAKE = Scenario(
    name="hard_brake",
    road=straight(1),
    vehicle_names=("ego", "lead"),
    horizon=10.0,
    # Euro NCAP's points (50 km/h, gaps of 12 and 40 m, 2 and 6 m/s^2) are inside; a dry road allows about 10 m/s^2.
    parameters=(
        Parameter("speed", "m/s", 1.0, 45.0, "initial speed of both"),
        Parameter("gap", "m", 1.0, 150.0, "initial gap from ego to lead, bumper to bumper"),
        Parameter("deceleration", "m/s^2", 0.5, 10.0, "of the lead, until it stands"),
    ),
    bases=base_files("hard_brake", "us101", "us101-all-brakings"),
    initial=initial,
    others=others,
    driven=keep_lane,
)
