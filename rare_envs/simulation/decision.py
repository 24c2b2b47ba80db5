"""A decision of one agent or of several: an action, the ticks until the next, and their rewards.

The reward is what egos are trained on; estimates do not depend on it.
"""

import math
from collections import namedtuple
from collections.abc import Callable, Mapping, Sequence
from numbers import Real
from types import MappingProxyType, SimpleNamespace
from typing import Any, NamedTuple, TypeAlias, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rare_envs.control.actions import IDLE, MAX_ACCELERATION, MAX_STEERING
from rare_envs.devices import constant
from rare_envs.plugins import as_errors, check_name, make_object, one_line
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
HIGH_SPEEDS = (20.0, 30.0)
"""Speeds [m/s] between which HighwayEnv's high-speed reward grows from 0 to 1."""
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


def _along(episode: Episode) -> Tensor:
    return episode.state.speed[:, 0] * torch.cos(episode.state.heading[:, 0])


def _lane_offset(episode: Episode) -> Tensor:
    """Return the distance from the centre of the nearest lane [m], off the road as if lanes went on, (B,)."""
    y, width = episode.state.y[:, 0], episode.road.width
    offset = y - episode.road.centre_of(y)
    return offset - torch.round(offset / width) * width


def _ttc(episode: Episode) -> Tensor:
    return episode.lead.gap.clamp(min=0.0) / episode.lead.closing_speed.clamp(min=LEAST_CLOSING)


def _headway(episode: Episode, _: Tensor) -> Tensor:
    wanted = STANDING_GAP + TIME_GAP * episode.state.speed[:, 0]
    return (1.0 - episode.lead.gap.clamp(min=0.0) / wanted).clamp(min=0.0)


def _right_lane(episode: Episode, _: Tensor) -> Tensor:
    return episode.road.lane_of(episode.state.y[:, 0]).to(episode.state.x.dtype) / max(episode.road.lanes - 1, 1)


_LOW, _HIGH = HIGH_SPEEDS
TERMS: Mapping[str, Callable[[Episode, Tensor], Tensor]] = MappingProxyType(
    {
        "speed": lambda episode, _: (_along(episode) / TARGET_SPEED).clamp(0.0, 1.0),
        "effort": lambda _, action: (action / constant((MAX_ACCELERATION, MAX_STEERING), action)).square().sum(dim=1),
        "lane": lambda episode, _: (_lane_offset(episode) / (episode.road.width / 2)).square(),
        "risk": lambda episode, _: (1.0 - _ttc(episode) / TTC_COMFORT).clamp(min=0.0),
        "headway": _headway,
        "collision": lambda episode, _: episode.collided.to(episode.state.x.dtype),
        "high_speed": lambda episode, _: ((_along(episode) - _LOW) / (_HIGH - _LOW)).clamp(0.0, 1.0),
        "right_lane": _right_lane,
        "on_road": lambda episode, _: (~episode.road.off_road(episode.state.y[:, 0])).to(episode.state.x.dtype),
    }
)
"""What a reward can weigh: of arriving in episodes by accelerations [m/s^2] and steering angles [rad] (B, 2), 0 or
more without a unit, shape (B,); docs/environments.md has a table. The last four are HighwayEnv's, which ends their
names in `_reward`."""


def reward_terms(episode: Episode, action: Tensor) -> RewardTerms:
    """Return the terms for arriving in `episode` by accelerations [m/s^2] and steering angles [rad] (B, 2)."""
    return RewardTerms(
        progress=TERMS["speed"](episode, action),
        comfort=-EFFORT_WEIGHT * TERMS["effort"](episode, action),
        lane=-LANE_WEIGHT * TERMS["lane"](episode, action),
        risk=-TERMS["risk"](episode, action),
        headway=-HEADWAY_WEIGHT * TERMS["headway"](episode, action),
        collision=-COLLISION_COST * TERMS["collision"](episode, action),
    )


def quantities_of(episode: Episode, action: Tensor) -> SimpleNamespace:
    """Return what a reward of your own may depend on: of the ego after a tick, NumPy arrays of shape (B,) of its own.

    speed [m/s]; heading, relative to the road, positive to the right [rad]; acceleration [m/s^2] and steering [rad]
    that the action (B, 2) asks for; of the vehicle ahead gap, bumper to bumper [m], closing_speed [m/s] and ttc [s],
    inf without one or if it gets no nearer; lane, 0 the leftmost; lane_offset from its centre, positive to the right
    [m]; collision, with a vehicle or the edge of the road, boolean.
    """
    state, lead = episode.state, episode.lead
    found = {
        "speed": state.speed[:, 0],
        "heading": state.heading[:, 0],
        "acceleration": action[:, 0],
        "steering": action[:, 1],
        **lead._asdict(),
        "ttc": torch.where(lead.closing_speed > LEAST_CLOSING, _ttc(episode), torch.inf),
        "lane": episode.road.lane_of(state.y[:, 0]),
        "lane_offset": _lane_offset(episode),
        "collision": episode.collided,
    }
    return SimpleNamespace(**{name: each.numpy(force=True).copy() for name, each in found.items()})


