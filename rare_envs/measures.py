"""Safety measures: how close a state is to a collision; small is dangerous, always finite."""

from collections.abc import Callable
from types import MappingProxyType

from torch import Tensor

from rare_envs.geometry import Lead
from rare_envs.state import State

TTC_MAX = 10.0
"""Cap of the time to collision [s]; what is further away, or not closing, counts as this."""
COLLISION = -1.0
"""The value of every measure in a collision (Tian et al. 2024, equation 3)."""
_GAP_MIN = 0.01
"""Gaps are floored here [m] so that only a collision, never a narrow escape, comes to 0 or less."""

Measure = Callable[[State, Lead], Tensor]


def ttc(state: State, lead: Lead) -> Tensor:
    """Time to collision of the ego with its lead if both keep their speeds.

    gap / closing speed while closing, at most `TTC_MAX`, and `TTC_MAX` when not closing. The gap is at least 1 cm:
    side by side with a vehicle that reaches into the lane the time is short but positive.

    Args:
        state: Traffic of B scenarios.
        lead: The ego's lead.

    Returns:
        Time to collision [s], in (0, TTC_MAX], shape (B,).

    References:
        Hayward, "Near-miss determination through use of a scale of danger", 1972.
    """
    # a closing speed floored far below gap_min / TTC_MAX leaves every value under the cap untouched
    return (lead.gap.clamp(min=_GAP_MIN) / lead.closing_speed.clamp(min=1e-4)).clamp(max=TTC_MAX)


MEASURES: MappingProxyType[str, Measure] = MappingProxyType({"ttc": ttc})
