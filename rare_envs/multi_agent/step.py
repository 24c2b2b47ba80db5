"""Step of an environment of several agents: a decision of each, and the ticks until the next."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor

from rare_envs.control.actions import IDLE
from rare_envs.control.meta_actions import initial_aim
from rare_envs.egos.policy import PolicyDriver
from rare_envs.multi_agent.episode import MultiAgentEpisode, start, step_traffic
from rare_envs.multi_agent.rewards import Reward, Transition
from rare_envs.simulation.decision import TickReward, run_ticks
from rare_envs.simulation.episode import Episode
from rare_envs.simulation.rollout import Driver
from rare_envs.simulation.world import World


class JointStepResult(NamedTuple):
    """Result of the agents' decisions."""

    episode: MultiAgentEpisode
    rewards: dict[int, Any]
    """By vehicle, as its reward function gives them: their mean over the ticks, where ticks after its collision count
    as 0."""
    memory: Any
    """Of the ego's driver."""


class _Joint(NamedTuple):
    """What goes on from tick to tick."""

    episode: MultiAgentEpisode
    memory: Any
    """Of the ego's driver."""

    @property
    def collided(self) -> Tensor:
        """Which vehicles have collided, boolean, shape (B, N)."""
        return self.episode.collided


def step_agents(
    world: World,
    episode: MultiAgentEpisode,
    action: Tensor,
    commanded: Tensor,
    rewards: Mapping[int, Reward],
    ego: Driver,
    memory: Any = None,
) -> JointStepResult:
    """Carry out decisions, as `rare_envs.simulation.decision.advance` does for one agent.

    Vehicles that have collided are held by `step_traffic`, because some may have before the decision.

    Args:
        world: The world.
        episode: B episodes.
        action: Of all vehicles: physical, shape (B, N, 2), or meta-actions, shape (B, N).
        commanded: Which vehicles take their action, boolean, shape (B, N).
        rewards: Reward functions by vehicle.
        ego: Drives the ego where it is not commanded.
        memory: The ego's driver's.

    Returns:
        The episodes at the time of the next decision, rewards and memory.
    """

    def tick(old: _Joint, chosen: Tensor, first: bool) -> tuple[_Joint, list[TickReward]]:
        before = old.episode
        traffic, physical, kept = _combine_actions(world, before, chosen, commanded, ego, old.memory)
        after = step_traffic(world, before._replace(traffic=traffic), physical, commanded)
        earned = [
            TickReward(reward(Transition(before, after, j, physical[:, j])), before.views[j].collided)
            for j, reward in rewards.items()
        ]
        return _Joint(after, kept), earned

    end, means = run_ticks(world.clock, _Joint(episode, memory), action, tick)
    return JointStepResult(end.episode, dict(zip(rewards, means, strict=True)), end.memory)


def _combine_actions(
    world: World, episode: MultiAgentEpisode, action: Tensor, commanded: Tensor, ego: Driver, memory: Any
) -> tuple[Episode, Tensor, Any]:
    """Combine the agents' actions with those of the ego's driver.

    Returns:
        The traffic with its new aims, accelerations and steering angles (B, N, 2), and the memory of the ego's driver.
    """
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
    observation, action_kind = world.sensing.observation, world.clock.action
    drivers = {vehicle: PolicyDriver(policy, observation, action_kind) for vehicle, policy in policies.items()}
    episode, memory = start(world, x), None
    memories: dict[int, Any] = dict.fromkeys(drivers)
    batch, n = episode.disabled.shape
    commanded = torch.zeros(batch, n, dtype=torch.bool, device=x.device)
    commanded[:, list(drivers)] = True
    shape = (batch, n) if action_kind == "meta" else (batch, n, 2)
    for _ in range(world.clock.ticks // world.clock.stride):
        action = torch.full(shape, IDLE) if action_kind == "meta" else torch.zeros(shape)
        for vehicle, driver in drivers.items():
            chosen, memories[vehicle] = driver.act(episode.views[vehicle], memories[vehicle])
            action[:, vehicle] = chosen
        episode, _, memory = step_agents(world, episode, action, commanded, {}, ego, memory)
    return episode
