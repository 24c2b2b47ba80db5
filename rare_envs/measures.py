"""Safety measures: how close a state is to a collision; small is dangerous, always finite."""

from collections.abc import Callable
from types import MappingProxyType

import torch
from torch import Tensor

from rare_envs.geometry import Lead
from rare_envs.road import Road
from rare_envs.state import State

TTC_MAX = 10.0
"""Cap of the time to collision [s]; what is further away, or not closing, counts as this."""
COLLISION = -1.0
"""The value of every measure in a collision (Tian et al. 2024, equation 3)."""
_GAP_MIN = 0.01
"""Gaps are floored here [m] so that only a collision, never a narrow escape, comes to 0 or less."""

_STILL = 1e-4
"""Closing speeds are floored here [m/s], far below gap / TTC_MAX, so no value under the cap changes."""

Measure = Callable[[State, Lead, Road], Tensor]
"""State, the ego's lead and the road to shape (B,)."""


def ttc(state: State, lead: Lead, road: Road) -> Tensor:
    """Time to collision of the ego with its lead, or with the edge of the road, if speeds and headings stay.

    To the lead: gap / closing speed while closing. To the edge, which is a wall: way to it / speed across the road
    towards it; for an ego that drives straight there is none. The smaller of the two, at most `TTC_MAX`. Gaps are at
    least 1 cm: side by side with a vehicle that reaches into the lane the time is short but positive.

    Without the edge, f would not announce that an ego is about to leave the road, and methods that follow f downhill
    would miss that way to crash.

    Args:
        state: Traffic of B scenarios.
        lead: The ego's lead.
        road: Their road.

    Returns:
        Time to collision [s], in (0, TTC_MAX], shape (B,).

    References:
        Hayward, "Near-miss determination through use of a scale of danger", 1972.
    """
    to_lead = lead.gap.clamp(min=_GAP_MIN) / lead.closing_speed.clamp(min=_STILL)
    across = state.speed[:, 0] * torch.sin(state.heading[:, 0])
    offset = state.y[:, 0] - road.middle
    room = road.lanes * road.width / 2 - offset * torch.sign(across)
    to_edge = room.clamp(min=_GAP_MIN) / across.abs().clamp(min=_STILL)
    return torch.minimum(to_lead, to_edge).clamp(max=TTC_MAX)


MEASURES: MappingProxyType[str, Measure] = MappingProxyType({"ttc": ttc})
