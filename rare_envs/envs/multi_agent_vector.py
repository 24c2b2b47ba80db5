"""Several agents in many scenarios: a `gymnasium.vector.VectorEnv` whose rows are agents that share one policy."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray
from torch import Tensor

from rare_envs.control.actions import IDLE, read_actions
from rare_envs.egos.needs import EgoNeeds, load_named_ego, resolve
from rare_envs.egos.policy import as_driver
from rare_envs.envs.parallel import select_agents, select_rewards
from rare_envs.envs.rows_and_infos import merge_rows, put_masked, to_object_rows
from rare_envs.make import set_up
from rare_envs.multi_agent import MultiAgentEpisode, Reward, start, step_agents, total_of
from rare_envs.sensors.kinds import map_kinds
from rare_envs.simulation.observation import observe


class AgentsVectorEnv(VectorEnv[NDArray[np.float32], NDArray[Any], NDArray[Any]]):
    """`DrivingParallelEnv` for a batch of B scenarios with A agents each, with Gymnasium's SAME_STEP autoreset.

    Row b A + a is agent a of scenario b. A scenario is replaced within the step when the ego or an agent collides, or
    at the horizon. That terminates the rows of agents that have collided, all rows if it was the ego, and truncates the
    others: their episodes are cut short, so a learner should bootstrap there.

    Example:
        >>> env = AgentsVectorEnv("rare_envs/CutIn-v0", scenarios=2, agents=["ego", "cutter"])
        >>> env.num_envs, env.reset(seed=0)[0].shape
        (4, (4, 11))
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
        """Make the batch.

        Args:
            env_id: The scenario's registered id.
            scenarios: B.
            agents: Names of the vehicles that act, as in `DrivingParallelEnv`; None for all.
            ego: What drives the ego if it is no agent; without memory, because scenarios begin at different times.
            rewards: Rewards of agents by name, as in `DrivingParallelEnv`.
            **kwargs: See `rare_envs.make.set_up`.

        Raises:
            ValueError: If an argument is invalid.
        """
        if not isinstance(scenarios, (int, np.integer)) or isinstance(scenarios, bool) or scenarios < 1:
            raise ValueError(f"Expected one or more scenarios, got {scenarios!r}.")
        ego = load_named_ego(ego)
        needs = resolve(ego)
        world, self.space = set_up(env_id, EgoNeeds(lidar=needs.lidar), **kwargs)
        self.world = world.with_statistics()
        scenario = self.world.scenario
        self.agents = select_agents(scenario, agents)
        self.scenarios = int(scenarios)
        self.num_envs = self.scenarios * len(self.agents)
        self._vehicles = [scenario.vehicle_names.index(agent) for agent in self.agents]
        by_name = select_rewards(self.agents, rewards)
        self._rewards = {vehicle: by_name[agent] for vehicle, agent in zip(self._vehicles, self.agents, strict=True)}
        self._driver = as_driver(ego, self.world, needs)
        self.single_observation_space = self.world.observation_space
        self.single_action_space = self.world.action_space
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._tick = np.zeros(self.scenarios, dtype=np.int64)
        self._x = np.full((self.scenarios, self.space.dim), np.nan)
        self._episode: MultiAgentEpisode | None = None

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start all scenarios.

        Args:
            seed: Seeds the one generator of the batch; of a list the first.
            options: As in `DrivingVectorEnv.reset`, for the B scenarios.

        Returns:
            Observations, shape (B A, F), and infos.
        """
        super().reset(seed=seed[0] if isinstance(seed, list) else seed)
        self._x = self.space.scenario_x(options, self.scenarios, self.np_random)
        self._tick[:] = 0
        with torch.inference_mode():
            self._episode = start(self.world, torch.from_numpy(self._x).float())
            return self._observe(self._episode), {}

    def step(
        self, actions: NDArray[Any]
    ) -> tuple[NDArray[np.float32], NDArray[np.float64], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """Carry out one decision of each agent and replace the scenarios that ended.

        Raises:
            ValueError: If the actions have the wrong shape or are NaN.
        """
        if self._episode is None:
            raise RuntimeError("Expected reset() before step().")
        with torch.inference_mode():
            chosen, commanded = self._read(torch.as_tensor(np.asarray(actions)))
            episode, earned, memory = step_agents(
                self.world, self._episode, chosen, commanded, self._rewards, self._driver, None
            )
            _refuse_memory(memory)
            observation = self._observe(episode)
            reward = self._by_row([total_of(earned[vehicle]) for vehicle in self._vehicles]).double().numpy()
        self._tick += self.world.clock.stride
        collided, ego = episode.collided, episode.views[0].collided
        own = self._by_row([collided[:, vehicle] for vehicle in self._vehicles]).numpy()
        crash = ego.numpy() | own.reshape(self.scenarios, -1).any(axis=1)
        done = crash | (self._tick >= self.world.clock.ticks)
        done_rows, ego_rows = (map_kinds.repeat(len(self.agents)) for map_kinds in (done, ego.numpy()))
        terminated = own | ego_rows
        infos: dict[str, Any] = {}
        if done.any():
            infos["final_obs"], infos["_final_obs"] = to_object_rows(observation, done_rows), done_rows.copy()
            final: dict[str, Any] = {}
            put_masked(final, "collision", own, done_rows)
            put_masked(final, "ego_collision", ego_rows, done_rows)
            measures = self._by_row([episode.views[vehicle].f for vehicle in self._vehicles])
            put_masked(final, "measure", measures.double().numpy(), done_rows)
            infos["final_info"], infos["_final_info"] = final, done_rows.copy()
            episode = self._replace_scenarios(episode, np.flatnonzero(done))
            with torch.inference_mode():
                observation = self._observe(episode)
        self._episode = episode
        return observation, reward, terminated, done_rows & ~terminated, infos

    def _read(self, actions: Tensor) -> tuple[Tensor, Tensor]:
        """Return actions of all vehicles, (B, N, 2) or (B, N), and which are commanded (B, N)."""
        given = read_actions(self.world.clock.action, actions, self.num_envs)
        given = given.view(self.scenarios, len(self.agents), *given.shape[1:])
        shape = (self.scenarios, self.world.scenario.vehicles)
        chosen = torch.full(shape, IDLE) if self.world.clock.action == "meta" else torch.zeros(*shape, 2)
        chosen[:, self._vehicles] = given
        commanded = torch.zeros(shape, dtype=torch.bool)
        commanded[:, self._vehicles] = True
        return chosen, commanded

    def _by_row(self, columns: list[Tensor]) -> Tensor:
        """Return values of the agents, (B, ...) each, as (B A, ...)."""
        return torch.stack(columns, dim=1).flatten(0, 1)

    def _observe(self, episode: MultiAgentEpisode) -> Any:
        views = [observe(episode.views[vehicle], self.world.sensing.observation) for vehicle in self._vehicles]
        return map_kinds(lambda *parts: self._by_row(list(parts)).numpy(), *views)

    def _replace_scenarios(self, episode: MultiAgentEpisode, rows: NDArray[np.intp]) -> MultiAgentEpisode:
        x = self.space.scenario_x(None, len(rows), self.np_random)
        self._x[rows], self._tick[rows] = x, 0
        with torch.inference_mode():
            fresh = start(self.world, torch.from_numpy(x).float())
            return merge_rows(episode, torch.from_numpy(rows), fresh)


def _refuse_memory(memory: Any) -> None:
    """Raise a ValueError if the ego's driver has a memory."""
    kept = memory[0] if isinstance(memory, tuple) else memory
    if kept is not None:
        raise ValueError(
            "Expected an ego without memory: scenarios of a batch begin at different times, and a recurrent or stacked "
            "policy would remember another one's. rare_envs.parallel_env takes such egos."
        )
