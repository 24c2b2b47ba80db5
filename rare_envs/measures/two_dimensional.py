"""Measures in two dimensions: the ego and every other vehicle as oriented boxes in the plane."""

import torch
from torch import Tensor

from rare_envs.measures.moment import GAP_MIN, Moment
from rare_envs.measures.time_to_collision import TTC_MAX, time_to_edge
from rare_envs.traffic.oriented_boxes import box_distance, time_to_contact
from rare_envs.traffic.overlap import ego_overlaps, pairwise_overlaps
from rare_envs.traffic.pairs import Encounter, encounter, encounters_of_all, least, pairs

CLEARANCE_MAX = 1000.0
"""Cap of distances [m], where there is nobody."""
DRIFT = 0.2
"""Speed [m/s] with which `margin` expects any gap to close at least."""
EARLY_SHARE = 0.45
"""Share of the horizon up to which a small distance is an early one. On the highway 3 of 72 collisions among rollouts
from the base distribution came after tick 60 of 100: late drifts, from other directions than those at the start, which
a description of all together misses."""
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
    return torch.minimum(least(_contact_times(moment), TTC_MAX), time_to_edge(moment))


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
    return least(_distances(encounter(moment.state, moment.road)), CLEARANCE_MAX)


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
    return torch.minimum(least(_margins(moment), torch.inf), time_to_edge(moment))


def contact_time_terms(moment: Moment) -> Tensor:
    """Return the time to contact with each other vehicle and with the edge of the road [s], shape (B, N)."""
    times = _contact_times(moment).clamp(max=TTC_MAX)
    return torch.cat((times, time_to_edge(moment)[:, None]), 1)


def clearance_terms(moment: Moment) -> Tensor:
    """Return the distance to each other vehicle [m], at most `CLEARANCE_MAX`, shape (B, N - 1)."""
    return _distances(encounter(moment.state, moment.road)).clamp(max=CLEARANCE_MAX)


def pair_clearance_terms(moment: Moment) -> Tensor:
    """Return the distance of the vehicles of each pair [m], those with the ego first, shape (B, N (N - 1) / 2)."""
    return _distances(encounters_of_all(moment.state, moment.road)).clamp(max=CLEARANCE_MAX)


def pair_clearance(moment: Moment) -> Tensor:
    """Return the distance of the two vehicles that are nearest to each other [m], the ego or not, shape (B,)."""
    return pair_clearance_terms(moment).amin(1)


def name_pairs(vehicle_names: tuple[str, ...]) -> tuple[str, ...]:
    """Return the names of `pair_clearance_terms`."""
    first, second = pairs(len(vehicle_names))
    return tuple(f"{vehicle_names[i]} and {vehicle_names[j]}" for i, j in zip(first, second, strict=True))


def margin_terms(moment: Moment) -> Tensor:
    """Return the margin to each other vehicle and to the edge of the road [s], shape (B, N)."""
    return torch.cat((_margins(moment), time_to_edge(moment)[:, None]), 1)


def find_vehicle_or_edge(moment: Moment) -> Tensor:
    """Return the number of the vehicle, from 0, that is nearest to the ego, and N - 1 where it has left the road, (B,).

    An ego that overlaps a vehicle has hit that vehicle, wherever it is.
    """
    apart = ~ego_overlaps(moment.state, moment.road).any(1)
    off = apart & moment.road.off_road(moment.state.y[:, 0])
    return torch.where(off, moment.state.x.shape[1] - 1, clearance_terms(moment).argmin(1))


def find_nearest_pair(moment: Moment) -> Tensor:
    """Return the number of the pair of vehicles that overlaps; where none does, of the nearest with the ego, (B,)."""
    distances, own = pair_clearance_terms(moment), moment.state.x.shape[1] - 1
    touching = pairwise_overlaps(moment.state, moment.road).flatten(1).any(1)
    return torch.where(touching, distances.argmin(1), distances[:, :own].argmin(1))


def _contact_times(moment: Moment) -> Tensor:
    """Return the time to contact with each other vehicle [s], without a cap, shape (B, N - 1)."""
    met = encounter(moment.state, moment.road)
    return time_to_contact(met.axes, met.rate).clamp(min=TIME_MIN)


def _distances(met: Encounter) -> Tensor:
    """Return the distance of P pairs [m], shape (B, P)."""
    return box_distance(met.axes, met.turn).clamp(min=GAP_MIN)


def _margins(moment: Moment) -> Tensor:
    """Return the margin to each other vehicle [s], shape (B, N - 1)."""
    met = encounter(moment.state, moment.road)
    gap, closing = met.axes.gap, -met.rate * torch.sign(met.axes.offset)
    root = (closing.square() + 4.0 * DRIFT**2).sqrt()
    # the same fraction twice: each form loses its digits where the other keeps them
    slow = (root - closing) / (2.0 * DRIFT**2)
    inverse = torch.where(closing > 0, 2.0 / (root + closing.clamp(min=0.0)), slow)
    return (gap.clamp(min=0.0) * inverse).amax(-1).clamp(min=TIME_MIN)
