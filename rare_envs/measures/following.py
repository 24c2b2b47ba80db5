"""Time to collision of the ego with what is ahead of it: its lead, the edge of the road, what its lidar meets."""

import torch
from torch import Tensor

from rare_envs.measures.moment import Moment
from rare_envs.perception import RANGES, RATES

TTC_MAX = 10.0
"""Cap of the time to collision [s]; what is further away, or not closing, counts as this."""
_GAP_MIN = 0.01
"""Gaps are floored here [m] so that only a collision, never a narrow escape, comes to 0 or less."""

_STILL = 1e-4
"""Closing speeds are floored here [m/s], far below gap / TTC_MAX, so no value under the cap changes."""


def ttc(moment: Moment) -> Tensor:
    """Time to collision of the ego with its lead, or with the edge of the road, if speeds and headings stay.

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
    """
    state, lead, road = moment.state, moment.lead, moment.road
    to_lead = lead.gap.clamp(min=_GAP_MIN) / lead.closing_speed.clamp(min=_STILL)
    across = state.speed[:, 0] * torch.sin(state.heading[:, 0])
    offset = state.y[:, 0] - road.middle
    room = road.lanes * road.width / 2 - offset * torch.sign(across)
    to_edge = room.clamp(min=_GAP_MIN) / across.abs().clamp(min=_STILL)
    return torch.minimum(to_lead, to_edge).clamp(max=TTC_MAX)


def lidar_ttc(moment: Moment) -> Tensor:
    """Least time to collision along the ego's lidar beams: range / closing speed of each that closes, at most 10 s.

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
    """
    assert moment.perception is not None
    ego = moment.perception[:, 0]
    closing = -ego[:, RATES]
    time = torch.where(closing > 0.0, ego[:, RANGES] / closing.clamp(min=_STILL), TTC_MAX)
    return time.amin(dim=1).clamp(max=TTC_MAX)
