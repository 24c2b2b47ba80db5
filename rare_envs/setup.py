"""From the keyword arguments of `gym.make` to a world and its scenario space."""

from typing import Any

import numpy as np

from rare_envs.scenarios import SCENARIOS, Scenario
from rare_envs.space import PARAMETERS, ScenarioSpace, did_you_mean, load_base
from rare_envs.world import World

OBSERVATIONS = ("features",)
ACTIONS = ("continuous",)


def find_scenario(env_id: str) -> Scenario:
    """The scenario of an environment id.

    Raises:
        ValueError: If there is none; the message suggests the nearest id and lists all.
    """
    if isinstance(env_id, str) and env_id in SCENARIOS:
        return SCENARIOS[env_id]
    hint = did_you_mean(str(env_id), SCENARIOS)
    raise ValueError(f"Unknown environment {env_id!r}{hint}; the environments are {', '.join(SCENARIOS)}.")


def set_up(
    env_id: str,
    *,
    observation: str = "features",
    action: str = "continuous",
    measure: str = "ttc",
    horizon: float | None = None,
    dt: float = 0.1,
    base: Any = None,
) -> tuple[World, ScenarioSpace]:
    """The world and the scenario space of an environment.

    Args:
        env_id: For example "rare_envs/CutIn-v0".
        observation: "features".
        action: "continuous".
        measure: Name of the safety measure, "ttc".
        horizon: Length of an episode [s]; None takes the scenario's.
        dt: Tick [s].
        base: "us101", "highway", the path of a JSON file, or a distribution object; None takes "us101".

    Returns:
        The world and the space of its parameters.

    Raises:
        ValueError: If an argument is not one of those; the message says what is.
    """
    scenario = find_scenario(env_id)
    _one_of("observation", observation, OBSERVATIONS)
    _one_of("action", action, ACTIONS)
    world = World(scenario, dt=dt, horizon=horizon, measure=measure)
    parameters = PARAMETERS[scenario.name]
    space = ScenarioSpace(
        names=tuple(p.name for p in parameters),
        units=tuple(p.unit for p in parameters),
        low=np.array([p.low for p in parameters]),
        high=np.array([p.high for p in parameters]),
        base=load_base(scenario.name, "us101" if base is None else base),
    )
    return world, space


def _one_of(what: str, value: object, valid: tuple[str, ...]) -> None:
    if value not in valid:
        raise ValueError(f"Unknown {what} {value!r}; expected one of {', '.join(map(repr, valid))}.")