EgoReward: TypeAlias = Callable[[Episode, Tensor], Any]
"""From episodes after a tick, and the action (B, 2) that led there, to a reward as of `read_terms`."""


def find_reward(reward: Any) -> EgoReward:
    """Return the reward that an argument `reward` means.

    Args:
        reward: None for `reward_terms`; weights by term of `TERMS`; a function of what `quantities_of` returns, which
            gives an array (B,); or "module:function".

    Raises:
        ValueError: It is none of these, or a term is unknown; where the function fails, the reward itself raises it.

    Example:
        >>> find_reward({"speeed": 1.0})  # doctest: +ELLIPSIS
        Traceback (most recent call last):
            ...
        ValueError: Unknown term of the reward 'speeed' (did you mean 'speed'?); expected one of 'speed', 'effort', ...
    """
    if reward is None:
        return reward_terms
    reward = make_object(reward, "reward", call=False) if isinstance(reward, str) else reward
    if isinstance(reward, Mapping) and reward:
        return _weigh(reward)
    if not callable(reward):
        raise ValueError(f"Expected reward as weights by term, a function or 'module:function', got {reward!r}.")

    def of_function(episode: Episode, action: Tensor) -> Any:
        try:
            with as_errors():
                given = reward(quantities_of(episode, action))
        except Exception as error:  # the function is the user's: anything may happen in it
            raise ValueError(f"The reward {reward!r} fails: {one_line(error)}.") from error
        return read_terms(given, episode.state.x[:, 0])

    return of_function


def _weigh(given: Mapping[str, Any]) -> EgoReward:
    """Return the reward with these weights of `TERMS`, their names with HighwayEnv's ending or without."""
    weights = {str(name).removesuffix("_reward"): weight for name, weight in given.items()}
    if len(weights) < len(given):
        raise ValueError(f"Expected each term of the reward once, got {', '.join(map(repr, given))}.")
    for name, weight in weights.items():
        check_name("term of the reward", name, TERMS)
        if not isinstance(weight, Real) or not math.isfinite(weight):
            raise ValueError(f"Expected a finite number as the weight of {name!r} in the reward, got {weight!r}.")
    kind: Any = namedtuple("WeightedTerms", weights)  # type: ignore[misc]
    return lambda episode, action: kind(*(float(w) * TERMS[name](episode, action) for name, w in weights.items()))


def read_terms(reward: Any, like: Tensor) -> Any:
    """Return a reward of a user's function as floating-point tensors (B,), `like` another.

    It is an array or tensor (B,), a number for all, or a named tuple of such terms, whose sum is the reward; a
    ValueError says that it is none of these, or not finite.
    """

    def read(term: Any) -> Tensor:
        try:
            value = torch.as_tensor(term, device=like.device)
        except (TypeError, ValueError, RuntimeError):
            value = torch.empty(0, 0)  # of no shape that fits
        if value.shape not in ((), like.shape) or not bool(value.isfinite().all()):
            wanted = f"a finite reward of shape {tuple(like.shape)}, a number, or a named tuple of these"
            raise ValueError(f"Expected {wanted}, got {' '.join(repr(term).split())}.")
        return value if value.ndim and value.is_floating_point() else value.to(like).expand(like.shape)

    return map_leaves(read, reward)


def total_of(reward: Any) -> Tensor:
    """Return the sum (B,) of a reward of `read_terms`."""
    total: Tensor = reward if isinstance(reward, Tensor) else sum(reward)
    return total


def name_terms(reward: Any) -> dict[str, Tensor]:
    """Return the terms of a reward of `read_terms` by name."""
    return {"reward": reward} if isinstance(reward, Tensor) else reward._asdict()


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
    terms: Any
    """Terms of the reward, or the reward, shape (B,) each, as of `run_ticks`."""
    features: NDArray[np.float32] | None = None
    """The observation `features`, shape (B, F), where it is known already."""


def advance(
    world: World,
    episode: Episode,
    action: Tensor,
    watch: Callable[[Episode], None] | None = None,
    reward: EgoReward = reward_terms,
    compiled: Callable[[Episode, Tensor], StepResult | None] | None = None,
) -> StepResult:
    """Carry out a decision of the ego, as of `World.decode_meta_actions`; `watch` gets the episodes after each tick.

    A tick is `compiled`'s, with the terms of `reward_terms`, where that is given and does not return None.
    """
    features: NDArray[np.float32] | None = None

    def tick(old: Episode, chosen: Tensor, first: bool) -> tuple[Episode, tuple[tuple[Any, Tensor]]]:
        nonlocal features
        ready, physical = world.decode_meta_actions(old, chosen)
        moved = compiled and compiled(ready, physical)
        after = moved.episode if moved else world.step(ready, physical)
        terms = moved.terms if moved and reward is reward_terms else reward(after, physical)
        features = moved.features if moved and first else None
        after = after if first else hold_finished(old.collided, old, after)
        if watch is not None:
            watch(after)
        return after, ((terms, old.collided),)

    episode, (terms,) = run_ticks(world.clock, episode, action, tick)
    return StepResult(episode, terms, features)


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
