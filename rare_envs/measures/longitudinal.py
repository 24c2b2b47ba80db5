"""Measures along the road: times to collision and headways, braking, and exposure to short times to collision.

References:
    Minderhoud and Bovy, "Extended time-to-collision measures for road traffic safety assessment", Accident Analysis and
    Prevention 33, 2001 (exposure).
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from rare_envs.control.actions import MAX_ACCELERATION
from rare_envs.devices import are_zero, scalars
from rare_envs.measures.base import GAP_MIN, STILL, Measure, Moment, acceleration_of_lead, gap_of
from rare_envs.sensors.lidar import RANGE_COLUMNS, RATE_COLUMNS, beam_angles, find_vehicles_met
from rare_envs.traffic.bodies import lead_index
from rare_envs.traffic.state import STANDARD_GRAVITY

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
    """Return the time until the ego's centre leaves the road if speed and heading stay [s], shape (B,).

    Way to the edge / speed across the road towards it; without a cap, up to 20 000 s for an ego that drives straight.
    """
    state, road = moment.state, moment.road
    _, y, heading, speed = state.vehicles[0]
    middle, half = scalars((road.middle, road.lanes * road.width / 2), y)
    across = speed * torch.sin(heading)
    room = half - (y - middle) * torch.sign(across)
    return room.clamp_min(GAP_MIN) / across.abs().clamp_min(STILL)


def lidar_ttc(moment: Moment) -> Tensor:
    """Return the least time to collision along the ego's lidar beams: range / closing speed, at most 10 s.

    The beams start at the ego's centre, so at contact about 1 m is left at the side and 2.5 m ahead: small values come
    with violent contacts, side-swipes above all. The moment of a collision is not measured, and a collision is worth
    no more than the moments before it (`Measure.collision`). In the released code beams that meet nothing and those
    that do not close count as infinite; here everything is at most `TTC_MAX`.

    Returns:
        Time to collision [s], in [0, TTC_MAX], shape (B,).

    References:
        O'Kelly, Sinha, Namkoong, Duchi and Tedrake, "Scalable end-to-end autonomous vehicle testing via rare-event
        simulation", 2018, appendix A and released code.

    Example:
        >>> from rare_envs.measures import Moment
        >>> from rare_envs.sensors.lidar import perceive_traffic
        >>> moment = Moment.of_two(gap=25.0, speed=20.0, lead_speed=10.0)
        >>> seen = perceive_traffic(moment.state, moment.road)
        >>> lidar_ttc(moment._replace(perception=seen)).item()  # the beam starts 2.5 m behind the bumper
        2.75
    """
    return _beam_times(moment).amin(dim=1).clamp(max=TTC_MAX)


def lidar_ttc_terms(moment: Moment) -> Tensor:
    """Return `lidar_ttc` of each vehicle that a beam meets ahead, then behind [s], shape (B, 2 (N - 1)).

    Beams square to the ego look ahead. A vehicle that no beam meets has `TTC_MAX`.
    """
    times, vehicles = _beam_times(moment).clamp(max=TTC_MAX), moment.state.x.shape[1] - 1
    met = (find_vehicles_met(moment.state, moment.road) - 1).clamp(min=0)  # what meets nobody has `TTC_MAX`
    behind = torch.cos(beam_angles(times)) < -_SQUARE
    nothing = times.new_full((len(times), 2 * vehicles), TTC_MAX)
    return nothing.scatter_reduce(1, 2 * met + behind, times, "amin")


def name_lidar_terms(vehicle_names: tuple[str, ...]) -> tuple[str, ...]:
    """Return the names of `lidar_ttc_terms`."""
    return tuple(f"{vehicle}, {side}" for vehicle in vehicle_names[1:] for side in ("ahead", "behind"))


def name_edge_terms(vehicle_names: tuple[str, ...]) -> tuple[str, ...]:
    """Return the names of terms of the other vehicles and of the edge of the road."""
    return (*vehicle_names[1:], "edge of the road")


def _beam_times(moment: Moment) -> Tensor:
    """Return the time to collision along each beam of the ego [s], without a cap, shape (B, 20)."""
    assert moment.perception is not None
    ego = moment.perception[:, 0]
    closing = -ego[:, RATE_COLUMNS]
    return torch.where(closing > 0.0, ego[:, RANGE_COLUMNS] / closing.clamp(min=STILL), TTC_MAX)


def mttc(moment: Moment) -> Tensor:
    """Return the modified time to collision (MTTC) with the lead: if both keep their accelerations.

    The least t > 0 with gap - dv t - da t^2 / 2 = 0, dv the closing speed, da the ego's acceleration less the lead's:
    t = 2 gap / (dv + sqrt(dv^2 + 2 da gap)). There is none where the root is not real or the denominator not positive.
    Accelerations are those of the last tick, along the ego's heading. As published, nobody stops: speeds may pass 0.

    Critical values: as for the time to collision, often 1.5 to 4 s.

    Returns:
        Modified time to collision [s], in (0, TTC_MAX], shape (B,).

    References:
        Ozbay, Yang, Bartin and Mudigonda, "Derivation and validation of new simulation-based surrogate safety measure",
        Transportation Research Record 2083, 2008.

    Example:
        >>> from rare_envs.measures import Moment
        >>> moment = Moment.of_two(gap=20.0, speed=20.0, lead_speed=20.0)
        >>> faster = moment.state.speed + torch.tensor([0.0, 0.4])  # the lead brakes by 4 m/s^2
        >>> before = moment.state._replace(speed=faster)
        >>> round(mttc(moment._replace(before=before)).item(), 2)  # sqrt(2 20 / 4)
        3.16
    """
    gap, dv = gap_of(moment), moment.lead.closing_speed
    da = moment.acceleration[:, 0] - acceleration_of_lead(moment)
    square = dv.square() + 2.0 * da * gap
    real = square > 0
    denominator = dv + torch.where(real, square, 1.0).sqrt()
    meets = real & (denominator > 2.0 * gap / TTC_MAX)
    return torch.where(meets, 2.0 * gap / torch.where(meets, denominator, 1.0), TTC_MAX)


def thw(moment: Moment) -> Tensor:
    """Return the time headway (THW), gap / speed: how long until the ego is where its lead's rear bumper is now.

    SAE J2944 calls this the time gap and keeps "headway" for bumper-to-same-bumper, which would not be 0 in contact.

    Critical values: 2 s is taught to drivers, under 0.9 s is fined in Germany (Vogel, 2003).

    Returns:
        Time headway [s], in (0, TTC_MAX], shape (B,).

    References:
        Vogel, "A comparison of headway and time to collision as safety indicators", Accident Analysis and Prevention
        35, 2003.

    Example:
        >>> from rare_envs.measures import Moment
        >>> thw(Moment.of_two(gap=25.0, speed=20.0, lead_speed=10.0)).item()
        1.25
    """
    return (gap_of(moment) / moment.state.speed[:, 0].clamp(min=STILL)).clamp(max=TTC_MAX)


MAX_BRAKING = MAX_ACCELERATION
"""The hardest braking that an action can ask for [m/s^2]."""
RAPID_BRAKING, RAPID_LATERAL = 0.5 * STANDARD_GRAVITY, 0.4 * STANDARD_GRAVITY
"""Braking and lateral acceleration above which a manoeuvre is rapid [m/s^2]; see `evasive_manoeuvre`."""
DECELERATION_MAX = 100.0
"""Cap of decelerations [m/s^2], ten times what tyres can do: with a centimetre left they would be in the thousands."""


def drac(moment: Moment) -> Tensor:
    """Return the deceleration rate to avoid a crash (DRAC): it just reaches the lead's speed when the gap is used up.

    closing speed^2 / (2 gap) while closing, else 0; the lead keeps its speed.

    Critical value: 3.4 m/s^2, the deceleration that most drivers find comfortable (AASHTO, 2004).

    Returns:
        Deceleration [m/s^2], in [0, DECELERATION_MAX], shape (B,).

    References:
        Almqvist, Hyden and Risser, "Use of speed limiters in cars for increased safety and a better environment",
        Transportation Research Record 1318, 1991; Archer, "Indicators for traffic safety assessment and prediction",
        2005.

    Example:
        >>> from rare_envs.measures import Moment
        >>> drac(Moment.of_two(gap=25.0, speed=20.0, lead_speed=10.0)).item()
        2.0
    """
    closing = moment.lead.closing_speed.clamp(min=0.0)
    return (closing.square() / (2.0 * gap_of(moment))).clamp(max=DECELERATION_MAX)


def required_deceleration(moment: Moment) -> Tensor:
    """Return the least constant deceleration with which the ego never reaches a lead of constant acceleration.

    With b the deceleration of the lead over the last tick (b = 0 where it speeds up), v the ego's speed, w the lead's
    and dv = v - w, two cases. The speeds become equal while the lead still moves: b + dv^2 / (2 gap). The lead stops
    first, if 2 gap / dv > w / b or dv <= 0: v^2 / (2 (gap + w^2 / (2 b))). If b = 0 it is `drac`.

    Critical values: 3.4 m/s^2 is comfortable, above 8 m/s^2 a dry road gives no more.

    Returns:
        Deceleration [m/s^2], in [0, DECELERATION_MAX], shape (B,).

    References:
        Jansson, "Collision avoidance theory with application to automotive collision mitigation", 2005 (the first case,
        as the required longitudinal acceleration).

    Example:
        >>> from rare_envs.measures import Moment
        >>> moment = Moment.of_two(gap=25.0, speed=20.0, lead_speed=20.0)
        >>> faster = moment.state.speed + torch.tensor([0.0, 0.4])  # the lead brakes by 4 m/s^2
        >>> before = moment.state._replace(speed=faster)
        >>> round(required_deceleration(moment._replace(before=before)).item(), 2)  # 20^2 / (2 (25 + 20^2 / 8))
        2.67
    """
    gap, dv, speed = gap_of(moment), moment.lead.closing_speed, moment.state.speed[:, 0]
    lead_speed = (speed - dv).clamp(min=0.0)
    braking = (-acceleration_of_lead(moment)).clamp(min=0.0)
    rolling = braking + dv.clamp(min=0.0).square() / (2.0 * gap)
    # the ways are compared crosswise, without a division by what may be 0
    stops_first = (braking > 0) & ((dv <= 0) | (2.0 * gap * braking > lead_speed * dv))
    way = gap + lead_speed.square() / (2.0 * torch.where(stops_first, braking, 1.0))
    required = torch.where(stops_first, speed.square() / (2.0 * way), rolling)
    return required.clamp(max=DECELERATION_MAX)


def evasive_manoeuvre(moment: Moment) -> Tensor:
    """Return how rapid the ego's evasive manoeuvre is, without unit, shape (B,): 1 and more makes a near-crash.

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


