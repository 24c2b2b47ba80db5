"""Several agents: one traffic, seen by every vehicle as if it were the ego; its step, and the agents' rewards."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, TypeAlias

import torch
from torch import Tensor

from rare_envs.control.actions import IDLE, initial_aim
from rare_envs.egos.policy import PolicyDriver
from rare_envs.simulation.decision import (
    COLLISION_COST,
    RewardTerms,
    hold_finished,
    read_terms,
    reward_terms,
    run_ticks,
)
from rare_envs.simulation.episode import Episode
from rare_envs.simulation.world import Driver, World, roll_out
from rare_envs.traffic.bodies import find_struck, find_touching

__all__ = ["AdversaryTerms", "Transition", "adversary_reward", "own_reward", "play"]


class MultiAgentEpisode(NamedTuple):
    """B episodes of N vehicles at one moment."""

    traffic: Episode
    """The world's episodes, which go on as long as there is an agent."""
    views: tuple[Episode, ...]
    """The episodes as each vehicle sees them, itself in the ego's place with a lead, a measure and collisions of its
    own; after its collision they stay as they were then."""
    disabled: Tensor
    """Mask of vehicles that have crashed, or were hit by one that had, boolean, shape (B, N). A disabled vehicle
    takes no actions: it rolls out as HighwayEnv's crashed vehicles do."""

    @property
    def collided(self) -> Tensor:
        """Mask of vehicles that have touched another one or left the road by now, boolean, shape (B, N)."""
        return torch.stack([view.collided for view in self.views], dim=1)


def start(world: World, x: Tensor) -> MultiAgentEpisode:
    """Begin B episodes of scenarios x (B, d)."""
    traffic = world.start(x)
    none = torch.zeros_like(traffic.state.x, dtype=torch.bool)
    traffic = traffic._replace(overridden=none)
    camera = traffic.camera_context
    others = (
        world.start_from(
            traffic.state.seen_by(j),
            _view_perception(traffic.perception, j),
            camera_context=camera and camera._replace(viewer=j),
        )._replace(overridden=none)
        for j in range(1, world.scenario.vehicles)
    )
    return MultiAgentEpisode(traffic, (traffic, *others), none)


def step_traffic(world: World, episode: MultiAgentEpisode, action: Tensor, commanded: Tensor) -> MultiAgentEpisode:
    """Move every vehicle by one tick, by acceleration [m/s^2] and steering [rad] (B, N, 2) where commanded (B, N).

    The ego's action always counts. Contacts between vehicles that follow script or drivers are recorded, and do not
    change their motion, as in an environment of one agent. A vehicle is disabled when it touches the ego, a commanded
    or a disabled vehicle, which is disabled too; so is the ego or a commanded vehicle that leaves the road.
    """
    traffic, disabled, road = episode.traffic, episode.disabled, world.scenario.road
    active = commanded | disabled
    traffic = world.step(traffic, roll_out(traffic.state, disabled, action), active)
    state = traffic.state
    touching, off = find_touching(state, road), road.off_road(state.y)
    hit = touching.any(dim=2)
    if world.measurement.collisions == "any":
        hit = hit.any(dim=1, keepdim=True)
    hit = hit | off
    views = [traffic]
    for j, view in enumerate(episode.views[1:], start=1):
        view = view._replace(overridden=traffic.overridden)
        views.append(world.update(view, state.seen_by(j), _view_perception(traffic.perception, j), hit[:, j]))
    held = tuple(
        hold_finished(old.collided, old, new) if bool(old.collided.any()) else new
        for old, new in zip(episode.views, views, strict=True)
    )
    return MultiAgentEpisode(traffic, held, disabled | find_struck(touching, off, active))


def view_order(vehicle: int, vehicles: int) -> list[int]:
    """Return the vehicles in the order of `State.seen_by`."""
    return [vehicle, *(j for j in range(vehicles) if j != vehicle)]


def _view_perception(perception: Tensor | None, vehicle: int) -> Tensor | None:
    """Return the vehicles' lidar features (B, N, F) in the order of `State.seen_by`."""
    return None if perception is None else perception[:, view_order(vehicle, perception.shape[1])]


