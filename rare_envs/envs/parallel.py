"""Environments of several agents: PettingZoo's `ParallelEnv`, and a `VectorEnv` of agents that share one policy."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray
from pettingzoo import ParallelEnv
from torch import Tensor

from rare_envs.control.actions import read_actions
from rare_envs.egos.needs import EgoNeeds, choose_action, load_named_ego, resolve
from rare_envs.egos.policy import as_driver
from rare_envs.envs.rendering import RENDER_MODES, Renderer
from rare_envs.envs.rows_and_infos import (
    Info,
    SingleObservation,
    draw_scenarios,
    episode_info,
    mask_infos,
    merge_rows,
    step_info,
    to_object_rows,
)
from rare_envs.make import set_up
from rare_envs.multi_agent import MultiAgentEpisode, Reward, command_nobody, own_reward, start, step_agents
from rare_envs.plugins import check_name
from rare_envs.simulation.decision import total_of
from rare_envs.simulation.episode import Episode
from rare_envs.simulation.observation import map_kinds, observe, read_kinds

Actions = Mapping[str, Any]
FloatArray = NDArray[np.float32]


class _SeveralAgents:
    """World, agents with their rewards, and the ego's driver of an environment of several agents."""

    def _set_up(
        self, env_id: str, agents: Sequence[str] | None, ego: Any, rewards: Mapping[str, Reward] | None, settings: Any
    ) -> list[str]:
        """Take the arguments of an environment, and return the names of its agents."""
        ego = load_named_ego(ego)
        needs = resolve(ego)
        acted, seen = needs.action_space if needs.queries_policy else None, settings.get("observation", "features")
        kind = settings.get("action") or choose_action(acted, read_kinds(seen))
        world, self.space = set_up(env_id, EgoNeeds(lidar=needs.lidar), **{**settings, "action": kind})
        if world.policies:
            raise ValueError("Expected drivers of all vehicles here: policies in single ones act as agents, by step().")
        self.world = world.with_statistics()
        vehicles = self.world.scenario.vehicle_names
        names = _select_agents(vehicles, agents)
        self.rewards = _select_rewards(names, rewards)
        self._vehicles = {agent: vehicles.index(agent) for agent in names}
        self._driver = as_driver(ego, self.world, needs)
        self._episode: MultiAgentEpisode | None = None
        return names

    def _start(self, x: NDArray[np.float64]) -> MultiAgentEpisode:
        with torch.inference_mode():
            return start(self.world, torch.from_numpy(x).float())


def _select_agents(names: tuple[str, ...], agents: Sequence[str] | None) -> list[str]:
    """Return the agents that an argument `agents` names."""
    if agents is None:
        return list(names)
    if isinstance(agents, str) or not isinstance(agents, Sequence):
        raise ValueError(f"Expected agents as a list of names, such as ['{names[-1]}'], got {agents!r}.")
    for agent in agents:
        check_name("vehicle", agent, names)
    if not agents or len(set(agents)) < len(agents):
        raise ValueError(f"Expected one or more different agents, got {list(agents)}.")
    return list(agents)


def _select_rewards(agents: Sequence[str], rewards: Mapping[str, Reward] | None) -> dict[str, Reward]:
    """Return the reward of each agent."""
    rewards = {} if rewards is None else rewards
    if not isinstance(rewards, Mapping) or not all(map(callable, rewards.values())):
        raise ValueError(f"Expected rewards as a mapping of agents to functions of a Transition, got {rewards!r}.")
    for agent in rewards:
        check_name("agent of a reward", agent, agents)
    return {agent: rewards.get(agent, own_reward) for agent in agents}


