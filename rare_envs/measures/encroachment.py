"""Post-encroachment time: how soon after one vehicle another was in its place."""

import torch
from torch import Tensor

from rare_envs.boxes import axes_of, separation
from rare_envs.measures.trace import Trace

PET_MAX = 5.0
"""Cap of the post-encroachment time [s]; whoever comes later is no conflict."""
NEAR = 25.0
"""Centres further apart than this [m] are not looked at: no tick of delay brings bodies from there to contact."""
PET_MIN = 1e-3
"""And its floor [s], so that only a collision comes to 0 or less."""


def pet(trace: Trace) -> Tensor:
    """Post-encroachment time: the least time between one vehicle leaving a place and another taking it.

    The place is ground that the bodies of the ego and of another vehicle both cover in the course of the episode,
    either of them first. For every delay the ego's body at each moment is compared with where the other was (or will
    be) that much earlier (or later); the least delay with an overlap is found to a fraction of a tick from how far
    apart the bodies were one tick of delay sooner. Exact where vehicles move straight at constant speed.

    Critical values: 1 to 1.5 s; under 1 s is a serious conflict.

    Args:
        trace: Of B episodes.

    Returns:
        Post-encroachment time [s], in (0, PET_MAX], over all other vehicles, shape (B,).

    References:
        Allen, Shin and Cooper, "Analysis of traffic conflicts and collisions", Transportation Research Record 667,
        1978.
    """
    x, y, heading = trace.road.to_world(trace.state.x, trace.state.y, trace.state.heading)
    found = torch.full_like(x[0, :, 0], PET_MAX)
    rows = torch.arange(len(found), device=x.device)  # those without an overlap so far
    last = min(len(x) - 1, round(PET_MAX / trace.dt))
    nearer = None  # separations at one tick of delay less
    for delay in range(last + 1):
        apart = _apart(x, y, heading, trace.valid, delay)
        if nearer is not None:
            # the later of the two moments stays, the earlier one is a tick further back
            sooner = nearer[:, 1:]
            share = sooner / (sooner - apart).clamp(min=1e-12)
            time = torch.where((apart <= 0) & (sooner > 0), (delay - 1 + share) * trace.dt, PET_MAX).amin((0, 1, 3))
            found = found.index_copy(0, rows, time.clamp(PET_MIN, PET_MAX))
            open_ = time >= PET_MAX
            rows = rows[open_]
            if not len(rows):
                break
            x, y, heading, apart = x[:, open_], y[:, open_], heading[:, open_], apart[:, :, open_]
            trace = trace._replace(valid=trace.valid[:, open_])
        nearer = apart
    return found


def _apart(x: Tensor, y: Tensor, heading: Tensor, valid: Tensor, delay: int) -> Tensor:
    """Separations of bodies `delay` ticks apart in time [m], the ego second and the ego first; inf where not driven.

    Returns:
        Shape (2, T - delay, B, N - 1); by the later of the two moments.
    """
    early, late = slice(0, len(x) - delay), slice(delay, len(x))

    def between(one: slice, other: slice) -> Tensor:
        dx, dy = x[other, :, 1:] - x[one, :, :1], y[other, :, 1:] - y[one, :, :1]
        near = dx.square() + dy.square() < NEAR**2
        apart = torch.full_like(dx, NEAR)
        ego, its = heading[one, :, :1].expand_as(dx)[near], heading[other, :, 1:][near]
        apart[near] = separation(axes_of(dx[near], dy[near], ego, its))
        return apart

    both = torch.stack((between(late, early), between(early, late)))
    return torch.where(valid[late, :, None], both, torch.inf)
