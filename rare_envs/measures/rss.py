"""Responsibility-Sensitive Safety (RSS): distance less the safe distance, along and across the road.

References:
    Shalev-Shwartz, Shammah and Shashua, "On a formal model of safe and scalable self-driving cars", 2017: safe
    longitudinal distance (same direction), safe lateral distance, dangerous situation.
"""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from rare_envs.measures.moment import Moment
from rare_envs.traffic.pairs import least
from rare_envs.traffic.state import VEHICLE_LENGTH, VEHICLE_WIDTH

MARGIN_MAX = 1000.0
"""Cap of margins [m], where there is nobody."""


@dataclass(frozen=True)
class RSS:
    """Parameters of the model. The paper leaves them open; these are the starting values of Intel's ad-rss-lib.

    Example:
        >>> from functools import partial
        >>> from rare_envs.measures import Measure
        >>> stricter = Measure(partial(rss_margin, rss=RSS(response=2.0)), collision=-1000.0, unit="m")
        >>> stricter.of.keywords["rss"].brake_most
        8.0
    """

    response: float = 1.0
    """Response time rho of the ego [s]."""
    response_others: float = 2.0
    """Response time rho of the others [s]."""
    accelerate: float = 3.5
    """Largest acceleration during the response [m/s^2]."""
    brake_least: float = 4.0
    """Least braking of whoever follows [m/s^2]."""
    brake_most: float = 8.0
    """Hardest braking of whoever leads [m/s^2]."""
    swerve: float = 0.2
    """Largest lateral acceleration during the response [m/s^2]."""
    steady: float = 0.8
    """Least lateral braking after it [m/s^2]."""
    wander: float = 0.1
    """Lateral fluctuation mu [m]."""


class Margins(NamedTuple):
    """Distance less the safe one, of the ego and every other vehicle [m], shape (B, N - 1); too near if negative."""

    along: Tensor
    """Longitudinal: of whoever is behind, the ego or the other, to whoever is ahead."""
    across: Tensor
    """Lateral."""


def margins(moment: Moment, rss: RSS) -> Margins:
    """Return the margins of the ego with every other vehicle, along and across the road.

    d_along = [v_r rho + a rho^2 / 2 + (v_r + a rho)^2 / (2 b_least) - v_f^2 / (2 b_most)]+ with v_r the speed of the
    rear vehicle and v_f of the front one.

    d_across = mu + [(v1 + v1') / 2 rho + v1'^2 / (2 b) - (v2 + v2') / 2 rho + v2'^2 / (2 b)]+ with v1 and v2 the
    lateral speeds of the left and the right vehicle, positive to the right, v1' = v1 + a rho and v2' = v2 - a rho. The
    squares are ways towards the other: 0 here for a vehicle that still moves away after its response.

    Distances are those between boxes that are not turned. Vehicles that are level along the road (across it) have no
    distance there; who is ahead (on the right) is told by centres.
    """
    state = moment.state
    dx, dy = state.x[:, 1:] - state.x[:, :1], state.y[:, 1:] - state.y[:, :1]
    along, across = state.speed * torch.cos(state.heading), state.speed * torch.sin(state.heading)
    ahead, right = dx >= 0, dy >= 0
    rear, front = torch.where(ahead, along[:, :1], along[:, 1:]), torch.where(ahead, along[:, 1:], along[:, :1])
    response = torch.where(ahead, rss.response, rss.response_others)
    faster = rear + rss.accelerate * response
    way = (rear + faster) / 2 * response + faster.square() / (2 * rss.brake_least)
    safe_along = (way - front.square() / (2 * rss.brake_most)).clamp(min=0.0)
    side = torch.where(right, 1.0, -1.0)
    sway = _sway(across[:, :1] * side, rss.response, rss) + _sway(-across[:, 1:] * side, rss.response_others, rss)
    return Margins(
        (dx.abs() - VEHICLE_LENGTH).clamp(min=0.0) - safe_along,
        (dy.abs() - VEHICLE_WIDTH).clamp(min=0.0) - rss.wander - sway.clamp(min=0.0),
    )


def _sway(towards: Tensor, response: float, rss: RSS) -> Tensor:
    """Return the lateral way [m] until at rest of a vehicle that first accelerates towards the other."""
    faster = towards + rss.swerve * response
    return (towards + faster) / 2 * response + faster.clamp(min=0.0).square() / (2 * rss.steady)


def rss_longitudinal(moment: Moment, rss: RSS = RSS()) -> Tensor:
    """Return the longitudinal RSS margin: distance less the safe one, of vehicles whose lateral distance is not safe.

    Critical value: 0.

    Args:
        moment: Of B scenarios.
        rss: Parameters.

    Returns:
        The least margin over the other vehicles [m], shape (B,).

    Example:
        >>> from rare_envs.measures import Moment
        >>> moment = Moment.of_two(gap=60.0, speed=20.0, lead_speed=20.0)
        >>> round(rss_longitudinal(moment).item(), 3)  # 60 - (21.75 + 23.5^2 / 8 - 20^2 / 16)
        -5.781
    """
    of = margins(moment, rss)
    return least(torch.where(of.across < 0, of.along, MARGIN_MAX), MARGIN_MAX)


def rss_lateral(moment: Moment, rss: RSS = RSS()) -> Tensor:
    """Return the lateral RSS margin: distance less the safe one, of vehicles whose longitudinal distance is not safe.

    Critical value: 0.

    Args:
        moment: Of B scenarios.
        rss: Parameters.

    Returns:
        The least margin over the other vehicles [m], shape (B,).

    Example:
        >>> from rare_envs.measures import Moment
        >>> moment = Moment.of_two(gap=60.0, speed=20.0, lead_speed=20.0)
        >>> round(rss_lateral(moment).item(), 3)  # level across, and 0.725 m of safe distance
        -0.725
    """
    of = margins(moment, rss)
    return least(torch.where(of.along < 0, of.across, MARGIN_MAX), MARGIN_MAX)


def rss_margin(moment: Moment, rss: RSS = RSS()) -> Tensor:
    """Return the RSS margin: a situation is dangerous where neither distance to a vehicle is safe.

    The larger of the two margins with each vehicle, the least over vehicles: negative exactly in a dangerous situation.

    Critical value: 0.

    Args:
        moment: Of B scenarios.
        rss: Parameters.

    Returns:
        The margin [m], shape (B,).

    Example:
        >>> from rare_envs.measures import Moment
        >>> moment = Moment.of_two(gap=60.0, speed=20.0, lead_speed=20.0)
        >>> round(rss_margin(moment).item(), 3)  # the larger of both
        -0.725
    """
    return least(torch.maximum(*margins(moment, rss)), MARGIN_MAX)
