"""Settings of rules of learned drivers that compiled rollouts know, without what they mean in detail."""

from __future__ import annotations

from typing import NamedTuple


class CloseRangeSettings(NamedTuple):
    """Numbers of what `agents.learned.collision_avoidance.CloseRange` adds, which says what they mean.

    Example:
        >>> from agents.learned.collision_avoidance import CloseRange
        >>> CloseRange().settings()
        CloseRangeSettings(closing_time=0.3, line_margin=0.4, path_margin=0.9)
    """

    closing_time: float
    line_margin: float
    path_margin: float


class LaneChangeSettings(NamedTuple):
    """Numbers of lane changes; `agents.learned.lane_changes` says what they mean.

    Example:
        >>> from agents.learned.lane_changes import LaneChanges
        >>> LaneChanges().settings().duration  # [s]
        3.7
    """

    constant: float
    """Coefficients of the hazard, likewise the next four."""
    right: float
    advantage: float
    approach: float
    speed: float
    duration: float
    spread: float
    accepted_gap: float
    accepted_time: float
    least_gap: float
    least_speed: float
    remembered: float
    foresight: float
    over_line: float
    frequency: float
    slow: float
    waits: float
    """1 if changes wait for a gap, else 0."""
    waiting_foresight: float
    """Of no meaning if they do not wait, likewise the next."""
    edge_margin: float
    bound: float
    """Greatest size of advantage and approach [m/s]."""
    usual_speed: float
    """[m/s]."""
    settled: float
    """Speed across at which a change may end [m/s]."""
    latest: float
    """Share of its time at which it ends anyway."""
    extreme: float
    """Greatest draw of a duration."""
    speed_divisor: float
    """Least speed to divide by [m/s]."""
    least_share: float
    """Of the way across."""
    overlap: float
    """How far before its line a point counts to the next lane [m]."""
    beyond: float
    """Share of a lane's width beyond the line that shows a lane."""
    along: float
    """Least cosine of beams whose range rate is taken for motion along the road."""
