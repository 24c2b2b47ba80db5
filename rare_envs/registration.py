"""Registration of ids. Entry points are strings, so importing is cheap."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Any

import gymnasium as gym

from rare_envs.scenarios.registry import (
    HIGHWAY_ENV_LAYOUT,
    SCENARIOS,
    env_id_of,
    kinematics_id,
    split_layout,
)

if TYPE_CHECKING:
    from rare_envs.envs.parallel import DrivingParallelEnv
    from rare_envs.scenarios.base import Scenario


# A version is a scenario of its own, with results of its own, and earlier ones are kept as they are. Warnings of other
# packages, and of versions that are registered under other namespaces, stay.
warnings.filterwarnings(
    "ignore", message=r".*The environment rare_envs/\S+ is out of date", category=DeprecationWarning
)


def register_envs() -> None:
    """Register the ids with Gymnasium, once, and each again with HighwayEnv's layout (`kinematics_id`)."""
    for env_id in SCENARIOS:
        for name, layout in ((env_id, {}), (kinematics_id(env_id), HIGHWAY_ENV_LAYOUT)):
            if name not in gym.registry:
                gym.register(
                    name,
                    entry_point="rare_envs.envs.single:DrivingEnv",
                    vector_entry_point="rare_envs.envs.vector:DrivingVectorEnv",
                    kwargs={"env_id": env_id, **layout},
                )


def register_scenario(env_id: str, scenario: Scenario) -> None:
    """Register a scenario of your own under an id, for `gym.make`, `parallel_env`, `DrivingProblem` and the rest.

    Args:
        env_id: In Gymnasium's form, such as "my_namespace/Overtaking-v0".
        scenario: The scenario; it is tried on a few draws of its default traffic model.

    Example:
        >>> import dataclasses, gymnasium as gym, rare_envs
        >>> from rare_envs.scenarios import SCENARIOS, find_scenario
        >>> rare_envs.register_scenario("docs/LongCutIn-v0", dataclasses.replace(find_scenario("cut_in"), horizon=20.0))
        >>> gym.make("docs/LongCutIn-v0").unwrapped.world.clock.seconds
        20.0
        >>> del SCENARIOS["docs/LongCutIn-v0"]

    Raises:
        ValueError: If the id is taken, or the scenario does not work.
    """
    from rare_envs.scenarios.base import try_scenario

    if env_id in gym.registry:
        raise ValueError(f"The id {env_id!r} is taken; choose another one.")
    try_scenario(scenario)
    SCENARIOS[env_id] = scenario
    register_envs()


def parallel_env(env_id: str, **kwargs: Any) -> DrivingParallelEnv:
    """Return the PettingZoo `ParallelEnv` of an id: every vehicle is an agent.

    Args:
        env_id: For example "rare_envs/CutIn-v0".
        **kwargs: `agents`, `ego`, `rewards` and `render_mode`, see `rare_envs.envs.parallel.DrivingParallelEnv`, and
            keyword arguments of `gym.make` for the id.

    Example:
        >>> import rare_envs
        >>> env = rare_envs.parallel_env("rare_envs/CutIn-v0")
        >>> env.possible_agents
        ['ego', 'cutter', 'lead']

    Raises:
        ValueError: If the id or an argument is unknown.
    """
    from rare_envs.envs.parallel import DrivingParallelEnv

    env_id, layout = split_layout(env_id_of(env_id))
    return DrivingParallelEnv(env_id, **{**layout, **kwargs})
