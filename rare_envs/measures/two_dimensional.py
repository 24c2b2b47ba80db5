"""Measures in two dimensions: distances and times of oriented boxes, encroachment, and RSS.

References:
    Shalev-Shwartz, Shammah and Shashua, "On a formal model of safe and scalable self-driving cars", 2017: safe
    longitudinal distance (same direction), safe lateral distance, dangerous situation.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from rare_envs.measures.base import GAP_MIN, Moment, Trace
from rare_envs.measures.longitudinal import TTC_MAX, time_to_edge
from rare_envs.traffic.bodies import (
    Which,
    axes_of,
    box_distance,
    encounter,
    least,
    overlaps,
    pairs,
    time_to_contact,
)
from rare_envs.traffic.state import VEHICLE_LENGTH, VEHICLE_WIDTH

CLEARANCE_MAX = 1000.0
"""Cap of distances [m], if there is nobody."""
DRIFT = 0.2
"""Speed [m/s] with which `margin` expects any gap to close at least."""
EARLY_SHARE = 0.45
"""Share of the horizon up to which a small distance is an early one. On the highway 3 of 72 collisions among rollouts
from the traffic model came after tick 60 of 100: late drifts, from other directions than those at the start, which
a description of all together misses."""
TIME_MIN = 1e-3
"""Times to contact are floored here [s], so that only a collision comes to 0 or less."""


def contact_time_terms(moment: Moment) -> Tensor:
    """Return the time to contact with each other vehicle and with the edge of the road [s], shape (B, N)."""
    met = encounter(moment.state, moment.road)
    times = time_to_contact(met.axes, met.rate).clamp(TIME_MIN, TTC_MAX)
    return torch.cat((times, time_to_edge(moment)[:, None]), 1)


def ttc_2d(moment: Moment) -> Tensor:
    """Return the time until the ego's box touches any other or leaves the road, in (0, 10] s, velocities kept.

    An exact swept test with every vehicle (Hayward 1972; Ericson, "Real-time collision detection", 2005, section 5.5).
    """
    return contact_time_terms(moment).amin(1).clamp(max=TTC_MAX)


def distances(moment: Moment, which: Which = "ego") -> Tensor:
    """Return the distances of P pairs of vehicles [m], at most `CLEARANCE_MAX`, shape (B, P)."""
    met = encounter(moment.state, moment.road, which)
    return box_distance(met.axes, met.other_heading - met.heading).clamp(GAP_MIN, CLEARANCE_MAX)


def clearance(moment: Moment, which: Which = "ego") -> Tensor:
    """Return the exact distance between the ego's body and the nearest other [m], in [0.01, 1000], shape (B,)."""
    return least(distances(moment, which), CLEARANCE_MAX)


def margin_terms(moment: Moment) -> Tensor:
    """Return the margin to each other vehicle and to the edge of the road [s], shape (B, N)."""
    met = encounter(moment.state, moment.road)
    axes = met.axes
    closing = -met.rate * torch.sign(axes.offset)
    root = (closing.square() + 4.0 * DRIFT**2).sqrt()
    # the same fraction twice: each form loses its digits where the other keeps them
    slow = (root - closing) / (2.0 * DRIFT**2)
    inverse = torch.where(closing > 0, 2.0 / (root + closing.clamp(min=0.0)), slow)
    margins = (axes.gap.clamp(min=0.0) * inverse).amax(-1).clamp(min=TIME_MIN)
    return torch.cat((margins, time_to_edge(moment)[:, None]), 1)


def margin(moment: Moment) -> Tensor:
    """Return the uncapped time to contact [s], positive, shape (B,); it also orders vehicles that do not approach.

    Along each of the four axes on which two boxes can be apart, the time in which the gap g closes at the rate c, with
    d = `DRIFT`: 2 g / (c + sqrt(c^2 + 4 d^2)), about g / c where it closes, g / d where it stays, g |c| / d^2 where it
    opens. Bodies touch once all gaps are closed: the largest of the four, then the least over vehicles and the time to
    the edge. It is ours, an order for samplers: it rises with gaps and falls with closing speeds where others are
    capped, and a collision comes to the negative speed at which the bodies met.
    """
    return margin_terms(moment).amin(1)


