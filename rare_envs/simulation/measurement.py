"""Measurement of episodes: the safety measure, which collisions count, and statistics of who crashed with whom."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import torch
from torch import Tensor

from rare_envs.measures import EpisodeMeasure, Moment, ttc
from rare_envs.measures.registry import find_measure
from rare_envs.traffic.bodies import others_overlap
from rare_envs.traffic.crash import NONE, Crash, crash_of, crash_of_others
from rare_envs.traffic.state import State

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


class EpisodeStatistics(NamedTuple):
    """Statistics of B episodes up to one moment."""

    least_ttc: Tensor
    """Least time to collision [s], shape (B,), without meaning after a collision."""
    own: Crash
    """Crash of the ego."""
    others: Crash
    """First crash between two other vehicles while the episode ran."""

    @property
    def crash(self) -> Crash:
        """Crash of the ego; where it had none, that of others."""
        return self.own.replace_where(self.own.kind == NONE, self.others)

    @classmethod
    def start(cls, moment: Moment, least_ttc: Tensor | None = None) -> EpisodeStatistics:
        """Return the statistics at time 0; arguments as of `update`."""
        nothing = Crash.nothing(moment.state.x[:, 0])
        return cls(ttc(moment) if least_ttc is None else least_ttc, nothing, nothing)

    def update(self, moment: Moment, before: Tensor, now: Tensor, least_ttc: Tensor | None = None) -> EpisodeStatistics:
        """Return the statistics one moment later.

        Args:
            moment: The next moment.
            before: Whether the episode had ended in a collision before this moment, boolean, shape (B,).
            now: Whether it has by this moment, boolean, shape (B,).
            least_ttc: The least time to collision where it is known already [s], shape (B,).
        """
        least = torch.minimum(self.least_ttc, ttc(moment)) if least_ttc is None else least_ttc
        own, others = self.own, self.others
        new = now & ~before
        if bool(new.any()):
            own = _record_crashes(own, new, crash_of, moment)
        touch = others_overlap(moment.state, moment.road) & (others.kind == NONE) & ~before
        if bool(touch.any()):
            others = _record_crashes(others, touch, crash_of_others, moment)
        return EpisodeStatistics(least, own, others)


def _record_crashes(crash: Crash, where: Tensor, find: Callable[..., Crash], moment: Moment) -> Crash:
    """Return crashes with those found in the episodes `where`, boolean, shape (B,), put in."""
    rows = where.nonzero()[:, 0]
    state = State(*(field[rows] for field in moment.state))
    before = None if moment.before is None else State(*(field[rows] for field in moment.before))
    latest = find(state, moment.road, before, moment.dt)
    return Crash(*(old.index_put((rows,), new) for old, new in zip(crash, latest, strict=True)))
