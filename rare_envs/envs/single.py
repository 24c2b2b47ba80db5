"""Environment of one scenario at a time: a `gymnasium.Env` over a batch of one."""

import warnings
from collections import UserDict
from collections.abc import Mapping
from functools import cached_property
from types import MappingProxyType
from typing import Any, cast

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray

from rare_envs.control.actions import MAX_ACCELERATION, MAX_STEERING
from rare_envs.envs.rendering import RENDER_MODES, Renderer, make_scene
from rare_envs.envs.rows_and_infos import (
    SingleObservation,
    StatesLength,
    draw_scenarios,
    episode_info,
    open_reward,
    step_info,
    take_step,
)
from rare_envs.fast.choice import find_scripted_step
from rare_envs.make import CONFIGURATION_ARGUMENTS, set_up
from rare_envs.plugins import check_name
from rare_envs.simulation.decision import COLLISION_COST, total_of
from rare_envs.simulation.episode import Episode
from rare_envs.simulation.observation import map_kinds, observe

PICTURE_KEYS = frozenset(
    "screen_width screen_height centering_position scaling show_trajectories render_agent offscreen_rendering "
    "manual_control real_time_rendering".split()
)
"""Keys of HighwayEnv's configuration that change neither traffic nor spaces; they are kept, and the picture is ours."""
FRAME_RATE = "simulation_frequency"
"""The key that HighwayEnv's scripts set before they record a video, for more frames."""


class FixedConfiguration(UserDict[str, Any]):
    """HighwayEnv's configuration: keys of the picture can be set, what was fixed with the environment cannot.

    The frame rate stays too, but with a warning: HighwayEnv's scripts set it after the training, for a smoother video.
    """

    def __setitem__(self, name: str, value: Any) -> None:
        """Set a key of the picture, or another one to the value that it has."""
        if name in PICTURE_KEYS:
            self.data[name] = value
            return
        check_name("key of config", name, self)
        if self[name] == value:
            return
        argument = CONFIGURATION_ARGUMENTS.get(name)
        advice = f"give gym.make the argument {argument}" if argument else "it belongs to the scenario"
        message = (
            f"Expected config[{name!r}] to stay {self[name]!r}, got {value!r}; "
            f"it is fixed when the environment is made: {advice}."
        )
        if name != FRAME_RATE:
            raise ValueError(message)
        warnings.warn(message, stacklevel=2)


