"""Cut-in: a vehicle moves into the gap between the ego and its lead along a cubic Bezier (Tian et al. 2024, Fig. 4).

Two versions of one scenario: in `CutIn-v0` every lane change takes 4 s, in `CutIn-v1` its duration is a parameter.
"""

from dataclasses import replace

import torch
from torch import Tensor

from rare_envs.control.idm import IDM
from rare_envs.devices import scalars
from rare_envs.distributions.space import Parameter
from rare_envs.scenarios.base import SPEED_RANGE, Others, Scenario, base_files, columns
from rare_envs.traffic.bodies import Lead
from rare_envs.traffic.road import straight
from rare_envs.traffic.state import VEHICLE_LENGTH, State

CUT_IN_DURATION = 4.0
"""Duration of the lane change where x has no column for it [s]."""
CUT_IN_MIN_LENGTH = 15.0
"""Least length of the path along the road [m], for slow vehicles, which cannot move sideways."""
CUTTER_IDM = IDM()
"""How the cutter follows the lead; its desired speed is its own initial speed."""


def initial(x: Tensor) -> State:
    """Place ego and lead in one lane and the cutter beside them.

    x is as in `CUT_IN`, and in `CutIn-v1` the duration [s] behind it. Columns of theta: start of the cutter's path [m],
    its length (its way in the duration at its initial speed) [m], lateral offset [m], the cutter's desired speed [m/s].
    """
    ego_speed, cut_in_speed, lead_speed, cut_in_gap, lead_gap, lateral_offset, *durations = x.unbind(dim=1)
    duration = durations[0] if durations else CUT_IN_DURATION
    zero = torch.zeros_like(ego_speed)
    cutter_x = cut_in_gap + VEHICLE_LENGTH
    length = (cut_in_speed * duration).clamp(min=CUT_IN_MIN_LENGTH)
    desired_speed = cut_in_speed.clamp(min=1.0)
    return State(
        x=columns(zero, cutter_x, cutter_x + lead_gap + VEHICLE_LENGTH),
        y=columns(zero, lateral_offset, zero),
        heading=columns(zero, zero, zero),
        speed=columns(ego_speed, cut_in_speed, lead_speed),
        theta=columns(cutter_x, length, lateral_offset, desired_speed),
    )


def bezier(progress: Tensor, length: Tensor, offset: Tensor) -> tuple[Tensor, Tensor]:
    """Return y [m] and slope of the cubic Bezier from (0, offset) to (length, 0), level at both ends, (B,) each.

    With t = progress / length, y = offset (1 - 3 t^2 + 2 t^3); before and after it straight on.
    """
    one, two, three, six = scalars((1.0, 2.0, 3.0, 6.0), progress)
    t = (progress / length).clamp(0.0, 1.0)
    y = offset * (one + t * t * (two * t - three))
    slope = offset * (six * t * (t - one)) / length
    return y, slope


def others(state: State, dt: float) -> Others:
    """Move the lead at its speed and the cutter on its path, with IDM's acceleration behind the lead.

    Tian et al.'s code steers along a Bezier of 30 m by pure pursuit, with the ego's IDM; here it is on the curve.
    """
    (x, _, heading, speed), (lead_x, _, _, lead_speed) = state.vehicles[1:]
    tick, body = scalars((dt, VEHICLE_LENGTH), x)
    lead = Lead(lead_x - x - body, speed - lead_speed * torch.cos(heading))
    acceleration = CUTTER_IDM.acceleration(speed, lead, state.theta[:, 3])
    return _advance(state, (speed + acceleration * tick).clamp_min(0.0), lead_speed, dt)


def driven(state: State, action: Tensor, dt: float) -> Others:
    """Move both with the accelerations of their drivers, the cutter on its path, the lead in its lane."""
    speed = (state.speed[:, 1:] + action[..., 0] * dt).clamp(min=0.0)
    return _advance(state, speed[:, 0], speed[:, 1], dt)


def _advance(state: State, speed: Tensor, lead_speed: Tensor, dt: float) -> Others:
    """Return both after the tick: the cutter on its path, the lead straight on, with new speeds (B,)."""
    start, length, offset, _ = state.theta.unbind(dim=1)
    (x, _, heading, old_speed), (lead_x, _, _, lead_old_speed) = state.vehicles[1:]
    tick, nothing = scalars((dt, 0.0), x)
    x, lead_x = x + old_speed * torch.cos(heading) * tick, lead_x + lead_old_speed * tick
    y, slope = bezier(x - start, length, offset)
    zero = nothing.expand_as(y)
    table = torch.stack((x, lead_x, y, zero, torch.atan(slope), zero, speed, lead_speed))
    return Others(*table.view(4, 2, len(x)).mT.unbind(0))


CUT_IN = Scenario(
    name="cut_in",
    road=straight(2),
    vehicle_names=("ego", "cutter", "lead"),
    horizon=10.0,
    # Gaps as in car-following; a gap that a vehicle cuts into and that is longer than 120 m makes no cut-in. Lateral
    # offset: vehicles 2 m wide with at least 0.2 m between their sides, and at most one lane (4 m) plus half a metre
    # off-centre each.
    parameters=(
        Parameter("ego_speed", *SPEED_RANGE, "initial speed of the ego"),
        Parameter("cut_in_speed", *SPEED_RANGE, "initial speed of the vehicle that cuts in"),
        Parameter("lead_speed", *SPEED_RANGE, "speed of the lead in the ego's lane, which keeps it"),
        Parameter("cut_in_gap", "m", 1.0, 120.0, "initial gap from ego to cutter along the road"),
        Parameter("lead_gap", "m", 1.0, 150.0, "initial gap from cutter to lead along the road"),
        Parameter("lateral_offset", "m", 2.2, 5.0, "initial distance of the centres across"),
    ),
    bases=base_files("cut_in", "us101", "us101-15-offsets", "us101-closing", "i80", "i80-closing", "highway"),
    initial=initial,
    others=others,
    driven=driven,
)
"""`CutIn-v0`."""
TIMED_CUT_IN = replace(
    CUT_IN,
    # Below 1.5 s a change by a lane of 3.5 m needs more than 9.3 m/s^2 across (6 offset / duration^2), which tyres do
    # not give, and of 390 recorded changes none is shorter than 2.3 s; two over 12 s are left out.
    parameters=(*CUT_IN.parameters, Parameter("duration", "s", 1.5, 12.0, "time of the lane change")),
    bases=base_files("cut_in_v1", "us101", "us101-closing", "i80", "i80-closing", "highway"),
)
"""`CutIn-v1`."""
