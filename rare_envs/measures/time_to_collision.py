"""Times to collision of the ego: with its lead, with the edge of the road, with the bodies that its lidar meets."""

import torch
from torch import Tensor

from rare_envs.devices import are_zero, scalars
from rare_envs.measures.moment import GAP_MIN, STILL, Moment, acceleration_of_lead, gap_of
from rare_envs.sensors.lidar import beam_angles
from rare_envs.sensors.perception import RANGE_COLUMNS, RATE_COLUMNS, find_vehicles_met
from rare_envs.traffic.lead import lead_index

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

    Args:
        moment: Of B scenarios.

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

    Args:
        moment: Of B scenarios.

    Returns:
        Time to collision [s], in [0, TTC_MAX], shape (B,).

    References:
        O'Kelly, Sinha, Namkoong, Duchi and Tedrake, "Scalable end-to-end autonomous vehicle testing via rare-event
        simulation", 2018, appendix A and released code.

    Example:
        >>> from rare_envs.measures import Moment
        >>> from rare_envs.sensors.perception import perceive_traffic
        >>> moment = Moment.of_two(gap=25.0, speed=20.0, lead_speed=10.0)
        >>> seen = perceive_traffic(moment.state, moment.road)
        >>> lidar_ttc(moment._replace(perception=seen)).item()  # the beam starts 2.5 m behind the bumper
        2.75
    """
    return _beam_times(moment).amin(dim=1).clamp(max=TTC_MAX)


def lidar_ttc_terms(moment: Moment) -> Tensor:
    """Return `lidar_ttc` by vehicle that a beam meets, and by whether that beam looks ahead or behind.

    Beams square to the ego look ahead. A vehicle that no beam meets has `TTC_MAX`.

    Args:
        moment: Of B scenarios.

    Returns:
        Time to collision [s], shape (B, 2 (N - 1)): of each vehicle ahead, then behind.
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

    Args:
        moment: Of B scenarios.

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

    Args:
        moment: Of B scenarios.

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
