"""Environment of many scenarios at once: a `gymnasium.vector.VectorEnv` that is one batch, not many environments."""

import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray
from torch import Tensor

from rare_envs.devices import find_device, move_to
from rare_envs.distributions.space import ScenarioSpace
from rare_envs.envs.rendering import Renderer
from rare_envs.envs.rows_and_infos import (
    DrawsAhead,
    Info,
    StatesLength,
    draw_scenarios,
    list_tensors,
    mask_infos,
    merge_rows,
    open_reward,
    take_step,
    to_object_rows,
)
from rare_envs.fast.choice import find_scripted_step
from rare_envs.make import set_up
from rare_envs.plugins import check_name
from rare_envs.simulation.decision import name_terms, total_of
from rare_envs.simulation.episode import Episode
from rare_envs.simulation.observation import map_kinds, observe
from rare_envs.traffic.crash import CRASH_KINDS, NONE
from rare_envs.traffic.state import map_tensors


class DrivingVectorEnv(StatesLength, VectorEnv[NDArray[np.float32], NDArray[Any], NDArray[Any]]):
    """`DrivingEnv` for a whole batch, with Gymnasium's autoreset modes, SAME_STEP unless another one is asked for.

    With SAME_STEP an episode that ends is replaced within the step by one drawn from the traffic model; its last
    observation and info are in `infos["final_obs"]` and `infos["final_info"]`. With NEXT_STEP the next step replaces
    it, whose action does not count and whose reward is 0. With DISABLED a `reset` with options={"reset_mask": rows}
    does. One generator draws for the whole batch, but for episodes that were given seeds of their own.
    """

    metadata = {  # noqa: RUF012  (Gymnasium's own form)
        "render_modes": ["rgb_array"],
        "render_fps": 10,
        "autoreset_mode": AutoresetMode.SAME_STEP,
    }

    def __init__(
        self,
        env_id: str,
        num_envs: int = 1,
        render_mode: str | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
        max_episode_steps: int | None = None,
        core: str = "auto",
        device: str = "cpu",
        reward: Any = None,
        **kwargs: Any,
    ) -> None:
        """Make the batch.

        Args:
            env_id: The scenario's registered id.
            num_envs: Number of scenarios.
            render_mode: None or "rgb_array" (one image for each scenario).
            autoreset_mode: Gymnasium's, or its value: "SameStep", "NextStep" or "Disabled".
            max_episode_steps: Number of steps after which an episode is truncated before the horizon.
            core: What carries out the steps, "torch" or "numba" (compiled, for scripted scenarios); "auto" for the
                compiled ones where they can be had. They differ by rounding.
            device: Where torch carries them out: "cpu", or a GPU, such as "cuda". Observations and rewards are arrays
                as ever.
            reward: What to reward, see `rare_envs.simulation.decision.find_reward`.
            **kwargs: See `rare_envs.make.set_up`.
        """
        steps = sys.maxsize if max_episode_steps is None else max_episode_steps
        for name, count in (("num_envs", num_envs), ("max_episode_steps", steps)):
            if not isinstance(count, (int, np.integer)) or isinstance(count, bool) or count < 1:
                raise ValueError(f"Expected {name} of at least 1, got {count!r}.")
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"Expected render_mode None or 'rgb_array' for a batch, got {render_mode!r}.")
        if not isinstance(autoreset_mode, AutoresetMode):
            check_name("autoreset_mode", autoreset_mode, [mode.value for mode in AutoresetMode])
        self._mode = AutoresetMode(autoreset_mode)
        self.device = find_device(device)
        if self.device.type != "cpu" and core == "numba":
            raise ValueError(f"Expected core 'torch' or 'auto' with device={device!r}, got 'numba'.")
        world, self.space = set_up(env_id, **kwargs)
        if self.device.type != "cpu":
            world = replace(world, background=move_to(self.device, world.background))
        self._reward = open_reward(reward, world, self.space)
        self.world = world.with_statistics()
        fps = self.world.clock.decisions_per_second
        self.metadata = {**self.metadata, "render_fps": fps, "autoreset_mode": self._mode}
        self._last_tick = min(self.world.clock.ticks, steps * self.world.clock.stride)
        self.num_envs = int(num_envs)
        self.render_mode = render_mode
        self.single_observation_space = self.world.observation_space
        self.single_action_space = self.world.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._x = np.full((num_envs, self.space.dim), np.nan)
        self._tick = np.zeros(num_envs, dtype=np.int64)
        self._ended = np.zeros(num_envs, dtype=bool)
        """Episodes that are over and were not replaced yet."""
        self._own: dict[int, np.random.Generator] = {}
        """Generators of episodes that were given seeds of their own."""
        self._episode: Episode | None = None
        self._renderer = Renderer(self.world, render_mode)
        self._compiled = find_scripted_step(self.world, core) if self.device.type == "cpu" else None

    @property
    def space(self) -> ScenarioSpace:
        """The scenario space; from the traffic model of one that is set the next episodes are drawn."""
        return self._space

    @space.setter
    def space(self, value: ScenarioSpace) -> None:
        self._space, self._ahead = value, DrawsAhead(value.base)

    @property
    def np_random(self) -> np.random.Generator:
        """The generator of the batch, at the scenarios drawn so far."""
        self._ahead.settle()
        return super().np_random

    @np_random.setter
    def np_random(self, value: np.random.Generator) -> None:
        self._np_random, self._np_random_seed = value, -1

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], Info]:
        """Start all episodes.

        Args:
            seed: Seeds the one generator of the batch. Of a list each episode, and those that replace it, has a seed of
                its own and is that of `gym.make(...).reset(seed=...)`; None leaves it the generator that it has.
            options: Scenario parameters by name, scalars or arrays of shape (num_envs,), or {"x": (d,) or
                (num_envs, d)}; what is not given is drawn as in `DrivingEnv.reset`. "reset_mask", boolean of shape
                (num_envs,), names the R episodes to start, with arrays of as many values; the others go on.

        Returns:
            Observations, shape (num_envs, F), and infos.
        """
        mask, options = self._read_mask(options)
        if isinstance(seed, Sequence):
            if len(seed) != self.num_envs:
                raise ValueError(f"Expected one seed for each of {self.num_envs} environments, got {len(seed)}.")
            given = {row: seed[row] for row in np.flatnonzero(mask).tolist() if seed[row] is not None}
            self._own |= {row: seeding.np_random(each)[0] for row, each in given.items()}
        elif seed is not None:
            self._own.clear()
            super().reset(seed=seed)
        if mask.all():
            self._x = self._draw(np.arange(self.num_envs), options)
            self._tick[:] = 0
            with torch.inference_mode():
                self._episode = self._start(self._x)
        else:
            self._replace(np.flatnonzero(mask), options)
        self._ended[mask] = False
        assert self._episode is not None
        return self._observe(self._episode), self._info(self._episode, mask)

    def _read_mask(self, options: dict[str, Any] | None) -> tuple[NDArray[np.bool_], dict[str, Any] | None]:
        """Return which episodes `reset` is to start, and its other options."""
        if options is None or "reset_mask" not in options:
            return np.ones(self.num_envs, dtype=bool), options
        mask = np.asarray(options["reset_mask"])
        if mask.dtype != np.bool_ or mask.shape != (self.num_envs,) or not mask.any():
            raise ValueError(
                f"Expected reset_mask boolean of shape ({self.num_envs},) with at least one True, got {mask!r}."
            )
        if self._episode is None and not mask.all():
            raise RuntimeError("Expected reset() of all episodes before one with reset_mask.")
        return mask, {name: value for name, value in options.items() if name != "reset_mask"} or None

    def step(
        self, actions: NDArray[Any]
    ) -> tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], Info]:
        """Carry out one decision each; replace episodes that ended as the autoreset mode says.

        Raises:
            ValueError: If the actions have the wrong shape or are NaN.
            RuntimeError: Before `reset`; with autoreset disabled, where an episode has ended and was not reset.
        """
        if self._episode is None:
            raise RuntimeError("Expected reset() before step().")
        fresh = self._ended.copy()
        if self._mode == AutoresetMode.DISABLED and fresh.any():
            raise RuntimeError(
                "Expected reset(options={'reset_mask': ...}) before step(): episodes "
                f"{np.flatnonzero(fresh).tolist()} have ended and autoreset is disabled."
            )
        rows = np.flatnonzero(fresh)
        started = self._replace(rows) if len(rows) else None
        with torch.inference_mode():
            ignored = fresh if len(rows) else None
            episode, terms, features = take_step(
                self.world, self._compiled, self._episode, actions, ignored, reward=self._reward
            )
            if started is not None:  # which do not move in the step that starts them
                episode, features = merge_rows(episode, self._place(rows), started), None
            reward = total_of(terms).double().numpy(force=True)
        reward[fresh] = 0.0
        self._episode = episode
        self._tick += np.where(fresh, 0, self.world.clock.stride)
        terminated = episode.collided.numpy(force=True) & ~fresh
        truncated = (self._tick >= self._last_tick) & ~terminated & ~fresh
        known = features is not None and self.world.sensing.observation == "features"
        observation = features if known else self._observe(episode)
        observation, infos = self._finish(observation, terms, terminated | truncated, fresh)
        return observation, reward, terminated.copy(), truncated, infos

    def _finish(
        self, observation: Any, terms: Any, done: NDArray[np.bool_], fresh: NDArray[np.bool_]
    ) -> tuple[Any, Info]:
        """Return observations and infos after a step, and replace what ended if that is to be in the same step."""
        assert self._episode is not None
        episode, infos, everyone = self._episode, Info(), np.ones(self.num_envs, dtype=bool)
        earned = {"reward_terms": {name: each.double().numpy(force=True) for name, each in name_terms(terms).items()}}
        if self._mode != AutoresetMode.SAME_STEP:
            self._ended = done.copy()
            end = self._end_info(episode, done) if done.any() else {}
            return observation, self._info(episode, everyone) | mask_infos(earned, ~fresh) | end
        if done.any():
            final = self._info(episode, done) | mask_infos(earned, done) | self._end_info(episode, done)
            infos = {"final_obs": to_object_rows(observation, done), "_final_obs": done.copy()}
            infos |= {"final_info": final, "_final_info": done.copy()}
            rows, observation = np.flatnonzero(done), map_kinds(np.copy, observation)
            map_kinds(lambda old, new: old.__setitem__(rows, new), observation, self._observe(self._replace(rows)))
        return observation, infos | self._info(self._episode, everyone) | mask_infos(earned, ~done)

    def _observe(self, episode: Episode) -> Any:
        with torch.inference_mode():
            seen = observe(episode, self.world.sensing.observation)
            return map_kinds(lambda part: part.numpy(force=True), seen)

    def _place(self, values: NDArray[Any]) -> Tensor:
        """Return values as a tensor on the device."""
        return torch.from_numpy(values).to(self.device)

    def _start(self, x: NDArray[np.float64]) -> Episode:
        return self.world.start(self._place(x).float())

    def _replace(self, rows: NDArray[np.intp], options: dict[str, Any] | None = None) -> Episode:
        """Start the episodes of some rows anew, and return them, a batch of R."""
        assert self._episode is not None
        x = self._draw(rows, options)
        self._x = self._x.copy()
        self._x[rows] = x
        self._tick[rows] = 0
        with torch.inference_mode():
            started = self._start(x)
            self._episode = merge_rows(self._episode, self._place(rows), started)
        return started

    def _draw(self, rows: NDArray[np.intp], options: dict[str, Any] | None) -> NDArray[np.float64]:
        """Return scenarios (R, d) of some rows, of which those with a generator of their own draw from that."""
        rng = self.np_random if self._np_random is None else self._np_random  # without the property, which settles

        def draw(which: NDArray[np.intp]) -> NDArray[np.float64]:
            own = [self._own.get(row) for row in rows[which].tolist()]
            common = iter(self._ahead.sample(own.count(None), rng) if None in own else ())
            return np.stack([next(common) if each is None else self.space.base.sample(1, each)[0] for each in own])

        draw_rows = draw if self._own else lambda which: self._ahead.sample(len(which), rng)
        return draw_scenarios(self.world, self.space, options, len(rows), rng, draw_rows)

    def _info(self, episode: Episode, mask: NDArray[np.bool_]) -> Info:
        assert episode.statistics is not None
        collided = episode.collided.numpy(force=True)
        least = episode.statistics.least_ttc.double().numpy(force=True)
        info = {
            "scenario": self.space.columns(self._x),
            "x": self._x.copy(),
            "min_ttc": np.where(collided, 0.0, least),
            "collision": collided.copy(),
            "crashed": collided.copy(),  # HighwayEnv's name of it
            "speed": episode.state.speed[:, 0].double().numpy(force=True),
        }
        return mask_infos(info, mask)

    def _end_info(self, episode: Episode, done: NDArray[np.bool_]) -> Info:
        """Return what is known at the end of episodes: `measure`, `collision_type` and `crash`."""
        assert episode.statistics is not None
        crash = {name: each.numpy(force=True) for name, each in episode.statistics.crash._asdict().items()}
        kinds = np.array(CRASH_KINDS, dtype=object)[crash["kind"]]
        crashed = done & (crash["kind"] != NONE)
        kinds[~crashed] = None
        measure = mask_infos({"measure": episode.f.double().numpy(force=True)}, done)
        return measure | mask_infos({"collision_type": kinds, "crash": crash | {"kind": kinds}}, crashed)

    def export_state(self) -> dict[str, Any]:
        """Return the episodes under way and the generators, to go on with them in another process: `restore_state`.

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
            "ended": torch.from_numpy(self._ended.copy()),
            "episode": [tensor.clone().cpu() for tensor in list_tensors(self._episode)],
            "generators": json.dumps(
                [(k, g.bit_generator.state) for k, g in {-1: self.np_random, **self._own}.items()]
            ),
        }

    def restore_state(self, state: dict[str, Any]) -> None:
        """Go on with the episodes of `export_state` of an environment with the same arguments, after a reset.

        Raises:
            ValueError: They are of another environment.
        """
        old, new = list_tensors(self._episode), list(state["episode"])
        if [(each.shape, each.dtype) for each in old] != [(each.shape, each.dtype) for each in new]:
            raise ValueError("The episodes are of another environment.")
        self._episode = map_tensors(lambda _: new.pop(0).to(self.device), self._episode)
        self._x, self._tick = state["x"].numpy().copy(), state["tick"].numpy().copy()
        self._ended = state["ended"].numpy().copy()
        self._own.clear()
        for row, kept in json.loads(state["generators"]):
            rng = self.np_random if row < 0 else self._own.setdefault(row, np.random.default_rng())
            rng.bit_generator.state = kept

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """One (H, W, 3) image for each scenario."""
        if self.render_mode is None or self._episode is None:
            gym.logger.warn("Nothing to render: pass render_mode='rgb_array' to gym.make_vec and reset first.")
            return None
        episode, draw, dt = self._episode, self._renderer.draw, self.world.clock.dt
        return tuple(draw(episode, self._tick[row] * dt, row).copy() for row in range(self.num_envs))
