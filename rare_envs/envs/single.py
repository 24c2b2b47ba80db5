"""Environment of one scenario at a time: a `gymnasium.Env` over a batch of one."""

from typing import Any, cast

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray

from rare_envs.envs.highway_env_interface import HighwayEnvInterface
from rare_envs.envs.rendering import RENDER_MODES, Renderer
from rare_envs.envs.rows_and_infos import SingleObservation, episode_info, step_info, take_step
from rare_envs.fast.choice import find_scripted_step
from rare_envs.make import set_up
from rare_envs.simulation.episode import Episode
from rare_envs.simulation.observation import map_kinds, observe


class DrivingEnv(HighwayEnvInterface, gym.Env[SingleObservation, Any]):
    """Environment of the ego; everything else follows the scenario.

    Observation: `features`, see `rare_envs.simulation.observation`. Action: acceleration and steering in [-1, 1], see
    `rare_envs.control.actions`, for one tick; with `action="meta"` one of HighwayEnv's meta-actions, see
    `rare_envs.control.actions`, for one second. Reward: see `rare_envs.simulation.decision`. The episode terminates
    with a collision and is truncated at the horizon. `info` carries `scenario`, `x`, `min_ttc` [s], `collision`,
    `crashed` (the same), `speed` [m/s] and `reward_terms`, and at the end `measure` (f(x)), `collision_type` and
    `crash`, which say who ran into whom and how hard (`rare_envs.traffic.crash`), or None. Scripts for HighwayEnv
    find what they read, see `rare_envs.envs.highway_env_interface`.
    """

    metadata = {"render_modes": list(RENDER_MODES), "render_fps": 10}  # noqa: RUF012  (Gymnasium's own form)

    def __init__(self, env_id: str, render_mode: str | None = None, core: str = "auto", **kwargs: Any) -> None:
        """Make the environment.

        Args:
            env_id: The scenario's registered id.
            render_mode: None, "rgb_array" or "human".
            core: What carries out the steps, "torch" or "numba" (compiled, for scripted scenarios); "auto" for the
                compiled ones where they can be had. They differ by rounding.
            **kwargs: See `rare_envs.make.set_up`.
        """
        world, self.space = set_up(env_id, **kwargs)
        self.world = world.with_statistics()
        self.observation_space = self.world.observation_space
        self.action_space = self.world.action_space
        self.metadata = {**self.metadata, "render_fps": self.world.clock.decisions_per_second}
        self.render_mode = render_mode
        self._renderer = Renderer(self.world, render_mode)
        self._x = np.full(self.space.dim, np.nan)
        self._episode: Episode | None = None
        self._tick = 0
        self._compiled = find_scripted_step(self.world, core)
        self._between = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[SingleObservation, dict[str, Any]]:
        """Start an episode.

        Args:
            seed: Seeds the draw of the scenario.
            options: Scenario parameters by name, or {"x": vector} for all of them. What is not given is drawn: a
                whole x comes from the base distribution, then the given parameters replace theirs.

        Returns:
            Observation and info.
        """
        super().reset(seed=seed)
        self._x = self.space.scenario_x(options, 1, self.np_random)[0]
        self._tick = 0
        with torch.inference_mode():
            self._episode = self.world.start(torch.from_numpy(self._x[None]).float())
            observation = self._observe(self._episode)
        if self._renderer.is_window:
            self.render()
        return observation, episode_info(self.space, self._x, self._episode)

    def step(self, action: Any) -> tuple[SingleObservation, float, bool, bool, dict[str, Any]]:
        """Carry out one decision; see the class for what comes back.

        Raises:
            ValueError: If the action has the wrong shape or is NaN.
        """
        if self._episode is None:
            raise RuntimeError("Expected reset() before step().")
        if np.shape(action) != self.action_space.shape:
            wanted = "of shape (2,) (acceleration, steering)" if self.action_space.shape else "as one whole number"
            raise ValueError(f"Expected an action {wanted}, got shape {np.shape(action)}.")
        self._between = False
        watched = self.world.clock.stride > 1 and (self._recorder or self._renderer.is_window)
        watch = self._watch if watched else None
        with torch.inference_mode():
            given = np.asarray(action)[None]
            episode, terms, features = take_step(self.world, self._compiled, self._episode, given, watch=watch)
            if features is not None and self.world.sensing.observation == "features":
                observation: SingleObservation = features[0]
            else:
                observation = self._observe(episode)
            reward = float(terms.total)
        self._episode, self._tick = episode, self._tick + self.world.clock.stride
        terminated = bool(episode.collided)
        truncated = not terminated and self._tick >= self.world.clock.ticks
        info = step_info(self.space, self._x, episode, terms, terminated or truncated)
        if self._renderer.is_window:
            self.render()
        return observation, reward, terminated, truncated, info

    def _observe(self, episode: Episode) -> SingleObservation:
        """Return what the ego observes now, an array or a dictionary of arrays."""
        observed = observe(episode, self.world.sensing.observation)
        return cast("SingleObservation", map_kinds(lambda part: part[0].numpy(), observed))

    def _watch(self, episode: Episode) -> None:
        """Render the ticks within a decision; its last one is rendered after it."""
        if self._between and self._renderer.is_window:
            self.render()
        elif self._between:
            self._recorder._capture_frame()
        self._episode, self._between = episode, True

    def render(self) -> NDArray[np.uint8] | None:
        """Draw the road with HighwayEnv's graphics: an (H, W, 3) image for "rgb_array", a window for "human"."""
        return self._renderer.render(self._episode, self._tick * self.world.clock.dt)

    def close(self) -> None:
        """Close the window."""
        self._renderer.close()