class DrivingParallelEnv(_SeveralAgents, ParallelEnv[str, SingleObservation, FloatArray]):  # type: ignore[misc]
    """Every vehicle is an agent, or those named; each observes, acts, is rewarded and ends as an ego in its place.

    A vehicle without an action keeps its driver: the scenario's script or learned drivers, and for the ego the driver
    `ego`. An agent terminates when its vehicle touches another one or leaves the road, is truncated at the horizon,
    and then leaves `agents`; its vehicle rolls out, see `rare_envs.multi_agent`.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012  (PettingZoo's own form)
        "name": "rare_envs",
        "render_modes": list(RENDER_MODES),
        "is_parallelizable": True,
        "render_fps": 10,
    }

    def __init__(
        self,
        env_id: str,
        *,
        agents: Sequence[str] | None = None,
        ego: Any = "idm",
        rewards: Mapping[str, Reward] | None = None,
        render_mode: str | None = None,
        **kwargs: Any,
    ) -> None:
        """Make the environment.

        Args:
            env_id: The scenario's registered id.
            agents: Names of the vehicles that may act (`Scenario.vehicle_names`); None for all.
            ego: What drives the ego when it gets no action: "idm", a `Driver` or an object with `predict`.
            rewards: Rewards of agents by name; by default each has the reward of an ego, in its own view.
            render_mode: None, "rgb_array" or "human".
            **kwargs: See `rare_envs.make.set_up`.
        """
        self.possible_agents = self._set_up(env_id, agents, ego, rewards, kwargs)
        self.metadata = {**self.metadata, "name": env_id, "render_fps": self.world.clock.decisions_per_second}
        self.render_mode = render_mode
        self._renderer = Renderer(self.world, render_mode)
        self.agents: list[str] = []
        self.observation_spaces = {agent: self.world.observation_space for agent in self.possible_agents}
        self.action_spaces = {agent: self.world.action_space for agent in self.possible_agents}
        self.np_random, _ = seeding.np_random()
        self._x = np.full(self.space.dim, np.nan)
        self._memory: Any = None
        self._tick = 0

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        """Return the space of an agent's observations."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Space[Any]:
        """Return the space of an agent's actions."""
        return self.action_spaces[agent]

    @property
    def state_space(self) -> "spaces.Box[np.float32]":
        """Space of `state`, shape (N, 4): within 1,000 km, 1,000 rad and 1,000 m/s, speeds not negative."""
        high = np.tile(np.array([1e6, 1e6, 1e3, 1e3], np.float32), (self.world.scenario.vehicles, 1))
        low = np.where([False, False, False, True], np.float32(0.0), -high)
        return spaces.Box(low, high, dtype=np.float32)

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, SingleObservation], dict[str, Info]]:
        """Start an episode; the same seed draws the same scenario as in `gym.make`.

        Args:
            seed: Seeds the draw of the scenario.
            options: Scenario parameters by name, or {"x": vector} for all of them, as in `DrivingEnv.reset`.

        Returns:
            Observations and infos by agent.
        """
        if seed is not None:
            self.np_random, _ = seeding.np_random(seed)
        if options == {"options": 1}:
            options = None  # what PettingZoo's conformance test asks for, to see that options are taken at all
        self._x = draw_scenarios(self.world, self.space, options, 1, self.np_random)[0]
        self._tick, self._memory, self.agents = 0, None, list(self.possible_agents)
        self._episode = episode = self._start(self._x[None])
        views = self._views(episode)
        infos = {agent: episode_info(self.space, self._x, view) for agent, view in views.items()}
        if self._renderer.is_window:
            self.render()
        return self._observe(views), infos

    def step(
        self, actions: Actions
    ) -> tuple[dict[str, SingleObservation], dict[str, float], dict[str, bool], dict[str, bool], dict[str, Info]]:
        """Move by one tick.

        Args:
            actions: Actions by agent, as in `DrivingEnv.step`; an agent without one, or with None, leaves its vehicle
                to its driver; those of agents that have left do not count.

        Returns:
            Observations, rewards, terminations, truncations and infos of the agents that were there before the step;
            empty mappings when all have left, as PettingZoo's own environments.

        Raises:
            ValueError: If an agent does not exist, or an action has the wrong shape or is NaN.
            RuntimeError: If there was no `reset`.
        """
        if self._episode is None:
            raise RuntimeError("Expected reset() before step(): no agent is there.")
        if not isinstance(actions, Mapping):
            raise ValueError(f"Expected actions as a mapping of agents to actions, got {type(actions).__name__}.")
        if not self.agents:
            return {}, {}, {}, {}, {}
        rewards_of = {self._vehicles[agent]: self.rewards[agent] for agent in self.agents}
        with torch.inference_mode():
            chosen, commanded = self._read(actions)
            episode, earned, self._memory = step_agents(
                self.world, self._episode, chosen, commanded, rewards_of, self._driver, self._memory
            )
            terms = {agent: earned[self._vehicles[agent]] for agent in self.agents}
            rewards = {agent: float(total_of(reward)) for agent, reward in terms.items()}
        self._episode, self._tick = episode, self._tick + self.world.clock.stride
        views = self._views(episode)
        observations = self._observe(views)
        terminated = {agent: bool(view.collided) for agent, view in views.items()}
        over = self._tick >= self.world.clock.ticks
        truncated = {agent: over and not terminated[agent] for agent in self.agents}
        infos = {
            agent: step_info(self.space, self._x, view, terms[agent], terminated[agent] or over, self._vehicles[agent])
            for agent, view in views.items()
        }
        self.agents = [agent for agent in self.agents if not (terminated[agent] or truncated[agent])]
        if self._renderer.is_window:
            self.render()
        return observations, rewards, terminated, truncated, infos

    def _read(self, actions: Actions) -> tuple[Tensor, Tensor]:
        """Return actions of all vehicles, (1, N, 2) or (1, N), and which are commanded, (1, N)."""
        chosen, commanded = command_nobody(self.world, 1)
        for agent, action in actions.items():
            check_name("agent", agent, self.possible_agents)
            if action is None or agent not in self.agents:
                continue
            shape = self.world.action_space.shape
            if np.shape(action) != shape:
                raise ValueError(f"Expected an action of shape {shape} for {agent!r}, got {np.shape(action)}.")
            given = torch.as_tensor(np.asarray(action))[None]
            chosen[:, self._vehicles[agent]] = read_actions(self.world.clock.action, given, 1)
            commanded[:, self._vehicles[agent]] = True
        return chosen, commanded

    def _views(self, episode: MultiAgentEpisode) -> dict[str, Episode]:
        """Return the episode as each agent sees it."""
        return {agent: episode.views[self._vehicles[agent]] for agent in self.agents}

    @torch.inference_mode()
    def _observe(self, views: Mapping[str, Episode]) -> dict[str, SingleObservation]:
        seen = {agent: observe(view, self.world.sensing.observation) for agent, view in views.items()}
        return {agent: map_kinds(lambda part: part[0].numpy(), each) for agent, each in seen.items()}

    def render(self) -> NDArray[np.uint8] | None:
        """Draw the road with HighwayEnv's graphics: an (H, W, 3) image for "rgb_array", a window for "human"."""
        episode = self._episode
        return self._renderer.render(
            None if episode is None else episode.traffic,
            self._tick * self.world.clock.dt,
            agents=list(self._vehicles.values()),
            crashed=[] if episode is None else (episode.collided | episode.disabled)[0].nonzero().flatten().tolist(),
        )

    def state(self) -> NDArray[np.float32]:
        """Return x, y [m], heading [rad] and speed [m/s] of all vehicles, for a central critic; shape (N, 4)."""
        if self._episode is None:
            raise RuntimeError("Expected reset() before state().")
        whole: NDArray[np.float32] = torch.stack(self._episode.traffic.state[:4], dim=-1)[0].float().numpy()
        return whole

    def close(self) -> None:
        """Close the window."""
        self._renderer.close()