def name_edge_terms(vehicle_names: tuple[str, ...]) -> tuple[str, ...]:
    """Return the names of terms of the other vehicles and of the edge of the road."""
    return (*vehicle_names[1:], "edge of the road")


def name_pairs(vehicle_names: tuple[str, ...]) -> tuple[str, ...]:
    """Return the names of all pairs of vehicles."""
    first, second = pairs(len(vehicle_names))
    return tuple(f"{vehicle_names[i]} and {vehicle_names[j]}" for i, j in zip(first, second, strict=True))


def find_vehicle_or_edge(moment: Moment) -> Tensor:
    """Return the number of the vehicle nearest to the ego, from 0, or N - 1 if it left the road and hit none, (B,)."""
    apart = ~overlaps(moment.state, moment.road).any(1)
    off = apart & moment.road.off_road(moment.state.y[:, 0])
    return torch.where(off, moment.state.x.shape[1] - 1, distances(moment).argmin(1))


def find_nearest_pair(moment: Moment) -> Tensor:
    """Return the number of the pair of vehicles that overlaps; if none does, of the nearest with the ego, (B,)."""
    of_pairs, own = distances(moment, "all"), moment.state.x.shape[1] - 1
    touching = overlaps(moment.state, moment.road, "all").any(1)
    return torch.where(touching, of_pairs.argmin(1), of_pairs[:, :own].argmin(1))


PET_MAX = 5.0
"""Cap of the post-encroachment time [s]; whoever comes later is no conflict."""
NEAR = 25.0
"""Centres further apart than this [m] are not looked at: no tick of delay brings bodies from there to contact."""
TERNARY_STEPS = 16
"""Steps of the search within a tick: to (2/3)^16 = 0.2 % of it."""
PET_MIN = 1e-3
"""And its floor [s], so that only a collision comes to 0 or less."""


def pet(trace: Trace) -> Tensor:
    """Return the post-encroachment time [s]: the least time between one body leaving a place and another taking it.

    For every delay the ego's body is compared with where the others were (or will be) that much earlier (or later), at
    all moments and on the straight ways between them; the least delay with an overlap is found to a fraction of a tick,
    from how far apart the bodies were one tick sooner. In (0, PET_MAX], shape (B,) (Allen, Shin and Cooper, "Analysis
    of traffic conflicts and collisions", 1978); under 1 s is a serious conflict.
    """
    x, y, heading = trace.road.to_world(trace.state.x, trace.state.y, trace.state.heading)
    pet = torch.full_like(x[0, :, 0], PET_MAX)
    rows = torch.arange(len(pet), device=x.device)  # those without an overlap so far
    last = min(len(x) - 1, round(PET_MAX / trace.dt))
    nearer = None  # separations at one tick of delay less
    for delay in range(last + 1):
        apart = _apart(x, y, heading, trace.valid, delay)
        if nearer is not None:
            # the later of the two moments stays, the earlier one is a tick further back
            sooner = nearer[:, 1:]
            share = sooner / (sooner - apart).clamp(min=1e-12)
            time = torch.where((apart <= 0) & (sooner > 0), (delay - 1 + share) * trace.dt, PET_MAX).amin((0, 1, 3))
            pet = pet.index_copy(0, rows, time.clamp(PET_MIN, PET_MAX))
            open_ = time >= PET_MAX
            rows = rows[open_]
            if not len(rows):
                break
            x, y, heading, apart = x[:, open_], y[:, open_], heading[:, open_], apart[:, :, open_]
            trace = trace._replace(valid=trace.valid[:, open_])
        nearer = apart
    return pet


