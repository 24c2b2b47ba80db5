"""Kinds of observation: their names, and functions of one kind or of several together by name."""

from collections.abc import Callable
from typing import Any

OBSERVATIONS = ("features", "lidar", "kinematics", "camera", "speed")
"""Kinds of observation by name."""
ELSEWHERE = (
    "; HighwayEnv's own (GrayscaleObservation, OccupancyGrid, Kinematics of other sizes) are in "
    "rare_envs.highway_env_problem and HighwayEnv's ids, such as highway-fast-v0"
)
"""Where to go with the observations that HighwayEnv has and this package has not."""


def read_kinds(observation: Any) -> str:
    """Return the kinds of an observation in the alphabetical order of their names, joined by "+".

    Args:
        observation: One of `OBSERVATIONS`, several joined by "+", or a list or tuple of them.

    Raises:
        ValueError: If it is none of these, or one is named twice.

    Example:
        >>> read_kinds(["speed", "camera"])
        'camera+speed'
    """
    names = observation.split("+") if isinstance(observation, str) else observation
    if not isinstance(names, list | tuple) or not names or not all(name in OBSERVATIONS for name in names):
        raise ValueError(
            f"Unknown observation {observation!r}; expected one of {', '.join(map(repr, OBSERVATIONS))}, or several, "
            f'such as "camera+lidar"{ELSEWHERE}.'
        )
    if len(set(names)) < len(names):
        raise ValueError(f"Expected different observations, got {observation!r}.")
    return "+".join(sorted(names))


def kinds_of(observation: str) -> tuple[str, ...]:
    """Return the kinds of an observation that `read_kinds` has written."""
    return tuple(observation.split("+"))


def map_kinds(function: Callable[..., Any], *observed: Any) -> Any:
    """Apply a function to an observation, or to each of those in a mapping.

    Args:
        function: Takes as many arguments as there are observations.
        *observed: Tensors or arrays, or mappings of such with the same names.
    """
    if isinstance(observed[0], dict):
        return {name: function(*(one[name] for one in observed)) for name in observed[0]}
    return function(*observed)


def batch_size(observed: Any) -> int:
    """Return the number of rows of an observation."""
    return len(next(iter(observed.values()))) if isinstance(observed, dict) else len(observed)