def btn(moment: Moment, brakes: float = MAX_BRAKING) -> Tensor:
    """Return the brake threat number (BTN): the required deceleration as a share of what the brakes can do.

    Critical value: 1, above which braking alone cannot prevent the collision.

    Args:
        moment: Of B scenarios.
        brakes: The hardest braking of the ego [m/s^2].

    Returns:
        Brake threat number, in [0, DECELERATION_MAX / brakes], shape (B,).

    References:
        Jansson, "Collision avoidance theory with application to automotive collision mitigation", 2005.

    Example:
        >>> from rare_envs.measures import Moment
        >>> round(btn(Moment.of_two(gap=25.0, speed=20.0, lead_speed=10.0)).item(), 3)  # 2 of 5 m/s^2
        0.4
    """
    return required_deceleration(moment) / brakes


def ttb(moment: Moment, brakes: float = MAX_BRAKING) -> Tensor:
    """Return the time to brake (TTB): how long the ego can wait until it must brake fully for its lead.

    The lead keeps its speed.

    gap / closing speed - closing speed / (2 brakes). Negative past the point of no return: by how much it is too late.

    Critical value: 0, the point of no return.

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
    closing = moment.lead.closing_speed.clamp(min=STILL)
    return (gap_of(moment) / closing - closing / (2.0 * brakes)).clamp(-0.99 * TTC_MAX, TTC_MAX)


TTC_CRITICAL = 3.0
"""Time to collision [s] under which an episode counts as exposed; Minderhoud and Bovy look at up to 4 s."""
EXPOSURE_MAX = 1000.0
"""Cap of what is added up [s or s^2]."""


@dataclass(frozen=True)
class Exposure(Measure):
    """A measure that adds up over an episode: f is the critical value less the time integral of `of`.

    The integral is a sum of rectangles of one tick.

    Example:
        >>> import rare_envs
        >>> slow = Exposure(lambda moment: (moment.state.speed[:, 0] < 19.9).float(), critical=2.0)
        >>> problem = rare_envs.DrivingProblem("rare_envs/CarFollowing-v0", measure=slow)
        >>> problem.evaluate([[20.0, 10.0, 150.0]]).round(1).tolist()  # 6.5 s of the 10 s
        [-4.5]
    """

    critical: float = 1.0

    def start(self, moment: Moment, ticks: int) -> Tensor:
        """Return the critical value: nothing has been added up yet."""
        return torch.full_like(moment.state.x[:, 0], self.critical)

    def update(self, state: Tensor, moment: Moment, before: Tensor, now: Tensor) -> Tensor:
        """Return f less one more tick."""
        f = (state - self.of(moment) * moment.dt).clamp(min=self.critical - EXPOSURE_MAX)
        return self._with_collisions(state, f, moment, before, now)


def tet(moment: Moment, threshold: float = TTC_CRITICAL) -> Tensor:
    """Return the integrand of the time exposed time-to-collision (TET), 1 where TTC is under its critical value.

    TET is the time for which TTC < threshold: the sum of the lengths of such ticks. The integrand is a step of TTC, so
    its gradient is 0.

    Critical value: 3 s of TTC is the threshold here; that an episode has failed with 1 s under it is our choice.

    Args:
        moment: Of B scenarios.
        threshold: Critical time to collision [s].

    Returns:
        Share of the moment that is exposed, 0 or 1, shape (B,).

    Example:
        >>> from rare_envs.measures import Moment
        >>> tet(Moment.of_two(gap=25.0, speed=20.0, lead_speed=10.0)).item()  # TTC 2.5 s
        1.0
    """
    time = ttc(moment)
    return (time < threshold).to(time.dtype)


def tit(moment: Moment, threshold: float = TTC_CRITICAL) -> Tensor:
    """Return the integrand of the time integrated time-to-collision (TIT), by how much TTC is under its critical value.

    TIT is the area between the threshold and the TTC under it: the sum over ticks of (threshold - TTC) times their
    length where TTC < threshold.

    Critical value: 3 s of TTC is the threshold here; that an episode has failed with 1 s^2 is our choice.

    Args:
        moment: Of B scenarios.
        threshold: Critical time to collision [s].

    Returns:
        By how much TTC is under the threshold [s], shape (B,).

    Example:
        >>> from rare_envs.measures import Moment
        >>> tit(Moment.of_two(gap=25.0, speed=20.0, lead_speed=10.0)).item()  # TTC 2.5 s
        0.5
    """
    return (threshold - ttc(moment)).clamp(min=0.0)
