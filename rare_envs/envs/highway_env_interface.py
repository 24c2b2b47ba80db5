"""Attributes that code for HighwayEnv reads from `env.unwrapped`: configuration, road, vehicle and actions."""

import warnings
from collections.abc import Mapping
from functools import cached_property
from typing import Any

from rare_envs.envs.highway_env_configuration import PICTURE_KEYS, FixedConfiguration
from rare_envs.envs.highway_env_objects import make_scene
from rare_envs.simulation.episode import Episode
from rare_envs.simulation.reward import COLLISION_COST
from rare_envs.simulation.world import World


class HighwayEnvInterface:
    """Attributes of HighwayEnv's environments, for code that reads them: they tell, and do not steer.

    Example:
        >>> import gymnasium
        >>> env = gymnasium.make("rare_envs/CutIn-kinematics-v0").unwrapped
        >>> _ = env.reset(seed=0, options={"ego_speed": 20.0, "cut_in_gap": 30.0})
        >>> env.vehicle.speed, env.vehicle.crashed, len(env.road.vehicles)
        (20.0, False, 3)
        >>> env.action_type.actions_indexes["FASTER"], env.config["policy_frequency"]
        (3, 1)
        >>> _ = env.step(1)
        >>> env.time, env.get_available_actions(), env.observation_type.observe().shape
        (1.0, [1, 2, 3], (5, 5))
    """

    world: World
    render_mode: str | None
    reset: Any
    """Of the environment."""
    _episode: Episode | None
    _tick: int
    _scene: tuple[Episode, Any] | None = None

    @cached_property
    def config(self) -> FixedConfiguration:
        """The configuration under HighwayEnv's names: frequencies [Hz], duration [s], vehicles beside the ego.

        What concerns the picture may be set; for every other key a new value raises a `ValueError` that says which
        argument of gym.make to use.
        """
        clock, scenario = self.world.clock, self.world.scenario
        kinds = {"meta": "DiscreteMetaAction", "discrete": "DiscreteAction", "continuous": "ContinuousAction"}
        observation = self.world.sensing.observation
        values: dict[str, Any] = {
            "observation": {"type": "Kinematics" if observation == "kinematics" else observation},
            "action": {"type": kinds[clock.action]},
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
        return FixedConfiguration(values)

    def configure(self, config: Mapping[str, Any] | None) -> None:
        """Take a change of the configuration as HighwayEnv's method does, as far as it concerns the picture.

        Args:
            config: Keys and values. What defines scenario, spaces and time is fixed when the environment is made; such
                a change is left out, with a warning that names it.
        """
        stay = []
        for name, value in (config or {}).items():
            if name in PICTURE_KEYS:
                self.config[name] = value
            elif name not in self.config or self.config[name] != value:
                stay.append(name)
        if stay:
            warnings.warn(
                f"configure() leaves {', '.join(stay)} as they are: the scenario and its time are fixed when the "
                "environment is made; gym.make takes dt, horizon, observation, action and base.",
                stacklevel=2,
            )

    @property
    def road(self) -> Any:
        """The road with all vehicles, the ego first, a `highway_env.road.road.Road`.

        Before the first reset, as with HighwayEnv, that of an episode which is begun for it.
        """
        if self._episode is None:
            self.reset()
        assert self._episode is not None
        if self._scene is None or self._scene[0] is not self._episode:
            self._scene = (self._episode, make_scene(self._episode))
        return self._scene[1]

    @property
    def controlled_vehicles(self) -> list[Any]:
        """The ego, in a list."""
        vehicles: list[Any] = self.road.vehicles
        return vehicles[:1]

    @property
    def vehicle(self) -> Any:
        """The ego, a `highway_env.vehicle.kinematics.Vehicle` at this moment."""
        return self.controlled_vehicles[0]

    @property
    def action_type(self) -> Any:
        """HighwayEnv's description of the actions, with their space; with indices it has `actions_indexes`."""
        from rare_envs.envs.highway_env_actions import describe_actions

        return describe_actions(self, self.world.clock.action)

    def get_available_actions(self) -> list[int]:
        """Return the indices of the actions that are possible now, as HighwayEnv does.

        Raises:
            ValueError: If actions are continuous.
            RuntimeError: Before the first reset.
        """
        if self.world.clock.action == "continuous":
            raise ValueError('Expected actions with indices, got action="continuous"; make it with action="meta".')
        if self._episode is None:
            raise RuntimeError("Expected reset() before get_available_actions().")
        available: list[int] = self.action_type.get_available_actions()
        return available

    @property
    def observation_type(self) -> Any:
        """What the ego observes, with HighwayEnv's `space()` and `observe()`, which gives the observation of now."""
        from rare_envs.envs.highway_env_observations import describe_observation

        return describe_observation(self, self.world.sensing.observation)

    @property
    def time(self) -> float:
        """Time since the reset [s]."""
        return round(self._tick * self.world.clock.dt, 9)

    @property
    def steps(self) -> int:
        """Ticks since the reset, as HighwayEnv counts them: simulation steps, not decisions."""
        return self._tick