class Transition(NamedTuple):
    """A tick of one agent: all that a reward may depend on.

    Example:
        >>> Transition._fields
        ('before', 'after', 'vehicle', 'action')
    """

    before: MultiAgentEpisode
    after: MultiAgentEpisode
    vehicle: int
    """Index of the agent's vehicle."""
    action: Tensor
    """Acceleration [m/s^2] and steering angle [rad] of its vehicle, shape (B, 2); 0 where its driver decided."""


Reward: TypeAlias = Callable[[Transition], Any]
"""From a transition to a reward: a tensor (B,), a number for all episodes, or a named tuple of such terms, whose
sum it is."""


def own_reward(transition: Transition) -> RewardTerms:
    """Return the reward that egos are trained on, for any vehicle: in its own view.

    Args:
        transition: Of B episodes.

    Example:
        >>> import rare_envs
        >>> env = rare_envs.parallel_env("rare_envs/CutIn-v0", agents=["cutter"], rewards={"cutter": own_reward})
        >>> _ = env.reset(seed=0)
        >>> *_, infos = env.step({"cutter": [0.0, 0.0]})
        >>> list(infos["cutter"]["reward_terms"])
        ['progress', 'comfort', 'lane', 'risk', 'headway', 'collision']
    """
    return reward_terms(transition.after.views[transition.vehicle], transition.action)


class AdversaryTerms(NamedTuple):
    """Terms of an adversary's reward of one tick, shape (B,) each; the reward is their sum.

    Example:
        >>> import torch
        >>> float(sum(AdversaryTerms(*torch.tensor([[0.5], [0.0], [-0.25], [-0.125], [0.0]]))))
        0.125
    """

    danger: Tensor
    """1 - TTC / 4 s if the ego's time to collision is shorter than that."""
    collision: Tensor
    """30 in the tick in which the ego collides."""
    comfort: Tensor
    """-0.1 (acceleration / 5 m/s^2)^2 - 0.1 (steering / 0.1 rad)^2, so that it drives as road users do."""
    lane: Tensor
    """-0.5 (offset from the centre of the nearest lane / half a lane)^2."""
    fault: Tensor
    """-30 in the tick in which it collides with anything but the ego: the road's edge or another vehicle."""


def adversary_reward(transition: Transition) -> AdversaryTerms:
    """Return the reward of a vehicle that brings the ego into danger, and stays a road user while it does.

    Args:
        transition: Of B episodes.

    Example:
        >>> import rare_envs
        >>> env = rare_envs.parallel_env("rare_envs/CutIn-v0", agents=["cutter"], rewards={"cutter": adversary_reward})
        >>> _ = env.reset(seed=0)
        >>> *_, infos = env.step({"cutter": [0.0, 0.0]})
        >>> infos["cutter"]["reward_terms"]["collision"]
        0.0
    """
    ego, view = transition.after.views[0], transition.after.views[transition.vehicle]
    own = reward_terms(view, transition.action)
    danger = -reward_terms(ego, torch.zeros_like(transition.action)).risk
    crash = ego.collided & ~transition.before.views[0].collided
    alone = view.collided & ~transition.before.views[transition.vehicle].collided & ~crash
    return AdversaryTerms(
        danger=torch.where(ego.collided, torch.zeros_like(danger), danger),
        collision=COLLISION_COST * crash.to(danger.dtype),
        comfort=own.comfort,
        lane=own.lane,
        fault=-COLLISION_COST * alone.to(danger.dtype),
    )


def command_nobody(world: World, batch: int) -> tuple[Tensor, Tensor]:
    """Return actions of all vehicles, (B, N, 2) or (B, N), and which are commanded, (B, N): none yet."""
    shape = (batch, world.scenario.vehicles)
    chosen = torch.full(shape, IDLE) if world.clock.action == "meta" else torch.zeros(*shape, 2)
    return chosen, torch.zeros(shape, dtype=torch.bool)