class DrivingEnv(StatesLength, gym.Env[SingleObservation, Any]):
    """Environment of the ego; everything else follows the scenario.

    Observation: `features`, see `rare_envs.simulation.observation`. Action: acceleration and steering in [-1, 1], see
    `rare_envs.control.actions`, for one tick; with `action="meta"` one of HighwayEnv's meta-actions, see
    `rare_envs.control.actions`, for one second. Reward: see `rare_envs.simulation.decision`. The episode terminates
    with a collision and is truncated at the horizon. `info` carries `scenario`, `x`, `min_ttc` [s], `collision`,
    `crashed` (the same), `speed` [m/s] and `reward_terms`, and at the end `measure` (f(x)), `collision_type` and
    `crash`, which say who ran into whom and how hard (`rare_envs.traffic.crash`), or None. Scripts for HighwayEnv
    find what they read: `config`, `vehicle`, `action_type` and others.
    """

    metadata = {"render_modes": list(RENDER_MODES), "render_fps": 10}  # noqa: RUF012  (Gymnasium's own form)

    def __init__(
        self, env_id: str, render_mode: str | None = None, core: str = "auto", reward: Any = None, **kwargs: Any
    ) -> None:
        """Make the environment.

        Args:
            env_id: The scenario's registered id.
            render_mode: None, "rgb_array" or "human".
            core: What carries out the steps, "torch" or "numba" (compiled, for scripted scenarios); "auto" for the
                compiled ones where they can be had. They differ by rounding.
            reward: What to reward, see `rare_envs.simulation.decision.find_reward`.
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
        self._tick, self._last_tick = 0, self.world.clock.ticks
        self._compiled = find_scripted_step(self.world, core)
        self._reward = open_reward(reward, self.world, self.space)
        self._between = False
        self._recorder: Any = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[SingleObservation, dict[str, Any]]:
        """Start an episode.

        Args:
            seed: Seeds the draw of the scenario.
            options: Scenario parameters by name, or {"x": vector} for all of them. What is not given is drawn: a
                whole x comes from the traffic model, then the given parameters replace theirs.

        Returns:
            Observation and info.
        """
        super().reset(seed=seed)
        self._x = draw_scenarios(self.world, self.space, options, 1, self.np_random)[0]
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
            episode, terms, features = take_step(
                self.world, self._compiled, self._episode, given, watch=watch, reward=self._reward
            )
            if features is not None and self.world.sensing.observation == "features":
                observation: SingleObservation = features[0]
            else:
                observation = self._observe(episode)
            reward = float(total_of(terms))
        self._episode, self._tick = episode, self._tick + self.world.clock.stride
        terminated = bool(episode.collided)
        truncated = not terminated and self._tick >= self._last_tick
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

    # What HighwayEnv's scripts read of its environments: it tells, and does not steer.

    @cached_property
    def config(self) -> FixedConfiguration:
        """The configuration under HighwayEnv's names: frequencies [Hz], duration [s], vehicles beside the ego."""
        clock, scenario = self.world.clock, self.world.scenario
        kinds = {"meta": "DiscreteMetaAction", "discrete": "DiscreteAction", "continuous": "ContinuousAction"}
        observation = self.world.sensing.observation
        configuration = FixedConfiguration()
        configuration.data = {
            "observation": MappingProxyType({"type": "Kinematics" if observation == "kinematics" else observation}),
            "action": MappingProxyType({"type": kinds[clock.action]}),
            "simulation_frequency": round(1.0 / clock.dt),
            "policy_frequency": clock.decisions_per_second,
            "duration": clock.seconds,
            "lanes_count": scenario.road.lanes,
            "vehicles_count": scenario.vehicles - 1,
            "controlled_vehicles": 1,
            "collision_reward": -COLLISION_COST,
            "normalize_reward": False,
            "offroad_terminal": True,
            "offscreen_rendering": self.render_mode != "human",
            "manual_control": False,
            "real_time_rendering": False,
        }
        return configuration

    def configure(self, config: Mapping[str, Any] | None) -> None:
        """Take a change of the configuration as HighwayEnv's method does; what is fixed is left out with a warning."""
        for name, value in (config or {}).items():
            try:
                self.config[name] = value
            except ValueError as error:
                warnings.warn(str(error), stacklevel=2)

    @property
    def vehicle(self) -> Any:
        """The ego, a `highway_env.vehicle.kinematics.Vehicle` at this moment; its `road` has all vehicles."""
        if self._episode is None:
            raise RuntimeError("Expected reset() before vehicle is read.")
        return make_scene(self._episode).vehicles[0]

    @property
    def action_type(self) -> Any:
        """HighwayEnv's description of the actions; of meta-actions it has `actions_indexes`."""
        from highway_env.envs.common.action import ContinuousAction, DiscreteMetaAction

        if self.world.clock.action == "meta":
            return DiscreteMetaAction(self)
        ranges = (-MAX_ACCELERATION, MAX_ACCELERATION), (-MAX_STEERING, MAX_STEERING)
        return ContinuousAction(self, acceleration_range=ranges[0], steering_range=ranges[1])

    def set_record_video_wrapper(self, wrapper: Any) -> None:
        """Let Gymnasium's `RecordVideo` have a frame of every tick of a meta-action, not one a second."""
        self._recorder = wrapper
        wrapper.frames_per_sec = round(1.0 / self.world.clock.dt)
