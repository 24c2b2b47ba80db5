"""Attributes that scripts for HighwayEnv read from `env.unwrapped`: configuration, vehicle and actions."""

import warnings
from collections import UserDict
from collections.abc import Mapping
from functools import cached_property
from types import MappingProxyType
from typing import Any

from rare_envs.control.actions import MAX_ACCELERATION, MAX_STEERING
from rare_envs.envs.rendering import make_scene
from rare_envs.make import CONFIGURATION_ARGUMENTS
from rare_envs.plugins import check_name
from rare_envs.simulation.decision import COLLISION_COST
from rare_envs.simulation.episode import Episode
from rare_envs.simulation.world import World

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


class HighwayEnvInterface:
    """Attributes of HighwayEnv's environments, for code that reads them: they tell, and do not steer."""

    world: World
    render_mode: str | None
    _episode: Episode | None
    _recorder: Any = None

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
