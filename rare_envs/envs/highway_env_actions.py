"""HighwayEnv's description of the actions of an environment of ours, which its users read from `env.action_type`."""

from typing import Any

from gymnasium import spaces
from highway_env.envs.common.action import ActionType, ContinuousAction, DiscreteAction, DiscreteMetaAction

from rare_envs.control.actions import DISCRETE_ACTIONS, MAX_ACCELERATION, MAX_STEERING, space_of_actions

_RANGES = {
    "acceleration_range": (-MAX_ACCELERATION, MAX_ACCELERATION),
    "steering_range": (-MAX_STEERING, MAX_STEERING),
}


class IndexedAccelerations(DiscreteAction):  # type: ignore[misc] # HighwayEnv has no types
    """Accelerations by index, straight ahead: rows of `DISCRETE_ACTIONS`, where HighwayEnv's lie on an even grid.

    Example:
        >>> IndexedAccelerations(None).actions
        {0: '-5 m/s^2', 1: '-2 m/s^2', 2: '+0 m/s^2', 3: '+1 m/s^2', 4: '+2 m/s^2'}
    """

    def __init__(self, env: Any) -> None:
        """Describe the actions of an environment."""
        super().__init__(env, **_RANGES)
        self.actions = {k: f"{MAX_ACCELERATION * row[0]:+.0f} m/s^2" for k, row in enumerate(DISCRETE_ACTIONS)}
        """Labels by index."""
        self.actions_indexes = {label: k for k, label in self.actions.items()}
        """Indices by label."""

    def space(self) -> spaces.Space[Any]:
        """Return the space of the indices."""
        return space_of_actions("discrete")

    def get_available_actions(self) -> list[int]:
        """Return the indices; each is available at all times."""
        return list(self.actions)

    def act(self, action: int) -> None:
        """Give the vehicle that `env.vehicle` shows the acceleration of an index."""
        ContinuousAction.act(self, DISCRETE_ACTIONS[int(action)])


def describe_actions(env: Any, kind: str) -> ActionType:
    """Return HighwayEnv's description of a kind of action of an environment.

    Example:
        >>> describe_actions(None, "meta").actions_indexes["FASTER"], describe_actions(None, "discrete").space()
        (3, Discrete(5))
    """
    if kind == "meta":
        return DiscreteMetaAction(env)
    return IndexedAccelerations(env) if kind == "discrete" else ContinuousAction(env, **_RANGES)
