"""Measures along the road: times to collision and headways, braking, and exposure to short times to collision.

Values of a measure are (B,) for the B scenarios of a moment, finite and differentiable; sources stand with each.
"""

import torch
from torch import Tensor

from rare_envs.control.actions import MAX_ACCELERATION
from rare_envs.devices import are_zero, scalars
from rare_envs.measures.base import GAP_MIN, STILL, Moment, acceleration_of, find_obstacle, gap_of
from rare_envs.sensors.lidar import RANGE_COLUMNS, RATE_COLUMNS, beam_angles, find_vehicles_met
from rare_envs.traffic.bodies import lead_index
from rare_envs.traffic.state import STANDARD_GRAVITY, steering_for

TTC_MAX = 10.0
"""Cap of the time to collision [s]; what is further away, or not closing, counts as this."""
AT_START = 0.05
"""Share of the horizon up to which a short time to collision belongs to the start: cars that begin side by side fail in
other directions than those that come to it, 20 to 40 ticks later on the highway."""
_SQUARE = 1e-6
"""Cosines of angles of beams are taken as 0 within this, which is rounding."""


def ttc(moment: Moment) -> Tensor:
    """Return the time to collision (TTC) with the lead or the edge of the road, if speeds and headings stay.

    To the lead: gap / closing speed while closing. To the edge, which is a wall: way to it / speed across the road
    towards it; for an ego that drives straight there is none. The smaller of the two, at most `TTC_MAX`. Gaps are at
    least 1 cm: side by side with a vehicle that reaches into the lane the time is short but positive.

    Without the edge, f would not announce that an ego is about to leave the road, and methods that follow f downhill
    would miss that way to crash.

    Returns:
        Time to collision [s], in (0, TTC_MAX], shape (B,).

    References:
        Hayward, "Near-miss determination through use of a scale of danger", 1972.

    Example:
        >>> from rare_envs.measures import Moment
        >>> ttc(Moment.of_two(gap=25.0, speed=20.0, lead_speed=10.0)).item()
        2.5
    """
    to_lead = _time_to_lead(moment)
    if are_zero(moment.state.vehicles[0].heading):  # straight on there is no edge
        return to_lead.clamp_max(TTC_MAX)
    return torch.minimum(to_lead, time_to_edge(moment)).clamp_max(TTC_MAX)


def ttc_terms(moment: Moment) -> Tensor:
    """Return `ttc` by vehicle, where it is the lead, and to the edge of the road [s], shape (B, N)."""
    lead = lead_index(moment.state, moment.road)
    others = torch.arange(1, moment.state.x.shape[1], device=lead.device)
    to_lead = torch.where(lead[:, None] == others, _time_to_lead(moment)[:, None], TTC_MAX)
    return torch.cat((to_lead, time_to_edge(moment)[:, None]), 1).clamp(max=TTC_MAX)


def _time_to_lead(moment: Moment) -> Tensor:
    """Return gap / closing speed [s], without a cap, shape (B,)."""
    lead = moment.lead
    return lead.gap.clamp_min(GAP_MIN) / lead.closing_speed.clamp_min(STILL)


def time_to_edge(moment: Moment) -> Tensor:
    """Return way / speed across of the ego's centre to the road's edge [s], (B,); 20 000 s and less straight on."""
    state, road = moment.state, moment.road
    _, y, heading, speed = state.vehicles[0]
    middle, half = scalars((road.middle, road.lanes * road.width / 2), y)
    across = speed * torch.sin(heading)
    room = half - (y - middle) * torch.sign(across)
    return room.clamp_min(GAP_MIN) / across.abs().clamp_min(STILL)


def lidar_ttc(moment: Moment) -> Tensor:
    """Return the least time to collision along the ego's lidar beams: range / closing speed, at most 10 s, (B,).

    Beams start at the ego's centre: at contact 1 m is left at the side and 2.5 m ahead. In the code of O'Kelly et al.
    (2018, appendix A) beams that meet nothing and those that do not close count as infinite.
    """
    return _beam_times(moment).amin(dim=1).clamp(max=TTC_MAX)


def lidar_ttc_terms(moment: Moment) -> Tensor:
    """Return `lidar_ttc` of each vehicle that a beam meets ahead or square, then behind [s], (B, 2 (N - 1))."""
    times, vehicles = _beam_times(moment).clamp(max=TTC_MAX), moment.state.x.shape[1] - 1
    met = (find_vehicles_met(moment.state, moment.road) - 1).clamp(min=0)  # what meets nobody has `TTC_MAX`
    behind = torch.cos(beam_angles(times)) < -_SQUARE
    nothing = times.new_full((len(times), 2 * vehicles), TTC_MAX)
    return nothing.scatter_reduce(1, 2 * met + behind, times, "amin")


