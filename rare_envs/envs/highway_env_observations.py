"""HighwayEnv's description of what the ego observes, which its users read from `env.observation_type`."""

from typing import Any

from gymnasium import spaces
from highway_env.envs.common.observation import KinematicObservation, ObservationType


class EpisodeObservation(ObservationType):  # type: ignore[misc] # HighwayEnv has no types
    """The observation of an environment of ours, of any kind.

    Example:
        >>> import gymnasium
        >>> env = gymnasium.make("rare_envs/CutIn-v0").unwrapped
        >>> observation, _ = env.reset(seed=0)
        >>> EpisodeObservation(env).space().shape, (EpisodeObservation(env).observe() == observation).all()
        ((11,), np.True_)
    """

    def space(self) -> spaces.Space[Any]:
        """Return the space of the environment's observations."""
        space: spaces.Space[Any] = self.env.observation_space
        return space

    def observe(self) -> Any:
        """Return what the ego observes now, as `step` returns it.

        Raises:
            RuntimeError: Before the first reset.
        """
        if self.env._episode is None:
            raise RuntimeError("Expected reset() before observe().")
        return self.env._observe(self.env._episode)


class KinematicsRows(EpisodeObservation, KinematicObservation):  # type: ignore[misc] # HighwayEnv has no types
    """The observation "kinematics", with HighwayEnv's settings such as `features` and `vehicles_count`."""


def describe_observation(env: Any, kind: str) -> ObservationType:
    """Return HighwayEnv's description of a kind of observation of an environment.

    Example:
        >>> described = describe_observation(None, "kinematics")
        >>> described.features, described.vehicles_count
        (['presence', 'x', 'y', 'vx', 'vy'], 5)
    """
    return KinematicsRows(env) if kind == "kinematics" else EpisodeObservation(env)
