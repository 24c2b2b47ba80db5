"""The lanes beside a vehicle, as far as its lidar shows them: who is ahead and behind there, and whether there is one.

Beams are 18 degrees apart, so that in the next lane a body is met for sure if it is within 8 m of the own middle, and
its rear or front up to 13 m. What is further along that lane stays unseen. A beam that meets its side finds the gap up
to 2 m too long.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from rare_envs.devices import constant
from rare_envs.sensors.lidar import FEATURES, HEADING_COLUMN, MAX_RANGE, RANGE_COLUMNS, RATE_COLUMNS, beam_angles

LENGTH_COLUMN, LEFT_MARKER_COLUMN, RIGHT_MARKER_COLUMN = (
    FEATURES.index(name) for name in ("length", "left_marker", "right_marker")
)
LINE_OVERLAP = 0.3
"""A point counts to the next lane if it is no further than this before its line [m]: bodies stand near the line too."""
SHOWS_LANE_BEYOND = 0.25
"""Share of a lane's width by which a point has to be beyond the line to show that there is a lane."""
LEAST_COSINE_ALONG = 0.25
"""Least cosine of beams whose range rate is taken for motion along the road."""


class AdjacentLanes(NamedTuple):
    """What is seen of the lanes to the left and to the right, shape (..., 2) each."""

    lead_gap: Tensor
    """Gap to the nearest body ahead in that lane [m], negative beside it, infinite if none is seen."""
    lead_closing: Tensor
    """Speed at which it closes [m/s], 0 if none is seen."""
    lag_gap: Tensor
    """Likewise of the nearest behind."""
    lag_closing: Tensor
    beyond: Tensor
    """Whether a body is seen beyond the line, so that there is a lane."""


def look_aside(features: Tensor) -> AdjacentLanes:
    """Return what features (..., 51) show of the lanes beside, differentiable.

    Example:
        >>> features = torch.zeros(51)
        >>> features[RANGE_COLUMNS], features[LENGTH_COLUMN] = MAX_RANGE, 5.0
        >>> features[LEFT_MARKER_COLUMN] = features[RIGHT_MARKER_COLUMN] = 1.8
        >>> features[FEATURES.index("range_18")], features[FEATURES.index("rate_18")] = 10.0, -1.902
        >>> seen = look_aside(features)
        >>> [round(value, 2) for value in seen.lead_gap.tolist()], round(seen.lead_closing[1].item(), 2)
        ([inf, 7.01], 2.0)
        >>> seen.beyond.tolist()
        [False, True]
    """
    ranges, beams = features[..., None, RANGE_COLUMNS], beam_angles(features)
    angle = beams + features[..., HEADING_COLUMN, None, None]
    side = constant((-1.0, 1.0), features)[:, None]
    along, across = ranges * torch.cos(angle), side * ranges * torch.sin(angle)
    line = torch.stack((features[..., LEFT_MARKER_COLUMN], features[..., RIGHT_MARKER_COLUMN]), dim=-1)[..., None]
    width = (features[..., LEFT_MARKER_COLUMN] + features[..., RIGHT_MARKER_COLUMN])[..., None, None]
    met = ranges < MAX_RANGE
    inside = met & (across > line - LINE_OVERLAP) & (across < line + width)
    cos = torch.cos(beams)
    known = cos.abs() > LEAST_COSINE_ALONG
    rate = torch.where(known, features[..., None, RATE_COLUMNS] / torch.where(known, cos, 1.0), 0.0).expand_as(across)
    half = 0.5 * features[..., LENGTH_COLUMN, None, None]
    lead = torch.where(inside & (along > 0.0), along - half, torch.inf).min(dim=-1)
    lag = torch.where(inside & (along <= 0.0), -along - half, torch.inf).min(dim=-1)
    lead_rate, lag_rate = (rate.gather(-1, each.indices[..., None])[..., 0] for each in (lead, lag))
    return AdjacentLanes(
        lead.values,
        torch.where(lead.values < torch.inf, -lead_rate, 0.0),
        lag.values,
        torch.where(lag.values < torch.inf, lag_rate, 0.0),
        (met & (across > line + SHOWS_LANE_BEYOND * width)).any(dim=-1),
    )