def _apart(x: Tensor, y: Tensor, heading: Tensor, valid: Tensor, delay: int) -> Tensor:
    """Return how far apart bodies are at a delay [m], the ego second and first, the least since the last moment."""
    early, late = slice(0, len(x) - delay), slice(delay, len(x))

    def between(one: slice, other: slice) -> Tensor:
        dx, dy = x[other, :, 1:] - x[one, :, :1], y[other, :, 1:] - y[one, :, :1]
        return torch.stack((dx, dy, heading[one, :, :1].expand_as(dx), heading[other, :, 1:]))

    pose = torch.stack((between(late, early), between(early, late)), 1)  # (4, 2, T - delay, B, N - 1)
    near = pose[0].square() + pose[1].square() < NEAR**2
    apart = torch.full_like(pose[0], NEAR)
    apart[near] = axes_of(*pose[:, near]).gap.amax(-1)
    now, before = pose[:, :, 1:], pose[:, :, :-1]
    ends = torch.minimum(apart[:, 1:], apart[:, :-1])
    between_ticks = (ends > 0) & (ends < (now[:2] - before[:2]).abs().sum(0))
    if bool(between_ticks.any()):
        least = _least_between(before[:, between_ticks], now[:, between_ticks])
        apart[:, 1:][between_ticks] = torch.minimum(ends[between_ticks], least)
    return torch.where(valid[late, :, None], apart, NEAR)


def _least_between(before: Tensor, now: Tensor) -> Tensor:
    """Return the least separation on the straight ways between two poses (4, K), (K,): convex, by ternary search."""
    low, high = torch.zeros_like(now[0]), torch.ones_like(now[0])
    apart = torch.full_like(low, NEAR)
    for _ in range(TERNARY_STEPS):
        third = (high - low) / 3
        places = (torch.lerp(before, now, at) for at in (low + third, high - third))
        left, right = (axes_of(*place).gap.amax(-1) for place in places)
        low, high = torch.where(left > right, low + third, low), torch.where(left > right, high, high - third)
        apart = torch.minimum(left, right)
    return apart


MARGIN_MAX = 1000.0
"""Cap of margins [m], if there is nobody."""


@dataclass(frozen=True)
class RSS:
    """Parameters of the model. The paper leaves them open; these are the starting values of Intel's ad-rss-lib."""

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


def rss_margins(moment: Moment, rss: RSS) -> tuple[Tensor, Tensor]:
    """Return distance less the safe one of the ego and every other vehicle [m], along and across the road, (B, N - 1).

    d_along = [v_r rho + a rho^2 / 2 + (v_r + a rho)^2 / (2 b_least) - v_f^2 / (2 b_most)]+ with v_r the speed of the
    rear vehicle and v_f of the front one.

    d_across = mu + [(v1 + v1') / 2 rho + v1'^2 / (2 b) - (v2 + v2') / 2 rho + v2'^2 / (2 b)]+ with v1 and v2 the
    lateral speeds of the left and the right vehicle, positive to the right, v1' = v1 + a rho and v2' = v2 - a rho. The
    squares are ways towards the other: 0 here for a vehicle that still moves away after its response.

    Boxes are not turned; vehicles that are level have no distance there; who is ahead (on the right) centres tell.
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
    return (
        (dx.abs() - VEHICLE_LENGTH).clamp(min=0.0) - safe_along,
        (dy.abs() - VEHICLE_WIDTH).clamp(min=0.0) - rss.wander - sway.clamp(min=0.0),
    )


def _sway(towards: Tensor, response: float, rss: RSS) -> Tensor:
    """Return the lateral way [m] until at rest of a vehicle that first accelerates towards the other."""
    faster = towards + rss.swerve * response
    return (towards + faster) / 2 * response + faster.clamp(min=0.0).square() / (2 * rss.steady)


def rss_longitudinal(moment: Moment, rss: RSS = RSS()) -> Tensor:
    """Return the least longitudinal RSS margin [m], (B,), of the vehicles whose lateral distance is not safe."""
    along, across = rss_margins(moment, rss)
    return least(torch.where(across < 0, along, MARGIN_MAX), MARGIN_MAX)


def rss_lateral(moment: Moment, rss: RSS = RSS()) -> Tensor:
    """Return the least lateral RSS margin [m], (B,), of the vehicles whose longitudinal distance is not safe."""
    along, across = rss_margins(moment, rss)
    return least(torch.where(along < 0, across, MARGIN_MAX), MARGIN_MAX)


def rss_margin(moment: Moment, rss: RSS = RSS()) -> Tensor:
    """Return the RSS margin [m], (B,): the larger of both with a vehicle, the least over them; negative: danger."""
    return least(torch.maximum(*rss_margins(moment, rss)), MARGIN_MAX)