def step_agents(
    world: World,
    episode: MultiAgentEpisode,
    action: Tensor,
    commanded: Tensor,
    rewards: Mapping[int, Reward],
    ego: Driver,
    memory: Any = None,
) -> tuple[MultiAgentEpisode, dict[int, Any], Any]:
    """Carry out decisions (B, N, 2), or meta-actions (B, N), as `rare_envs.simulation.decision.advance` does for one.

    The ego's driver, with its memory, drives the ego where it is not commanded (B, N). Return the episodes at the time
    of the next decision, rewards by vehicle, as of `run_ticks`, and the memory.
    """

    def tick(before: MultiAgentEpisode, chosen: Tensor, first: bool) -> tuple[MultiAgentEpisode, Any]:
        nonlocal memory
        traffic, physical, memory = _combine_actions(world, before, chosen, commanded, ego, memory)
        after = step_traffic(world, before._replace(traffic=traffic), physical, commanded)
        earned = []
        for j, reward in rewards.items():
            given = reward(Transition(before, after, j, physical[:, j]))
            earned.append((read_terms(given, traffic.state.x[:, 0]), before.views[j].collided))
        return after, earned

    end, means = run_ticks(world.clock, episode, action, tick)
    return end, dict(zip(rewards, means, strict=True)), memory


def _combine_actions(
    world: World, episode: MultiAgentEpisode, action: Tensor, commanded: Tensor, ego: Driver, memory: Any
) -> tuple[Episode, Tensor, Any]:
    """Combine the agents' actions with those of the ego's driver."""
    by_driver = ~commanded[:, 0]
    driven: Tensor | None = None
    if bool(by_driver.any()):
        driven, memory = ego.act(episode.views[0], memory)
        if not driven.is_floating_point():  # a policy with meta-actions in such a world
            mixed = torch.where(by_driver, driven, action[:, 0])
            action, driven = torch.cat((mixed[:, None], action[:, 1:]), dim=1), None
    traffic, physical = world.decode_meta_actions(episode.traffic, action, commanded)
    first = torch.arange(physical.shape[1], device=physical.device) == 0
    physical = torch.where((commanded | first)[..., None], physical, torch.zeros_like(physical))
    if driven is None:
        return traffic, physical, memory
    physical = torch.where((first & by_driver[:, None])[..., None], driven[:, None].to(physical), physical)
    if traffic.aim is not None:  # the ego aims for nothing while a driver drives it
        where = initial_aim(traffic.state, traffic.road)
        aim = (torch.where(first & by_driver[:, None], new, old) for new, old in zip(where, traffic.aim, strict=True))
        traffic = traffic._replace(aim=type(where)(*aim))
    return traffic, physical, memory


def play(world: World, x: Tensor, policies: Mapping[int, Any], ego: Driver) -> MultiAgentEpisode:
    """Drive B scenarios from start to horizon with policies in some of the vehicles.

    Example:
        >>> from rare_envs.control.idm import IDM
        >>> from rare_envs.scenarios.car_following import CAR_FOLLOWING
        >>> x = torch.tensor([[20.0, 15.0, 30.0]])  # ego and lead speed [m/s], gap [m]
        >>> play(World(CAR_FOLLOWING), x, {}, IDM()).collided  # of ego and lead
        tensor([[False, False]])

    Args:
        world: The world.
        x: Scenario parameters, shape (B, d).
        policies: Objects with Stable-Baselines3's `predict`, by vehicle; the others keep their drivers.
        ego: Drives the ego if it has no policy.

    Returns:
        The episodes at the horizon.
    """
    observation, kind = world.sensing.observation, world.clock.action
    drivers = {vehicle: PolicyDriver(policy, observation, kind) for vehicle, policy in policies.items()}
    memories: dict[int, Any] = dict.fromkeys(drivers)
    episode, memory = start(world, x), None
    for _ in range(world.clock.ticks // world.clock.stride):
        action, commanded = command_nobody(world, len(x))
        for vehicle, driver in drivers.items():
            action[:, vehicle], memories[vehicle] = driver.act(episode.views[vehicle], memories[vehicle])
            commanded[:, vehicle] = True
        episode, _, memory = step_agents(world, episode, action, commanded, {}, ego, memory)
    return episode
