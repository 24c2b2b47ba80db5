"""Environment of many scenarios at once: a `gymnasium.vector.VectorEnv` that is one batch, not many environments."""

import json
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray
from torch import Tensor

from rare_envs.control.actions import read_actions
from rare_envs.envs.batch_rows import (
    list_tensors,
    merge_rows,
    put_masked,
    put_tensors,
    replace_rows,
    to_object_rows,
)
from rare_envs.envs.info import Info
from rare_envs.envs.rendering import Renderer
from rare_envs.make import set_up
from rare_envs.sensors.kinds import map_kinds
from rare_envs.simulation.decision import advance
from rare_envs.simulation.episode import Episode
from rare_envs.simulation.observation import observe
from rare_envs.simulation.reward import RewardTerms
from rare_envs.traffic.crash import CRASH_KINDS, NONE


class DrivingVectorEnv(VectorEnv[NDArray[np.float32], NDArray[Any], NDArray[Any]]):
    """`DrivingEnv` for a whole batch, with Gymnasium's SAME_STEP autoreset.

    An episode that ends is replaced within the step by one drawn from the base distribution; its last observation
    and info are in `infos["final_obs"]` and `infos["final_info"]`. One generator draws for the whole batch.

    Example:
        >>> env = DrivingVectorEnv("rare_envs/CutIn-v0", num_envs=3)
        >>> observations, infos = env.reset(seed=0, options={"cut_in_gap": [9.0, 20.0, 40.0]})
        >>> observations.shape, infos["scenario"]["cut_in_gap"].tolist()
        ((3, 11), [9.0, 20.0, 40.0])
    """

    metadata = {  # noqa: RUF012  (Gymnasium's own form)
        "render_modes": ["rgb_array"],
        "render_fps": 10,
        "autoreset_mode": AutoresetMode.SAME_STEP,
    }

    def __init__(self, env_id: str, num_envs: int = 1, render_mode: str | None = None, **kwargs: Any) -> None:
        """Make the batch.

        Args:
            env_id: The scenario's registered id.
            num_envs: Number of scenarios.
            render_mode: None or "rgb_array" (one image for each scenario).
            **kwargs: See `rare_envs.make.set_up`.

        Raises:
            ValueError: If an argument is invalid.
        """
        if not isinstance(num_envs, (int, np.integer)) or isinstance(num_envs, bool) or num_envs < 1:
            raise ValueError(f"Expected num_envs of at least 1, got {num_envs!r}.")
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"Expected render_mode None or 'rgb_array' for a batch, got {render_mode!r}.")
        world, self.space = set_up(env_id, **kwargs)
        self.world = world.with_statistics()
        self.metadata = {**self.metadata, "render_fps": self.world.clock.decisions_per_second}
        self.num_envs = int(num_envs)
        self.render_mode = render_mode
        self.single_observation_space = self.world.observation_space
        self.single_action_space = self.world.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._x = np.full((num_envs, self.space.dim), np.nan)
        self._tick = np.zeros(num_envs, dtype=np.int64)
        self._episode: Episode | None = None
        self._renderer: Renderer | None = None

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], Info]:
        """Start all episodes.

        Args:
            seed: Seeds the one generator of the batch; a list is taken as one seed.
            options: Scenario parameters by name, scalars or arrays of shape (num_envs,), or {"x": (d,) or
                (num_envs, d)}; what is not given is drawn as in `DrivingEnv.reset`.

        Returns:
            Observations, shape (num_envs, F), and infos.

        Raises:
            ValueError: If an option is unknown, of the wrong shape, NaN or outside its range.
        """
        if isinstance(seed, list):
            self._np_random = np.random.default_rng([s for s in seed if s is not None] or None)
        else:
            super().reset(seed=seed)
        self._x = self.space.scenario_x(options, self.num_envs, self.np_random)
        self._tick[:] = 0
        with torch.inference_mode():
            self._episode = self._start(self._x)
            observation = map_kinds(Tensor.numpy, observe(self._episode, self.world.sensing.observation))
        return observation, self._info(self._episode, np.ones(self.num_envs, dtype=bool))

    def step(
        self, actions: NDArray[Any]
    ) -> tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], Info]:
        """Carry out one decision each and replace the episodes that ended.

        Raises:
            ValueError: If the actions have the wrong shape or are NaN.
        """
        if self._episode is None:
            raise RuntimeError("Expected reset() before step().")
        with torch.inference_mode():
            given = read_actions(self.world.clock.action, torch.as_tensor(np.asarray(actions)), self.num_envs)
            episode, terms = advance(self.world, self._episode, given)
            observation = map_kinds(Tensor.numpy, observe(episode, self.world.sensing.observation))
            reward = terms.total.double().numpy()
        self._episode = episode
        self._tick += self.world.clock.stride
        terminated = episode.collided.numpy()
        truncated = (self._tick >= self.world.clock.ticks) & ~terminated
        done = terminated | truncated
        infos: Info = {}
        if done.any():
            infos["final_obs"], infos["_final_obs"] = to_object_rows(observation, done), done.copy()
            infos["final_info"], infos["_final_info"] = self._final_info(episode, terms, done), done.copy()
            observation = self._replace(observation, done)
        infos.update(self._info(self._episode, np.ones(self.num_envs, dtype=bool)))
        put_masked(infos, "reward_terms", _terms(terms, ~done), ~done)
        return observation, reward, terminated.copy(), truncated, infos

    def _start(self, x: NDArray[np.float64]) -> Episode:
        return self.world.start(torch.from_numpy(x).float())

    def _replace(self, observation: Any, done: NDArray[np.bool_]) -> Any:
        rows = np.flatnonzero(done)
        assert self._episode is not None
        x = self.space.scenario_x(None, len(rows), self.np_random)
        self._x = self._x.copy()
        self._x[rows] = x
        self._tick[rows] = 0
        with torch.inference_mode():
            fresh = self._start(x)
            self._episode = merge_rows(self._episode, torch.from_numpy(rows), fresh)
            seen = map_kinds(Tensor.numpy, observe(fresh, self.world.sensing.observation))
        return replace_rows(observation, rows, seen)

    def _info(self, episode: Episode, mask: NDArray[np.bool_]) -> Info:
        assert episode.statistics is not None
        collided = episode.collided.numpy()
        infos: Info = {}
        scenario: Info = {}
        for name, column in self.space.columns(self._x).items():
            put_masked(scenario, name, column, mask)
        put_masked(infos, "scenario", scenario, mask)
        put_masked(infos, "x", self._x.copy(), mask)
        put_masked(infos, "min_ttc", np.where(collided, 0.0, episode.statistics.least_ttc.double().numpy()), mask)
        put_masked(infos, "collision", collided.copy(), mask)
        put_masked(infos, "crashed", collided.copy(), mask)  # HighwayEnv's name of it
        put_masked(infos, "speed", episode.state.speed[:, 0].double().numpy(), mask)
        return infos

    def _final_info(self, episode: Episode, terms: RewardTerms, done: NDArray[np.bool_]) -> Info:
        infos = self._info(episode, done)
        assert episode.statistics is not None
        crash = episode.statistics.crash
        crashed = done & (crash.kind != NONE).numpy()
        kinds = np.array(CRASH_KINDS, dtype=object)[crash.kind.numpy()]
        kinds[~crashed] = None
        put_masked(infos, "reward_terms", _terms(terms, done), done)
        put_masked(infos, "measure", episode.f.double().numpy(), done)
        put_masked(infos, "collision_type", kinds, crashed)
        details: Info = {}
        for name, values in {**crash._asdict(), "kind": kinds}.items():
            put_masked(details, name, values if name == "kind" else values.numpy(), crashed)
        put_masked(infos, "crash", details, crashed)
        return infos

    def export_state(self) -> dict[str, Any]:
        """Return the episodes under way and the generator, to go on with them in another process: `restore_state`.

        Returns:
            Tensors and text only.

        Raises:
            RuntimeError: Before the first reset.
        """
        if self._episode is None:
            raise RuntimeError("Expected reset() before export_state().")
        return {
            "x": torch.from_numpy(self._x.copy()),
            "tick": torch.from_numpy(self._tick.copy()),
            "episode": [tensor.clone() for tensor in list_tensors(self._episode)],
            "generator": json.dumps(self.np_random.bit_generator.state),
        }

    def restore_state(self, state: dict[str, Any]) -> None:
        """Go on with the episodes of `export_state` of an environment with the same arguments, after a reset.

        Raises:
            ValueError: They are of another environment.
        """
        tensors = iter(state["episode"])
        self._episode = put_tensors(self._episode, tensors)
        if next(tensors, None) is not None or state["x"].shape != self._x.shape:
            raise ValueError("The episodes are of another environment.")
        self._x, self._tick = state["x"].numpy().copy(), state["tick"].numpy().copy()
        self.np_random.bit_generator.state = json.loads(state["generator"])

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """One (H, W, 3) image for each scenario."""
        if self.render_mode is None or self._episode is None:
            gym.logger.warn("Nothing to render: pass render_mode='rgb_array' to gym.make_vec and reset first.")
            return None
        if self._renderer is None:
            self._renderer = Renderer(self.world, False, self.metadata["render_fps"])
        episode, draw, dt = self._episode, self._renderer.draw, self.world.clock.dt
        return tuple(draw(episode, self._tick[row] * dt, row).copy() for row in range(self.num_envs))


def _terms(terms: RewardTerms, mask: NDArray[np.bool_]) -> Info:
    """Return the terms of the reward in Gymnasium's vector form."""
    infos: Info = {}
    for name, value in terms._asdict().items():
        put_masked(infos, name, value.double().numpy(), mask)
    return infos
