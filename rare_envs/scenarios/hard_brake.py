"""Hard brake: a lead that brakes in front of an ego that followed it at its speed, to a standstill or not.

The deceleration scenario of UN Regulation 157 (annex 4, appendix 3), where the lead brakes at a constant rate until it
stands. Recorded brakings are parabolas instead: over 286 of NGSIM's US 101 (the base has 283 of them) the mean
deceleration is 0.68 of the peak and the duration 1.49 loss / peak, where a parabola has 2/3 and 1.5 (0.72 of the peak
over 121 of I-24). A constant rate leaves two thirds of the recorded way.
"""

import torch
from torch import Tensor

from rare_envs.devices import scalars
from rare_envs.distributions.space import Parameter
from rare_envs.scenarios.base import Others, Scenario, base_files, columns, keep_lane
from rare_envs.traffic.road import straight
from rare_envs.traffic.state import VEHICLE_LENGTH, State

PARABOLA = 1.5
"""Duration of a parabola of braking over its loss of speed / peak deceleration."""


def lost_share(time: Tensor, duration: Tensor) -> Tensor:
    """Return the share of its loss of speed that a braking in a parabola has taken after a time [s], (B,).

    Deceleration peak 4 u (1 - u) with u = time / duration and duration = 1.5 loss / peak: 3 u^2 - 2 u^3, 0 before and
    exactly 1 after it.
    """
    zero, one, two, three = scalars((0.0, 1.0, 2.0, 3.0), time)
    u = (time / duration).clamp(zero, one)
    return u * u * (three - two * u)


def initial(x: Tensor) -> State:
    """Place both in the lane: speed [m/s] of both, gap [m], peak [m/s^2] and loss [m/s] of the lead's braking.

    Columns of theta: the lead's initial speed and loss, at most that speed [m/s], duration of the braking and time [s].
    """
    speed, gap, peak, loss = x.unbind(dim=1)
    zero = torch.zeros_like(gap)
    loss = torch.minimum(loss, speed)
    return State(
        x=columns(zero, gap + VEHICLE_LENGTH),
        y=columns(zero, zero),
        heading=columns(zero, zero),
        speed=columns(speed, speed),
        theta=columns(speed, loss, PARABOLA * loss / peak, zero),
    )


def others(state: State, dt: float) -> Others:
    """Move the lead, which brakes in a parabola from time 0 on."""
    speed, loss, duration, time = state.theta.unbind(dim=1)
    (tick,) = scalars((dt,), time)
    time = time + tick
    after = speed - loss * lost_share(time, duration)
    x = state.x[:, 1:] + state.speed[:, 1:] * tick
    theta = columns(speed, loss, duration, time)
    return Others(x, state.y[:, 1:], state.heading[:, 1:], after[:, None].expand_as(x), theta)


HARD_BRAKE = Scenario(
    name="hard_brake",
    road=straight(1),
    vehicle_names=("ego", "lead"),
    horizon=10.0,
    # Euro NCAP's points (50 km/h, gaps of 12 and 40 m, 2 and 6 m/s^2) are inside; a dry road allows about 10 m/s^2.
    parameters=(
        Parameter("speed", "m/s", 1.0, 45.0, "initial speed of both"),
        Parameter("gap", "m", 1.0, 150.0, "initial gap from ego to lead, bumper to bumper"),
        Parameter("peak", "m/s^2", 0.5, 10.0, "largest deceleration of the lead, in the middle of its braking"),
        Parameter("loss", "m/s", 1.0, 50.0, "speed that the lead loses; from its speed on it comes to a standstill"),
    ),
    bases=base_files("hard_brake", "us101"),
    initial=initial,
    others=others,
    driven=keep_lane,
)
