"""Measures in two dimensions: the ego and every other vehicle as oriented boxes in the plane."""

import torch
from torch import Tensor

from rare_envs.measures.moment import GAP_MIN, Moment
from rare_envs.measures.time_to_collision import TTC_MAX, time_to_edge
from rare_envs.traffic.oriented_boxes import box_distance, time_to_contact
from rare_envs.traffic.pairs import encounter, least

CLEARANCE_MAX = 1000.0
"""Cap of distances [m], where there is nobody."""
DRIFT = 0.2
"""Speed [m/s] with which `margin` expects any gap to close at least."""
TIME_MIN = 1e-3
"""Times to contact are floored here [s], so that only a collision comes to 0 or less."""


def ttc_2d(moment: Moment) -> Tensor:
    """Return the time until the ego's box touches that of any other vehicle, if velocities and headings stay.

    An exact swept test (`rare_envs.traffic.oriented_boxes.time_to_contact`) with every vehicle, whatever its lane, and
    the way to the edge of the road as in `ttc`; the least of them, at most `TTC_MAX`.

    Critical values: as for `ttc`, often 1.5 to 4 s.

    Args:
        moment: Of B scenarios.

    Returns:
        Time to collision [s], in (0, TTC_MAX], shape (B,).

    References:
        Hayward, "Near-miss determination through use of a scale of danger", 1972; Ericson, "Real-time collision
        detection", 2005, section 5.5 (separating axes of moving bodies).

    Example:
        >>> from rare_envs.measures import Moment
        >>> ttc_2d(Moment.of_two(gap=25.0, speed=20.0, lead_speed=10.0)).item()
        2.5
    """
    met = encounter(moment.state, moment.road)
    times = least(time_to_contact(met.axes, met.rate).clamp(min=TIME_MIN), TTC_MAX)
    return torch.minimum(times, time_to_edge(moment))


def clearance(moment: Moment) -> Tensor:
    """Return the exact distance between the ego's body and the nearest other.

    Critical value: none is agreed on; 0.5 m beside and 2 m ahead are small.

    Args:
        moment: Of B scenarios.

    Returns:
        Distance [m], in [0.01, CLEARANCE_MAX], shape (B,).

    Example:
        >>> from rare_envs.measures import Moment
        >>> clearance(Moment.of_two(gap=25.0, speed=20.0, lead_speed=10.0)).item()
        25.0
    """
    met = encounter(moment.state, moment.road)
    return least(box_distance(met.axes, met.turn).clamp(min=GAP_MIN), CLEARANCE_MAX)


def margin(moment: Moment) -> Tensor:
    """Return the uncapped time to contact; it also orders vehicles that do not approach.

    Along each of the four axes on which two boxes can be apart, the time in which the gap g closes at the rate c:
    2 g / (c + sqrt(c^2 + 4 d^2)) with d = `DRIFT`, about g / c where it closes, g / d where it stays, g |c| / d^2 where
    it opens. The bodies touch only once all gaps are closed: the largest of the four. The least of it over vehicles,
    and of the time to the edge of the road.

    It rises strictly with gaps and falls strictly with closing speeds, near and far, so levels and gradients go on
    where times to collision are capped. It is positive until contact; as a measure (`MEASURES["margin"]`) a collision
    comes to the negative speed at which the bodies met, so it goes on past contact too. It is ours: an order for
    samplers, not a quantity of the literature.

    Args:
        moment: Of B scenarios.

    Returns:
        Margin [s], positive, shape (B,).

    Example:
        >>> from rare_envs.measures import Moment
        >>> round(margin(Moment.of_two(gap=25.0, speed=20.0, lead_speed=10.0)).item(), 2)  # closing: about 25 / 10
        2.5
        >>> round(margin(Moment.of_two(gap=25.0, speed=20.0, lead_speed=20.0)).item(), 2)  # not closing: 25 / 0.2
        125.0
    """
    met = encounter(moment.state, moment.road)
    gap, closing = met.axes.gap, -met.rate * torch.sign(met.axes.offset)
    root = (closing.square() + 4.0 * DRIFT**2).sqrt()
    # the same fraction twice: each form loses its digits where the other keeps them
    slow = (root - closing) / (2.0 * DRIFT**2)
    inverse = torch.where(closing > 0, 2.0 / (root + closing.clamp(min=0.0)), slow)
    times = (gap.clamp(min=0.0) * inverse).amax(-1).clamp(min=TIME_MIN)
    return torch.minimum(least(times, torch.inf), time_to_edge(moment))
