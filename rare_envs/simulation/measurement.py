"""Measurement: the safety measure of an episode, which collisions count, and whether statistics are kept."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

from rare_envs.measures import EpisodeMeasure
from rare_envs.measures.registry import find_measure

COLLISIONS = ("ego", "any")
"""Choices of the collisions that count."""


@dataclass(frozen=True)
class Measurement:
    """Measurement of an episode: its safety measure, and the collisions that count.

    Example:
        >>> Measurement("ttc").records, Measurement("pet").records
        (False, True)

    Raises:
        ValueError: If the measure is unknown, or `collisions` is not one of `COLLISIONS`.
    """

    measure: Any = "ttc"
    """Argument of `rare_envs.measures.find_measure`: a name, a `Measure`, a function of a `Moment`."""
    collisions: str = "ego"
    """Collisions that count: those of the "ego", or "any", those between other vehicles too."""
    statistics: bool = False
    """Whether to keep the least time to collision and who crashed with whom; see `Episode.statistics`."""

    def __post_init__(self) -> None:
        find_measure(self.measure)
        if self.collisions not in COLLISIONS:
            raise ValueError(f"Expected collisions 'ego' or 'any', got {self.collisions!r}.")

    @cached_property
    def episode_measure(self) -> EpisodeMeasure:
        """The measure itself."""
        return find_measure(self.measure)

    @property
    def records(self) -> bool:
        """Whether the measure keeps whole episodes."""
        return self.episode_measure.records