def name_lidar_terms(vehicle_names: tuple[str, ...]) -> tuple[str, ...]:
    """Return the names of `lidar_ttc_terms`."""
    return tuple(f"{vehicle}, {side}" for vehicle in vehicle_names[1:] for side in ("ahead", "behind"))


def _beam_times(moment: Moment) -> Tensor:
    """Return the time to collision along each beam of the ego [s], without a cap, shape (B, 20)."""
    assert moment.perception is not None
    ego = moment.perception[:, 0]
    closing = -ego[:, RATE_COLUMNS]
    return torch.where(closing > 0.0, ego[:, RANGE_COLUMNS] / closing.clamp(min=STILL), TTC_MAX)


def mttc(moment: Moment) -> Tensor:
    """Return the modified time to collision with the lead, in (0, 10] s: if both keep the last tick's accelerations.

    The least t > 0 with gap - dv t - da t^2 / 2 = 0: t = 2 gap / (dv + sqrt(dv^2 + 2 da gap)), with dv the closing
    speed and da the ego's acceleration less the lead's; none where the root is not real or the denominator not
    positive. As published, nobody stops (Ozbay, Yang, Bartin and Mudigonda, Transportation Research Record 2083, 2008).
    """
    gap, dv = gap_of(moment), moment.lead.closing_speed
    da = moment.acceleration[:, 0] - acceleration_of(moment, lead_index(moment.state, moment.road))
    square = dv.square() + 2.0 * da * gap
    real = square > 0
    denominator = dv + torch.where(real, square, 1.0).sqrt()
    meets = real & (denominator > 2.0 * gap / TTC_MAX)
    return torch.where(meets, 2.0 * gap / torch.where(meets, denominator, 1.0), TTC_MAX)


def thw(moment: Moment) -> Tensor:
    """Return the time headway, gap / speed, in (0, 10] s: until the ego is where its lead's rear bumper is now.

    SAE J2944 calls it the time gap. 2 s is taught, under 0.9 s is fined in Germany (Vogel, "A comparison of headway and
    time to collision as safety indicators", 2003).
    """
    return (gap_of(moment) / moment.state.speed[:, 0].clamp(min=STILL)).clamp(max=TTC_MAX)


MAX_BRAKING = MAX_ACCELERATION
"""The hardest braking that an action can ask for [m/s^2]."""
RAPID_BRAKING, RAPID_LATERAL = 0.5 * STANDARD_GRAVITY, 0.4 * STANDARD_GRAVITY
"""Braking and lateral acceleration above which a manoeuvre is rapid [m/s^2]; see `evasive_manoeuvre`."""
DECELERATION_MAX = 100.0
"""Cap of decelerations [m/s^2], ten times what tyres can do: with a centimetre left they would be in the thousands."""


def drac(moment: Moment) -> Tensor:
    """Return the deceleration rate to avoid a crash [m/s^2]: it just reaches the lead's speed when the gap is used up.

    closing speed^2 / (2 gap) while closing, else 0 (Almqvist, Hyden and Risser, Transportation Research Record 1318,
    1991; Archer, "Indicators for traffic safety assessment and prediction", 2005). Critical: 3.4 (AASHTO, 2004). It is
    that of the nearest vehicle ahead whose body overlaps the ego's across: beside it no braking is required.
    """
    gap, closing, _ = find_obstacle(moment)
    return (closing.clamp(min=0.0).square() / (2.0 * gap)).clamp(max=DECELERATION_MAX)


def required_deceleration(moment: Moment) -> Tensor:
    """Return the least constant deceleration with which the ego never reaches a lead that brakes on as it does [m/s^2].

    With b the deceleration of the lead over the last tick (0 if it speeds up), v the ego's speed, w the lead's and
    dv = v - w: b + dv^2 / (2 gap) where the speeds become equal while the lead moves (Jansson, "Collision avoidance
    theory with application to automotive collision mitigation", 2005); v^2 / (2 (gap + w^2 / (2 b))) where the lead
    stops first, which it does if 2 gap / dv > w / b or dv <= 0. The lead is that of `drac`: bodies overlap across.
    """
    (gap, dv, lead), speed = find_obstacle(moment), moment.state.speed[:, 0]
    lead_speed = (speed - dv).clamp(min=0.0)
    braking = (-acceleration_of(moment, lead)).clamp(min=0.0)
    rolling = braking + dv.clamp(min=0.0).square() / (2.0 * gap)
    # the ways are compared crosswise, without a division by what may be 0
    stops_first = (braking > 0) & ((dv <= 0) | (2.0 * gap * braking > lead_speed * dv))
    way = gap + lead_speed.square() / (2.0 * torch.where(stops_first, braking, 1.0))
    required = torch.where(stops_first, speed.square() / (2.0 * way), rolling)
    return required.clamp(max=DECELERATION_MAX)