class AgentsVectorEnv(_SeveralAgents, VectorEnv[NDArray[np.float32], NDArray[Any], NDArray[Any]]):
    """`DrivingParallelEnv` for a batch of B scenarios with A agents each, with Gymnasium's SAME_STEP autoreset.

    Row b A + a is agent a of scenario b. A scenario is replaced within the step when the ego or an agent collides, or
    at the horizon. That terminates the rows of agents that have collided, all rows if it was the ego, and truncates the
    others: their episodes are cut short, so a learner should bootstrap there.
    """

    metadata = {  # noqa: RUF012  (Gymnasium's own form)
        "render_modes": [],
        "autoreset_mode": AutoresetMode.SAME_STEP,
    }

    def __init__(
        self,
        env_id: str,
        scenarios: int = 1,
        *,
        agents: Sequence[str] | None = None,
        ego: Any = "idm",
        rewards: Mapping[str, Reward] | None = None,
        **kwargs: Any,
    ) -> None:
        """Make a batch of B scenarios; arguments as of `DrivingParallelEnv`, but an ego without memory."""
        if not isinstance(scenarios, (int, np.integer)) or isinstance(scenarios, bool) or scenarios < 1:
            raise ValueError(f"Expected one or more scenarios, got {scenarios!r}.")
        self.agents = self._set_up(env_id, agents, ego, rewards, kwargs)
        self._of_agents = list(self._vehicles.values())
        self.scenarios = int(scenarios)
        self.num_envs = self.scenarios * len(self.agents)
        self.single_observation_space = self.world.observation_space
        self.single_action_space = self.world.action_space
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._tick = np.zeros(self.scenarios, dtype=np.int64)
        self._x = np.full((self.scenarios, self.space.dim), np.nan)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start all scenarios, by one generator: observations (B A, F), and infos."""
        super().reset(seed=seed)
        self._x = draw_scenarios(self.world, self.space, options, self.scenarios, self.np_random)
        self._tick[:] = 0
        self._episode = self._start(self._x)
        return self._observe(self._episode), {}

    def step(
        self, actions: NDArray[Any]
    ) -> tuple[NDArray[np.float32], NDArray[np.float64], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """Carry out one decision of each agent and replace the scenarios that ended."""
        if self._episode is None:
            raise RuntimeError("Expected reset() before step().")
        rewards_of = {self._vehicles[agent]: self.rewards[agent] for agent in self.agents}
        with torch.inference_mode():
            chosen, commanded = command_nobody(self.world, self.scenarios)
            given = read_actions(self.world.clock.action, torch.as_tensor(np.asarray(actions)), self.num_envs)
            chosen[:, self._of_agents] = given.view(self.scenarios, len(self.agents), *given.shape[1:])
            commanded[:, self._of_agents] = True
            episode, earned, memory = step_agents(
                self.world, self._episode, chosen, commanded, rewards_of, self._driver, None
            )
            if (memory[0] if isinstance(memory, tuple) else memory) is not None:
                raise ValueError(
                    "Expected an ego without memory: scenarios of a batch begin at different times, and a recurrent or "
                    "stacked policy would remember another one's. rare_envs.parallel_env takes such egos."
                )
            reward = self._by_row([total_of(earned[vehicle]) for vehicle in self._of_agents]).double().numpy()
        self._tick += self.world.clock.stride
        observation = self._observe(episode)
        own = self._by_row([episode.collided[:, vehicle] for vehicle in self._of_agents]).numpy()
        ego = episode.views[0].collided.numpy()
        done = ego | own.reshape(self.scenarios, -1).any(axis=1) | (self._tick >= self.world.clock.ticks)
        done_rows, ego_rows = (rows.repeat(len(self.agents)) for rows in (done, ego))
        infos: dict[str, Any] = {}
        if done.any():
            measures = self._by_row([episode.views[vehicle].f for vehicle in self._of_agents]).double().numpy()
            final = {"collision": own, "ego_collision": ego_rows, "measure": measures}
            infos = mask_infos({"final_obs": to_object_rows(observation, done_rows), "final_info": final}, done_rows)
            rows = np.flatnonzero(done)
            self._x[rows], self._tick[rows] = self.space.scenario_x(None, len(rows), self.np_random), 0
            with torch.inference_mode():
                episode = merge_rows(episode, torch.from_numpy(rows), self._start(self._x[rows]))
            observation = self._observe(episode)
        self._episode, terminated = episode, own | ego_rows
        return observation, reward, terminated, done_rows & ~terminated, infos

    def _by_row(self, columns: list[Tensor]) -> Tensor:
        """Return values of the agents, (B, ...) each, as (B A, ...)."""
        return torch.stack(columns, dim=1).flatten(0, 1)

    @torch.inference_mode()
    def _observe(self, episode: MultiAgentEpisode) -> Any:
        views = [observe(episode.views[vehicle], self.world.sensing.observation) for vehicle in self._of_agents]
        return map_kinds(lambda *parts: self._by_row(list(parts)).numpy(), *views)
