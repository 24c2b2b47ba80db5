"""A decision of one agent or of several: an action, the ticks until the next, and the mean of their rewards.

The reward is what egos are trained on; estimates do not depend on it.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rare_envs.control.actions import IDLE, MAX_ACCELERATION, MAX_STEERING
from rare_envs.devices import constant
from rare_envs.simulation.episode import Episode
from rare_envs.simulation.settings import Clock
from rare_envs.simulation.world import World
from rare_envs.traffic.bodies import Lead
from rare_envs.traffic.state import State, map_leaves

TARGET_SPEED = 21.72
"""Speed [m/s] beyond which going faster earns nothing more: the desired speed of the reference IDM ego."""
TTC_COMFORT = 4.0
"""Times to collision under this [s] cost; critical values in use are 1.5 to 4 s (docs/measures.md)."""
EFFORT_WEIGHT = 0.1
"""Cost of full acceleration or full steering; our choice: a tenth of what a tick of full progress earns."""
LANE_WEIGHT = 0.5
"""Cost of a place on a marker instead of the middle of a lane; our choice."""
HEADWAY_WEIGHT = 0.5
"""Cost of no gap at all; our choice, so that following closely pays less than falling back."""
STANDING_GAP = 2.0
"""Gap to the lead [m] under which it costs at a standstill."""
TIME_GAP = 1.0
"""To which the way of this time [s] is added; like the other weights our choice."""
COLLISION_COST = 30.0
"""Cost of a collision, about what a long undisturbed drive is worth under usual discounting."""
LEAST_CLOSING = 1e-4
"""Closing speeds are floored here [m/s], so that the time to collision of who does not close is long and finite."""


class RewardTerms(NamedTuple):
    """Terms of the reward of one tick, shape (B,) each; the reward is their sum."""

    progress: Tensor
    """Speed along the road over `TARGET_SPEED`, in 0 to 1."""
    comfort: Tensor
    """-0.1 (acceleration / 5 m/s^2)^2 - 0.1 (steering / 0.1 rad)^2."""
    lane: Tensor
    """-0.5 (offset from the centre of the nearest lane / half a lane)^2."""
    risk: Tensor
    """-(1 - TTC / 4 s) where the time to collision is shorter than that."""
    headway: Tensor
    """-0.5 (1 - gap / (2 m + 1 s x speed)) where the gap to the lead is shorter than that."""
    collision: Tensor
    """-30 in the tick of a collision."""

    @property
    def total(self) -> Tensor:
        """The reward, shape (B,)."""
        return self.progress + self.comfort + self.lane + self.risk + self.headway + self.collision


def reward_terms(episode: Episode, action: Tensor) -> RewardTerms:
    """Return the terms for arriving in `episode` by accelerations [m/s^2] and steering angles [rad] (B, 2)."""
    state, lead = episode.state, episode.lead
    along = state.speed[:, 0] * torch.cos(state.heading[:, 0])
    width = episode.road.width
    offset = state.y[:, 0] - episode.road.centre_of(state.y[:, 0])
    offset = offset - torch.round(offset / width) * width  # off the road, as if lanes went on
    effort = action / constant((MAX_ACCELERATION, MAX_STEERING), action)
    gap = lead.gap.clamp(min=0.0)
    ttc = gap / lead.closing_speed.clamp(min=LEAST_CLOSING)
    return RewardTerms(
        progress=(along / TARGET_SPEED).clamp(0.0, 1.0),
        comfort=-EFFORT_WEIGHT * effort.square().sum(dim=1),
        lane=-LANE_WEIGHT * (offset / (width / 2)).square(),
        risk=-(1.0 - ttc / TTC_COMFORT).clamp(min=0.0),
        headway=-HEADWAY_WEIGHT * (1.0 - gap / (STANDING_GAP + TIME_GAP * state.speed[:, 0])).clamp(min=0.0),
        collision=-COLLISION_COST * episode.collided.to(along.dtype),
    )


EpisodesT = TypeVar("EpisodesT", bound=Any)
"""B episodes of one agent or of several; `collided` says of which episodes, or of which agents in each."""
Tick = Callable[[EpisodesT, Tensor, bool], tuple[EpisodesT, Sequence[tuple[Any, Tensor]]]]
"""From episodes, an action and whether it was decided just now to the episodes a tick later and, for each agent, its
reward, a tensor (B,) or a named tuple of such, and which had collided before and earn nothing, boolean (B,)."""


def run_ticks(
    clock: Clock, episodes: EpisodesT, action: Tensor, tick: Tick[EpisodesT]
) -> tuple[EpisodesT, tuple[Any, ...]]:
    """Carry out the ticks of a decision; no further ones once all have collided.

    Meta-actions are given in the first tick, `IDLE` in those after it; a physical action in all of them. Return the
    episodes at the next decision and the agents' rewards: the means over the ticks, those after a collision being 0.
    """
    stride = clock.stride
    episodes, rewards = tick(episodes, action, True)
    sums = tuple(terms for terms, _ in rewards)
    if stride == 1:
        return episodes, sums
    for _ in range(stride - 1):
        if bool(episodes.collided.all()):
            break
        episodes, rewards = tick(
            episodes, action if action.is_floating_point() else torch.full_like(action, IDLE), False
        )
        sums = tuple(
            map_leaves(lambda old, new, over=over: old + new.masked_fill(over, 0.0), total, terms)
            for total, (terms, over) in zip(sums, rewards, strict=True)
        )
    return episodes, tuple(map_leaves(lambda total: total / stride, terms) for terms in sums)


class StepResult(NamedTuple):
    """Result of a decision in B episodes."""

    episode: Episode
    """After it; those with a collision stay as they were in its tick."""
    terms: RewardTerms
    """Terms of the reward, shape (B,) each: their mean over the ticks, where ticks after a collision count as 0."""
    features: NDArray[np.float32] | None = None
    """The observation `features`, shape (B, F), where it is known already."""


def advance(
    world: World, episode: Episode, action: Tensor, watch: Callable[[Episode], None] | None = None
) -> StepResult:
    """Carry out a decision of the ego, as of `World.decode_meta_actions`; `watch` gets the episodes after each tick."""

    def tick(old: Episode, chosen: Tensor, first: bool) -> tuple[Episode, tuple[tuple[RewardTerms, Tensor]]]:
        ready, physical = world.decode_meta_actions(old, chosen)
        moved = world.step(ready, physical)
        terms = reward_terms(moved, physical)
        moved = moved if first else hold_finished(old.collided, old, moved)
        if watch is not None:
            watch(moved)
        return moved, ((terms, old.collided),)

    episode, (terms,) = run_ticks(world.clock, episode, action, tick)
    return StepResult(episode, terms)


def hold_finished(over: Tensor, old: Episode, new: Episode) -> Episode:
    """Return the new episodes, with the traffic of those that are over, boolean (B,), as it was in the old ones."""

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
