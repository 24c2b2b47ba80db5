"""Post-encroachment time: how soon after one vehicle another was in its place."""

import torch
from torch import Tensor

from rare_envs.measures.episode_trace import Trace
from rare_envs.traffic.oriented_boxes import axes_of, separation

PET_MAX = 5.0
"""Cap of the post-encroachment time [s]; whoever comes later is no conflict."""
NEAR = 25.0
"""Centres further apart than this [m] are not looked at: no tick of delay brings bodies from there to contact."""
TERNARY_STEPS = 16
"""Steps of the search within a tick: to (2/3)^16 = 0.2 % of it."""
PET_MIN = 1e-3
"""And its floor [s], so that only a collision comes to 0 or less."""


def pet(trace: Trace) -> Tensor:
    """Return the post-encroachment time (PET): the least time between one body leaving a place and another taking it.

    The place is ground that the bodies of the ego and of another vehicle both cover in the course of the episode,
    either of them first. For every delay the ego's body is compared with where the other was (or will be) that much
    earlier (or later), at all moments and on the straight ways between them. The least delay with an overlap is found
    to a fraction of a tick, from how far apart the bodies were one tick of delay sooner.

    Critical values: 1 to 1.5 s; under 1 s is a serious conflict.

    Args:
        trace: Of B episodes.

    Returns:
        Post-encroachment time [s], in (0, PET_MAX], over all other vehicles, shape (B,).

    References:
        Allen, Shin and Cooper, "Analysis of traffic conflicts and collisions", Transportation Research Record 667,
        1978.

    Example:
        >>> import rare_envs
        >>> problem = rare_envs.DrivingProblem("rare_envs/CarFollowing-v0", measure="pet", horizon=4.0)
        >>> problem.evaluate([[20.0, 20.0, 30.0]]).round(2).tolist()  # the lead's rear was there so long ago
        [1.55]
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
    """Return how far apart bodies are at a delay [m], the ego second and the ego first; `NEAR` where not driven.

    Of each moment the least since the moment before: for one delay both bodies move on together.

    Returns:
        Shape (2, T - delay, B, N - 1); by the later of the two moments.
    """
    early, late = slice(0, len(x) - delay), slice(delay, len(x))

    def between(one: slice, other: slice) -> Tensor:
        dx, dy = x[other, :, 1:] - x[one, :, :1], y[other, :, 1:] - y[one, :, :1]
        return torch.stack((dx, dy, heading[one, :, :1].expand_as(dx), heading[other, :, 1:]))

    pose = torch.stack((between(late, early), between(early, late)), 1)  # (4, 2, T - delay, B, N - 1)
    near = pose[0].square() + pose[1].square() < NEAR**2
    apart = torch.full_like(pose[0], NEAR)
    apart[near] = separation(axes_of(*pose[:, near]))
    now, before = pose[:, :, 1:], pose[:, :, :-1]
    ends = torch.minimum(apart[:, 1:], apart[:, :-1])
    between_ticks = (ends > 0) & (ends < (now[:2] - before[:2]).abs().sum(0))
    if bool(between_ticks.any()):
        least = _least_between(before[:, between_ticks], now[:, between_ticks])
        apart[:, 1:][between_ticks] = torch.minimum(ends[between_ticks], least)
    return torch.where(valid[late, :, None], apart, NEAR)


def _least_between(before: Tensor, now: Tensor) -> Tensor:
    """Return the least separation on the straight ways between two poses (4, K), shape (K,), by ternary search.

    The separation is a convex function of the time, so of two inner points the one that is further apart is left out.
    """
    low, high = torch.zeros_like(now[0]), torch.ones_like(now[0])
    apart = torch.full_like(low, NEAR)
    for _ in range(TERNARY_STEPS):
        third = (high - low) / 3
        left, right = (separation(axes_of(*torch.lerp(before, now, at))) for at in (low + third, high - third))
        low, high = torch.where(left > right, low + third, low), torch.where(left > right, high, high - third)
        apart = torch.minimum(left, right)
    return apart
