"""Choice of observation and actions by the spaces that a policy declares, where nobody names them."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces

from rare_envs.control.actions import DISCRETE_ACTIONS
from rare_envs.egos.wrappers import find_frame_stacking
from rare_envs.sensors.kinds import ELSEWHERE, OBSERVATIONS, read_kinds
from rare_envs.simulation.ego_interface import EgoNeeds
from rare_envs.simulation.observation import observation_space

_COLOUR_CHANNELS = (3, 6, 9, 12)
"""Channels of one to four coloured frames side by side."""


def find_fitting_kinds(observed: Any, vehicles: int = 1) -> tuple[str, ...]:
    """Return the kinds of observation that fit the space of a policy; of several frames only if no single one does.

    Args:
        observed: The space that a policy declares. A `Dict` names the kinds, such as "camera+speed"; other spaces are
            known by their shape, and pictures of any size are those of the camera.
        vehicles: Of the scenario, whose features they are.

    Returns:
        Kinds as `rare_envs.sensors.kinds.read_kinds` writes them; none if nothing fits.

    Example:
        >>> find_fitting_kinds(observation_space(3, "features"), vehicles=3)
        ('features',)
        >>> find_fitting_kinds(observation_space(13, "lidar"), vehicles=13)  # 3 + 4 * 12 numbers, as the lidar has
        ('features', 'lidar')
        >>> find_fitting_kinds(spaces.Box(-1.0, 1.0, (22,)), vehicles=3)  # two frames
        ('features',)
    """
    if isinstance(observed, spaces.Dict):
        names = set(observed.spaces)
        return (read_kinds(sorted(names)),) if names and names <= set(OBSERVATIONS) else ()
    if _shows_pictures(observed):
        return ("camera",)
    found = {kind: find_frame_stacking(observation_space(vehicles, kind), observed) for kind in OBSERVATIONS}
    single = tuple(kind for kind, frames in found.items() if frames == (1, False))
    return single or tuple(kind for kind, frames in found.items() if frames is not None and kind != "speed")


def _shows_pictures(observed: Any) -> bool:
    """Return whether a space is that of coloured pictures, of one frame or several, channels first or last.

    The channels are the shorter of these two axes; the other one is a side of the picture, of any length.
    """
    shape = getattr(observed, "shape", None)  # whatever a user's ego declares
    if not isinstance(shape, tuple) or getattr(observed, "dtype", None) != np.uint8:
        return False
    return len(shape) in (3, 4) and min(shape[-1], shape[-3]) in _COLOUR_CHANNELS


def choose_observation(needs: EgoNeeds, vehicles: int) -> str:
    """Return the kinds of observation of an ego for which nobody names them.

    Args:
        needs: Of the ego.
        vehicles: Of the scenario.

    Raises:
        ValueError: Several fit its space, or none does.

    Example:
        >>> choose_observation(EgoNeeds(observations=("features", "lidar")), vehicles=13)
        Traceback (most recent call last):
        ValueError: The ego's observations fit features and lidar: say which by observation=... (--observation).
    """
    if len(needs.observations) == 1:
        return needs.observations[0]
    if needs.observations:
        fitting = " and ".join(needs.observations)
        raise ValueError(f"The ego's observations fit {fitting}: say which by observation=... (--observation).")
    known = {kind: observation_space(vehicles, kind).shape for kind in OBSERVATIONS}
    given = ", ".join(f"{kind} {shape}" for kind, shape in known.items())
    other = ELSEWHERE if len(getattr(needs.observation_space, "shape", None) or ()) > 1 else ""
    raise ValueError(
        f"The ego expects observations {needs.observation_space}, the environment gives one of {given}; train it on "
        f"one of these{other}."
    )


def choose_action(action_space: Any, observation: str) -> str:
    """Return the kind of actions of an ego for which nobody names it.

    Numbers from 0 to 4 are taken as five accelerations, but for policies with HighwayEnv's kinematics, which may as
    well have been trained with its meta-actions.

    Args:
        action_space: The space that a policy declares; None if it does not.
        observation: Its kinds of observation.

    Raises:
        ValueError: Both fit.

    Example:
        >>> choose_action(spaces.Discrete(5), "features")
        'continuous'
        >>> choose_action(spaces.Discrete(5), "kinematics")  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        ValueError: The ego's actions 0 to 4 fit two kinds: HighwayEnv's meta-actions (action='meta', --action meta; ...
    """
    if takes_indices(action_space) and "kinematics" in observation.split("+"):
        raise ValueError(
            "The ego's actions 0 to 4 fit two kinds: HighwayEnv's meta-actions (action='meta', --action meta; or the "
            "environment's id with -kinematics) and five accelerations (action='discrete', --action discrete); say "
            "which."
        )
    return "continuous"


def takes_indices(action_space: Any) -> bool:
    """Return whether actions are numbers from 0 to 4, which meta-actions are and accelerations by index too."""
    return isinstance(action_space, spaces.Discrete) and int(action_space.n) == len(DISCRETE_ACTIONS)
