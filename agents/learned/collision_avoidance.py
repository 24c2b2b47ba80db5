"""Collision avoidance: limits of a driver's actions, from what its lidar features tell.

References:
    Krauss, "Microscopic modeling of traffic flow", 1998, after Gipps, "A behavioural car-following
    model for computer simulation", 1981: the safe speed.
    Treiber and Kesting, "Traffic Flow Dynamics", 2013, chapter 11: the kinematic deceleration and usual values.
    AASHTO, "A Policy on Geometric Design of Highways and Streets", 2011, table 2-2: turning radius of a car.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor

from rare_envs.sensors.lidar import (
    FEATURES,
    HEADING_COLUMN,
    MAX_RANGE,
    RANGE_COLUMNS,
    RATE_COLUMNS,
    SPEED_COLUMN,
    beam_angles,
)

LEFT_MARKER_COLUMN, RIGHT_MARKER_COLUMN = FEATURES.index("left_marker"), FEATURES.index("right_marker")
_LENGTH, _WIDTH = FEATURES.index("length"), FEATURES.index("width")
_FORWARD, _SIDEWAYS, _ACROSS = 0.5, 0.3, 0.75
"""Least cosine of beams that look ahead (to 54 degrees), least sine of those that look aside (from 18), and of those
whose range rate is taken for lateral motion (from 54)."""
_LEAST_GAP, _LEAST_SPEED = 0.1, 1.0
"""Least divisors [m] and [m/s]."""


@dataclass(frozen=True)
class CollisionAvoidance:
    """Bounds of acceleration and yaw rate that keep off the vehicle ahead and off those beside.

    Ahead. Of each beam that meets a body in the vehicle's path, v is the own speed, g the gap to the point met, dv
    the closing speed and v_l = v - dv the speed ahead. With the safe speed of Krauss,

        v_safe = -b tau + sqrt((b tau)^2 + v_l^2 + 2 b (g - s0)),

    the acceleration is at most (v_safe - v) / T, but -b at the least; and at most -dv^2 / (2 (g - s1)), what is needed
    to reach the speed ahead within the gap, where that is harder than b.

    Beside. With the distance d across to the side of a body that is beside, closing at c, the yaw rate towards it is
    at most ((d - d0) / T_y - c) / (T_psi v), HighwayEnv's lateral controller towards a line d0 from it, and never
    less than 0: it is not steered towards, but nobody is steered away. Nor is a curve driven narrower than a car can.

    Near. Ahead, nearer than the standstill gap, who comes closer brakes by b + dv / `closing_time`, as if the other
    braked by b too, which the lidar does not show. Beams are 18 degrees apart, so of who stands on the line the one
    beside the middle meets the far end first: a point well within the own lane is in the path too. Beside, who moves
    towards a body that is too near is steered back, but never further than along the road. A beam that meets a corner
    tells nothing of lateral motion; there the own is taken.

    Both are upper bounds: where nobody is near, actions stay as they are.

    Raises:
        ValueError: If a setting is not a positive number.

    Example:
        >>> features = torch.zeros(1, 1, 51)
        >>> features[..., RANGE_COLUMNS] = MAX_RANGE
        >>> features[..., SPEED_COLUMN], features[..., _LENGTH], features[..., _WIDTH] = 20.0, 5.0, 2.0
        >>> rule = CollisionAvoidance()
        >>> rule.limit(features, torch.tensor([[[1.0, 0.0]]]))
        tensor([[[1., 0.]]])
        >>> features[..., FEATURES.index("range_0")], features[..., FEATURES.index("rate_0")] = 53.0, -20.0
        >>> rule.limit(features, torch.tensor([[[1.0, 0.0]]]))  # 20^2 / (2 (53 - 2.5 - 0.5))
        tensor([[[-4.,  0.]]])
    """

    deceleration: float = 2.0
    """b [m/s^2], comfortable: Treiber and Kesting have 1.5 for cars, Tian et al. 2.4 (`rare_envs.IDM`)."""
    reaction_time: float = 0.6
    """tau [s]: below it a follower at equal speed has to open the gap. Krauss has 1, which people fall below."""
    relaxation_time: float = 0.5
    """T [s]."""
    standstill_gap: float = 1.5
    """s0 [m]; Treiber and Kesting have 2."""
    least_gap: float = 0.5
    """s1 [m], what an emergency may leave."""
    hardest: float = 8.0
    """Hardest braking [m/s^2], about what tyres give on a dry road."""
    path_margin: float = 0.3
    """A point is in the path if it is no further than this beside the own body [m]."""
    clearance: float = 0.3
    """d0 [m]."""
    reach: float = 1.0
    """A point is beside if it is no further than this before or behind the own body [m]."""
    lateral_time: float = 0.6
    """T_y [s], HighwayEnv's time constant, as in `rare_envs.control.idm`."""
    heading_time: float = 0.2
    """T_psi [s], likewise."""
    turning_radius: float = 6.4
    """[m], of the middle of AASHTO's design vehicle P."""
    closing_time: float = 0.3
    """[s]; of .3 and .5, the one with fewer collisions on rings of 60 vehicles per km and lane."""
    line_margin: float = 0.4
    """How far within the own lane a point is at least [m]; with .2 hard brakes are a third more frequent."""
    lane_margin: float = 0.9
    """A point in the own lane is in the path if it is no further than this beside the own body [m]."""

    def __post_init__(self) -> None:
        check_positive(self, "collision avoidance")

    def limit(self, features: Tensor, action: Tensor) -> Tensor:
        """Return actions within the bounds, differentiable in both arguments.

        Args:
            features: What M vehicles in B scenarios perceive, shape (B, M, 51).
            action: Accelerations [m/s^2] and yaw rates [rad/s], shape (B, M, 2).

        Returns:
            Shape (B, M, 2).
        """
        acceleration = torch.minimum(action[..., 0], self.greatest_acceleration(features))
        left, right = self.greatest_yaw_rates(features)
        yaw_rate = torch.minimum(torch.maximum(action[..., 1], -left), right)
        return torch.stack((acceleration, yaw_rate), dim=-1)

    def greatest_acceleration(self, features: Tensor) -> Tensor:
        """Return the bound of the acceleration [m/s^2], infinite with nobody ahead, (B, M, 51) -> (B, M)."""
        speed, length = features[..., SPEED_COLUMN, None], features[..., _LENGTH, None]
        ranges, angle = features[..., RANGE_COLUMNS], beam_angles(features)
        ahead = torch.cos(angle) > _FORWARD
        gap, across = ranges * torch.cos(angle) - 0.5 * length, ranges * torch.sin(angle)
        in_path = ahead & (ranges < MAX_RANGE) & (gap > 0.0) & self._is_in_path(features, across)
        closing = -features[..., RATE_COLUMNS] / torch.where(ahead, torch.cos(angle), 1.0)
        bound = self.greatest_acceleration_behind(gap, closing, speed)
        return torch.where(in_path, bound, torch.inf).amin(dim=-1)

    def _is_in_path(self, features: Tensor, across: Tensor) -> Tensor:
        """Return whether points at some distances across, to the right positive, are in the path, (B, M, 20)."""
        beside = across.abs() - 0.5 * features[..., _WIDTH, None]
        left, right = features[..., LEFT_MARKER_COLUMN, None], features[..., RIGHT_MARKER_COLUMN, None]
        inside = torch.where(across < 0.0, left, right) - across.abs()
        in_lane = (inside > self.line_margin) & (beside < self.lane_margin)
        return (beside < self.path_margin) | in_lane

    def greatest_acceleration_behind(self, gap: Tensor, closing: Tensor, speed: Tensor) -> Tensor:
        """Return the bound of the acceleration [m/s^2] behind a body, for tensors of one shape.

        Args:
            gap: To the body [m].
            closing: Speed at which it closes [m/s].
            speed: The own [m/s].
        """
        b, lag = self.deceleration, self.deceleration * self.reaction_time
        room = 2.0 * b * (gap - self.standstill_gap).clamp(min=0.0) + (speed - closing).clamp(min=0.0).square()
        comfortable = ((lag * lag + room).sqrt() - lag - speed) / self.relaxation_time
        needed = closing.clamp(min=0.0).square() / (2.0 * (gap - self.least_gap).clamp(min=_LEAST_GAP))
        urgent = torch.where(needed > b, -needed.clamp(max=self.hardest), torch.inf)
        bound = torch.minimum(comfortable.clamp(min=-b), urgent)
        firm = -(b + closing.clamp(min=0.0) / self.closing_time).clamp(max=self.hardest)
        return torch.where((gap < self.standstill_gap) & (closing > 0.0), torch.minimum(bound, firm), bound)

    def greatest_yaw_rates(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Return the bounds of the yaw rate to the left and to the right [rad/s], shape (B, M).

        Both are 0 or more, but for who is steered back.
        """
        speed, length, width = (features[..., k, None] for k in (SPEED_COLUMN, _LENGTH, _WIDTH))
        ranges, angle = features[..., RANGE_COLUMNS], beam_angles(features)
        along, sin = ranges * torch.cos(angle), torch.sin(angle)
        beside = (ranges < MAX_RANGE) & (along.abs() < 0.5 * length + self.reach)
        sure = sin.abs() > _ACROSS
        own = self._speed_towards(features, sin)
        closing = torch.where(sure, -features[..., RATE_COLUMNS] / torch.where(sure, sin.abs(), 1.0), own)
        free = ranges * sin.abs() - 0.5 * width - self.clearance
        lag = self.heading_time * speed.clamp(min=_LEAST_SPEED)
        bound = torch.maximum((free / self.lateral_time - closing) / lag, -own / lag)
        narrowest = speed[..., 0].clamp(min=0.0) / self.turning_radius
        left, right = (
            torch.minimum(torch.where(beside & side, bound, torch.inf).amin(dim=-1), narrowest)
            for side in (sin < -_SIDEWAYS, sin > _SIDEWAYS)
        )
        return left, right

    def greatest_yaw_rates_within(self, features: Tensor, room: Tensor) -> tuple[Tensor, Tensor]:
        """Return the bounds of the yaw rate to the left and to the right [rad/s] that keep a vehicle within some room.

        That is HighwayEnv's lateral controller towards the end of the room. Unlike beside a body, bounds below 0 steer
        back as far as that takes.

        Args:
            features: What M vehicles in B scenarios perceive, shape (B, M, 51).
            room: How far across they may go to the left and to the right [m], shape (B, M, 2).

        Returns:
            Shape (B, M) each.
        """
        speed, heading = features[..., SPEED_COLUMN], features[..., HEADING_COLUMN]
        lag, across = self.heading_time * speed.clamp(min=_LEAST_SPEED), speed * torch.sin(heading)
        wanted = room / self.lateral_time
        return (wanted[..., 0] + across) / lag, (wanted[..., 1] - across) / lag

    def _speed_towards(self, features: Tensor, sin: Tensor) -> Tensor:
        """Return the own speed across towards the side of each beam [m/s], 0 or more, (B, M, 20)."""
        across = features[..., SPEED_COLUMN, None] * torch.sin(features[..., HEADING_COLUMN, None])
        return (sin.sign() * across).clamp(min=0.0)


def check_positive(settings: Any, of: str, but: tuple[str, ...] = ()) -> None:
    """Refuse a field that is not a positive number."""
    for each in fields(settings):
        value = getattr(settings, each.name)  # a field by its name
        if each.name in but:
            continue
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0.0 < value < math.inf:
            raise ValueError(f"Expected {each.name} of the {of} above 0, got {value!r}.")
