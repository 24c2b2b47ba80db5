"""Info of one episode: what environments give beside observation and reward."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rare_envs.distributions.space import ScenarioSpace
from rare_envs.multi_agent.episode import view_order
from rare_envs.multi_agent.rewards import terms_of
from rare_envs.simulation.episode import Episode
from rare_envs.traffic.crash import describe_crash

Info = dict[str, Any]
SingleObservation = NDArray[np.float32]
"""Observation of one environment; in a world of several kinds a mapping of such by name."""


def episode_info(space: ScenarioSpace, x: NDArray[Any], episode: Episode) -> Info:
    """Return the info of one episode: `scenario`, `x`, `min_ttc` [s], `collision`, `crashed` (the same), `speed` [m/s].

    Args:
        space: Of its parameters.
        x: Their values, shape (d,).
        episode: A batch of one, in a world with statistics.
    """
    assert episode.statistics is not None
    collided = bool(episode.collided)
    return {
        "scenario": space.named(x),
        "x": x.copy(),
        "min_ttc": 0.0 if collided else float(episode.statistics.least_ttc),
        "collision": collided,
        "crashed": collided,
        "speed": float(episode.state.speed[0, 0]),
    }


def step_info(
    space: ScenarioSpace, x: NDArray[Any], episode: Episode, reward: Any, over: bool, vehicle: int = 0
) -> Info:
    """Return the info after a step.

    It adds `reward_terms` to that of `episode_info`, and at the end of an episode `measure`, `crash` and
    `collision_type`.

    Args:
        space: Of the scenario's parameters.
        x: Their values, shape (d,).
        episode: A batch of one, as a vehicle sees it.
        reward: Of the step, with its terms.
        over: Whether this is the end.
        vehicle: Whose episode it is.
    """
    info = episode_info(space, x, episode)
    info["reward_terms"] = {name: float(value) for name, value in terms_of(reward).items()}
    if over:
        assert episode.statistics is not None
        info["measure"] = float(episode.f)
        info["crash"] = crash = describe_crash(episode.statistics.crash)
        info["collision_type"] = None if crash is None else crash["kind"]
        if crash is not None and vehicle:
            order = view_order(vehicle, episode.state.x.shape[1])
            crash["vehicles"] = [each if each < 0 else order[each] for each in crash["vehicles"]]
    return info
