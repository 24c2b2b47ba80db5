"""Safety measures: how close an episode came to a collision; small is dangerous, always finite."""

from types import MappingProxyType
from typing import Any

from rare_envs.measures.base import COLLISION, EpisodeMeasure, Measure
from rare_envs.measures.following import TTC_MAX, lidar_ttc, ttc
from rare_envs.measures.moment import Moment
from rare_envs.space import did_you_mean

__all__ = [
    "COLLISION",
    "MEASURES",
    "TTC_MAX",
    "EpisodeMeasure",
    "Measure",
    "Moment",
    "find_measure",
    "lidar_ttc",
    "ttc",
]

MEASURES: MappingProxyType[str, EpisodeMeasure] = MappingProxyType(
    {"ttc": Measure(ttc), "lidar_ttc": Measure(lidar_ttc, sees=True, collision=None)}
)
"""Measures by name."""


def find_measure(measure: Any) -> EpisodeMeasure:
    """The measure that a keyword argument `measure` stands for.

    Args:
        measure: Name of one, a `Measure` or another object with its methods, or a function from a `Moment` of B
            scenarios to shape (B,): small is dangerous, the least over the moments counts, a collision counts as -1.

    Raises:
        ValueError: If it is none of these; an unknown name comes with the nearest known one.
    """
    if isinstance(measure, str) and measure in MEASURES:
        return MEASURES[measure]
    if not isinstance(measure, str | type):
        if all(callable(getattr(measure, name, None)) for name in ("begin", "fold", "f")):
            found: EpisodeMeasure = measure
            return found
        if callable(measure):
            return Measure(measure, unit="")
    hint = did_you_mean(measure, MEASURES) if isinstance(measure, str) else ""
    raise ValueError(
        f"Unknown measure {measure!r}{hint}; the measures are {', '.join(MEASURES)}, "
        "or a function of a Moment (see docs/measures.md)."
    )
