"""A decision of one agent or of several: an action, the ticks until the next, and the mean of their rewards."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol, TypeVar

import torch
from torch import Tensor

from rare_envs.control.actions import IDLE
from rare_envs.simulation.clock import Clock
from rare_envs.simulation.episode import Episode
from rare_envs.simulation.reward import RewardTerms, reward_terms
from rare_envs.simulation.world import World
from rare_envs.traffic.neighbours import Lead
from rare_envs.traffic.state import State


class Episodes(Protocol):
    """B episodes of one agent or of several."""

    @property
    def collided(self) -> Tensor:
        """Which have collided, boolean, in any shape: of the episodes, or of each agent in each."""


EpisodesT = TypeVar("EpisodesT", bound=Episodes)


class TickReward(NamedTuple):
    """Reward of one tick for one agent in B episodes."""

    terms: Any
    """A tensor of shape (B,), or a named tuple of such."""
    over: Tensor
    """Which had collided before the tick and earn nothing in it, boolean, shape (B,)."""


Tick = Callable[[EpisodesT, Tensor, bool], tuple[EpisodesT, Sequence[TickReward]]]
"""From episodes, an action and whether it was decided just now to the episodes a tick later and the agents' rewards."""


def run_ticks(
    clock: Clock, episodes: EpisodesT, action: Tensor, tick: Tick[EpisodesT]
) -> tuple[EpisodesT, tuple[Any, ...]]:
    """Carry out the ticks of a decision; no further ones once all have collided.

    Args:
        clock: Says how many they are.
        episodes: B episodes at the decision.
        action: What is decided. Meta-actions are given in the first tick, `IDLE` in those after it; a physical action
            in all of them.
        tick: Carries out one.

    Returns:
        The episodes at the time of the next decision, and the agents' rewards: the means over the ticks, where ticks
        after a collision count as 0.
    """
    stride, sums = clock.stride, tuple[Any, ...]()
    for index in range(stride):
        if index == 1 and not action.is_floating_point():
            action = torch.full_like(action, IDLE)
        episodes, rewards = tick(episodes, action, index == 0)
        sums = tuple(terms for terms, _ in rewards) if index == 0 else tuple(map(_add, sums, rewards))
        if stride > 1 and bool(episodes.collided.all()):
            break
    if stride > 1:
        sums = tuple(_map_terms(lambda term: term / stride, terms) for terms in sums)
    return episodes, sums


def _add(total: Any, reward: TickReward) -> Any:
    """Add the reward of a later tick, which counts as 0 where the episode was over."""
    return _map_terms(lambda old, new: old + new.masked_fill(reward.over, 0.0), total, reward.terms)


def _map_terms(function: Callable[..., Tensor], *terms: Any) -> Any:
    """Apply a function term by term."""
    if isinstance(terms[0], Tensor):
        return function(*terms)
    return type(terms[0])(*(function(*each) for each in zip(*terms, strict=True)))


class StepResult(NamedTuple):
    """Result of a decision in B episodes."""

    episode: Episode
    """After it; those with a collision stay as they were in its tick."""
    terms: RewardTerms
    """Terms of the reward, shape (B,) each: their mean over the ticks, where ticks after a collision count as 0."""


def advance(
    world: World, episode: Episode, action: Tensor, watch: Callable[[Episode], None] | None = None
) -> StepResult:
    """Carry out a decision.

    A continuous action lasts one tick. A meta-action lasts a second: it is given to the controllers once, which then
    act at every tick, and the measure is updated at every tick too.

    Args:
        world: The world.
        episode: B episodes, none of which has collided.
        action: Of the ego, as in `World.decode_meta_actions`.
        watch: Called with the episodes after each tick.

    Returns:
        The episodes at the time of the next decision, and the reward.
    """

    def tick(old: Episode, chosen: Tensor, first: bool) -> tuple[Episode, tuple[TickReward]]:
        ready, physical = world.decode_meta_actions(old, chosen)
        moved = world.step(ready, physical)
        reward = TickReward(reward_terms(moved, physical), old.collided)
        moved = moved if first else hold_finished(old.collided, old, moved)
        if watch is not None:
            watch(moved)
        return moved, (reward,)

    episode, (terms,) = run_ticks(world.clock, episode, action, tick)
    return StepResult(episode, terms)


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
