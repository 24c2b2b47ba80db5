"""Step of an environment: one decision of the policy, and the ticks until the next."""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from rare_envs.control.actions import IDLE
from rare_envs.simulation.episode import Episode
from rare_envs.simulation.reward import RewardTerms, reward_terms
from rare_envs.simulation.world import World
from rare_envs.traffic.lead import Lead
from rare_envs.traffic.state import State


class StepResult(NamedTuple):
    """Result of a decision in B episodes."""

    episode: Episode
    """After it; those with a collision stay as they were in its tick."""
    terms: RewardTerms
    """Terms of the reward, shape (B,) each: their mean over the ticks, where ticks after a collision count as 0."""


def advance(
    world: World,
    episode: Episode,
    action: Tensor,
    commanded: Tensor | None = None,
    watch: Callable[[Episode], None] | None = None,
) -> StepResult:
    """Carry out a decision.

    A continuous action lasts one tick. A meta-action lasts a second: it is given to the controllers once, which then
    act at every tick, and the measure is updated at every tick too.

    Args:
        world: The world.
        episode: B episodes, none of which has collided.
        action: As in `World.decode_meta_actions`.
        commanded: As in `World.step`.
        watch: Called with the episodes after each tick.

    Returns:
        The episodes at the time of the next decision, and the reward.
    """
    sums: RewardTerms | None = None
    for tick in range(world.clock.stride):
        chosen = action if tick == 0 else torch.full_like(action, IDLE)
        ready, physical = world.decode_meta_actions(episode, chosen, commanded)
        moved = world.step(ready, physical, commanded)
        terms = reward_terms(moved, physical if commanded is None else physical[:, 0])
        over = episode.collided
        if tick:
            moved = hold_finished(over, episode, moved)
            terms = RewardTerms(*(term.masked_fill(over, 0.0) for term in terms))
        sums = terms if sums is None else RewardTerms(*map(torch.add, sums, terms))
        episode = moved
        if watch is not None:
            watch(episode)
        if world.clock.stride > 1 and bool(episode.collided.all()):
            break
    assert sums is not None
    if world.clock.stride > 1:
        sums = RewardTerms(*(term / world.clock.stride for term in sums))
    return StepResult(episode, sums)


def hold_finished(over: Tensor, old: Episode, new: Episode) -> Episode:
    """Return the new episodes, with the traffic of those that are over as it was.

    Args:
        over: Which are over, boolean, shape (B,).
        old: Before the tick.
        new: After it.
    """

    def hold(before: Tensor, after: Tensor) -> Tensor:
        return torch.where(over.view(-1, *[1] * (after.ndim - 1)), before, after)

    perception, camera_context = new.perception, new.camera_context
    if camera_context is not None and old.camera_context is not None:
        camera_context = camera_context._replace(tick=hold(old.camera_context.tick, camera_context.tick))
    return new._replace(
        state=State(*map(hold, old.state, new.state)),
        lead=Lead(*map(hold, old.lead, new.lead)),
        perception=perception if perception is None or old.perception is None else hold(old.perception, perception),
        camera_context=camera_context,
    )
