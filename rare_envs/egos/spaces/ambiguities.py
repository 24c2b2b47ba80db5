"""Ambiguities of an ego's actions and observations that its spaces do not settle: notes and warnings."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

from numpy.typing import NDArray

from rare_envs.egos.spaces.choice import takes_indices
from rare_envs.egos.wrappers import find_action_bounds

AMBIGUOUS = (
    "the ego's actions 0 to 4 were taken as five accelerations; one that was trained in HighwayEnv needs "
    "action='meta' (--action meta)"
)
"""HighwayEnv's meta-actions and our discrete ones are both numbers from 0 to 4, and their spaces are equal."""
TAKEN_AS_ACCELERATIONS = (
    "the ego's actions 0 to 4 were taken as five accelerations; --action discrete says so without this note, and one "
    "that was trained with action='meta' needs --action meta"
)
"""Likewise for policies without HighwayEnv's observation, which rarely have its actions."""
RESCALED = (
    "the ego's actions, between {low} and {high}, are mapped to [-1, 1] as RescaleAction does; if they are in units of "
    "their own, put a function of yours around it"
)
"""A policy's bounds do not say whether they are those of a wrapper or units."""
DRIVES_ITSELF = "the ego accelerates and steers by itself: action={action!r} (--action {action}) changes nothing for it"
"""Scripts and learned drivers have no actions of another kind."""


class AmbiguousActions(UserWarning):
    """An ego's actions can be taken in two ways, or are not of the kind that was named."""


class MissingStatistics(UserWarning):
    """An ego seems to have been trained on normalised observations, and the statistics are not there."""


def name_ambiguities(action_space: Any, kinds: Collection[str]) -> tuple[str, ...]:
    """Return in how many ways the actions of a policy can be taken, where continuous ones are expected.

    Args:
        action_space: The policy's; None if it has none.
        kinds: Of observations that it gets.

    Example:
        >>> import gymnasium
        >>> name_ambiguities(gymnasium.spaces.Discrete(5), ("kinematics",)) == (AMBIGUOUS,)
        True
        >>> name_ambiguities(gymnasium.spaces.Box(-0.1, 0.1, (2,)), ("features",))[0][:47]
        "the ego's actions, between [-0.1, -0.1] and [0."
    """
    found = []
    if takes_indices(action_space):
        found.append(AMBIGUOUS if "kinematics" in kinds else TAKEN_AS_ACCELERATIONS)
    bounds = find_action_bounds(action_space)
    if bounds is not None:
        found.append(RESCALED.format(low=_round(bounds[0]), high=_round(bounds[1])))
    return tuple(found)


def _round(bounds: NDArray[Any]) -> list[float]:
    """Return bounds as people write them: float32 makes 0.10000000149011612 of 0.1."""
    return [float(f"{value:.4g}") for value in bounds]