def evasive_manoeuvre(moment: Moment) -> Tensor:
    """Return how rapid the ego's manoeuvre is, without unit, shape (B,): from 1 on it is a rapid one, needed or not.

    The greater of its braking over 0.5 g and its lateral acceleration, beyond that of the road's curve, over 0.4 g
    (VTTI, "Researcher dictionary for video reduction data" 1.3, 2012, variable 5; Dingus et al., DOT HS 810 593, 2006).
    Here only the ego counts, and all its braking; 0 at the start.
    """
    braking = -moment.acceleration[:, 0]
    turned = torch.zeros_like(braking)
    if moment.before is not None:
        turned = (moment.state.heading - moment.before.heading)[:, 0] / moment.dt
    lateral = (moment.state.speed[:, 0] * turned).abs()
    rapid = torch.maximum(braking / RAPID_BRAKING, lateral / RAPID_LATERAL)
    return rapid.clamp(0.0, DECELERATION_MAX / RAPID_BRAKING)


def avoid_rapid(speed: Tensor, acceleration: Tensor, steering: Tensor) -> tuple[Tensor, Tensor]:
    """Return acceleration [m/s^2] and steering angle [rad] without what `evasive_manoeuvre` calls rapid, (B,) each.

    Braking is limited to 0.5 g, lateral acceleration to 0.4 g, in a bend with that of the bend.
    """
    most = steering_for(RAPID_LATERAL / speed.clamp(min=STILL), speed)
    return acceleration.clamp(min=-RAPID_BRAKING), torch.minimum(torch.maximum(steering, -most), most)


def btn(moment: Moment, brakes: float = MAX_BRAKING) -> Tensor:
    """Return the brake threat number: the required deceleration over what the brakes can do [m/s^2] (Jansson, 2005)."""
    return required_deceleration(moment) / brakes


def ttb(moment: Moment, brakes: float = MAX_BRAKING) -> Tensor:
    """Return the time to brake: how long the ego can wait until it must brake fully for a lead that keeps its speed.

    gap / closing speed - closing speed / (2 brakes). Negative past the point of no return: by how much it is too late.
    The lead is that of `drac`: bodies overlap across.

    Args:
        moment: Of B scenarios.
        brakes: The hardest braking of the ego [m/s^2].

    Returns:
        Time to brake [s], in (-TTC_MAX, TTC_MAX], shape (B,).

    References:
        Hillenbrand, Spieker and Kroschel, "A multilevel collision mitigation approach: its situation assessment,
        decision making, and performance tradeoffs", IEEE Transactions on Intelligent Transportation Systems 7, 2006.

    Example:
        >>> from rare_envs.measures import Moment
        >>> ttb(Moment.of_two(gap=25.0, speed=20.0, lead_speed=10.0)).item()  # 25 / 10 - 10 / (2 5)
        1.5
    """
    gap, closing, _ = find_obstacle(moment)
    closing = closing.clamp(min=STILL)
    return (gap / closing - closing / (2.0 * brakes)).clamp(-0.99 * TTC_MAX, TTC_MAX)


TTC_CRITICAL = 3.0
"""Time to collision [s] under which an episode counts as exposed; Minderhoud and Bovy ("Extended time-to-collision
measures for road traffic safety assessment", 2001) look at up to 4 s."""


def tet(moment: Moment, threshold: float = TTC_CRITICAL) -> Tensor:
    """Return the integrand of the time exposed time-to-collision (TET), 1 if TTC is under its critical value [s]."""
    time = ttc(moment)
    return (time < threshold).to(time.dtype)


def tit(moment: Moment, threshold: float = TTC_CRITICAL) -> Tensor:
    """Return the integrand of the time integrated time-to-collision (TIT) [s]: TTC's way to the threshold."""
    return (threshold - ttc(moment)).clamp(min=0.0)
