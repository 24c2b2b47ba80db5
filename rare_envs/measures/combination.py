"""Combinations: the minimum and the weighted sum of measures, and a value of their own for collisions."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from rare_envs.devices import constant
from rare_envs.measures.base import COLLISION, EpisodeMeasure, MeasureState
from rare_envs.measures.moment import Moment
from rare_envs.measures.registry import find_measure


@dataclass(frozen=True)
class Combined:
    """A function of the f of several measures, each of which is updated as it would be alone.

    Example:
        >>> import rare_envs
        >>> from rare_envs.measures import find_measure
        >>> parts = find_measure("ttc"), find_measure("thw")
        >>> mean = Combined(parts, lambda f: f.mean(0), collision=-1.0)
        >>> problem = rare_envs.DrivingProblem("rare_envs/CarFollowing-v0", measure=mean, horizon=0.1)
        >>> problem.evaluate([[20.0, 10.0, 30.0]]).round(2).tolist()  # of 2.98 s and 1.49 s
        [2.24]
    """

    parts: tuple[EpisodeMeasure, ...]
    how: Callable[[Tensor], Tensor]
    """From the f of the parts, shape (K, B), to shape (B,)."""
    collision: float | None = None
    """f of an episode with a collision; None for the function of the parts."""

    @property
    def sees(self) -> bool:
        """Whether a part needs the lidar features of the vehicles."""
        return any(part.sees for part in self.parts)

    @property
    def records(self) -> bool:
        """Whether a part keeps whole episodes."""
        return any(part.records for part in self.parts)

    @property
    def unit(self) -> str:
        """The unit that the parts have in common; empty if they differ."""
        units = {part.unit for part in self.parts}
        return units.pop() if len(units) == 1 else ""

    def start(self, moment: Moment, ticks: int) -> tuple[MeasureState, ...]:
        """Return that nobody has collided, and the state of each part."""
        nobody = torch.zeros(len(moment.state.x), dtype=torch.bool, device=moment.state.x.device)
        return (nobody, *(part.start(moment, ticks) for part in self.parts))

    def update(
        self, state: tuple[MeasureState, ...], moment: Moment, before: Tensor, now: Tensor
    ) -> tuple[MeasureState, ...]:
        """Return who has collided, and the state of each part after one more moment."""
        updated = (part.update(own, moment, before, now) for part, own in zip(self.parts, state[1:], strict=True))
        return (now, *updated)

    def f(self, state: tuple[MeasureState, ...]) -> Tensor:
        """Return the function of the parts' f, shape (B,)."""
        f = self.how(torch.stack([part.f(own) for part, own in zip(self.parts, state[1:], strict=True)]))
        return f if self.collision is None else torch.where(state[0], self.collision, f)


def minimum(*measures: Any) -> Combined:
    """Return the most dangerous of several measures: the least of their f.

    Args:
        *measures: Whatever `find_measure` takes.

    Raises:
        ValueError: If there is none, or one is unknown.

    Example:
        >>> import rare_envs
        >>> problem = rare_envs.DrivingProblem("rare_envs/CarFollowing-v0", measure=minimum("ttc", "thw"), horizon=0.1)
        >>> problem.evaluate([[20.0, 10.0, 30.0]]).round(2).tolist()  # of 2.98 s and 1.49 s
        [1.49]
    """
    return Combined(_find_all(measures), _least)


def weighted(*terms: tuple[Any, float]) -> Combined:
    """Return the weighted sum of measures; after a collision, the sum of their collision values.

    Args:
        *terms: Pairs of a measure, whatever `find_measure` takes, and its weight, positive and finite.

    Raises:
        ValueError: If there is none, or a measure is unknown, or a weight is not positive.

    Example:
        >>> import rare_envs
        >>> both = weighted(("ttc", 1.0), ("thw", 2.0))
        >>> problem = rare_envs.DrivingProblem("rare_envs/CarFollowing-v0", measure=both, horizon=0.1)
        >>> problem.evaluate([[20.0, 10.0, 30.0]]).round(2).tolist()  # 2.98 s + 2 (1.49 s)
        [5.97]
    """
    if not all(isinstance(term, tuple) and len(term) == 2 for term in terms):
        raise ValueError(f"Expected pairs of a measure and its weight, as in weighted(('ttc', 1.0)), got {terms!r}.")
    weights = tuple(float(weight) for _, weight in terms)
    if not all(0.0 < weight < float("inf") for weight in weights):
        raise ValueError(f"Expected positive weights (small f is dangerous, in each of the measures), got {weights}.")
    return Combined(_find_all([measure for measure, _ in terms]), WeightedSum(weights))


def with_collision(measure: Any, value: float = COLLISION) -> Combined:
    """Return a measure in which an episode with a collision has one value: Tian et al.'s equation (3), for any measure.

    Args:
        measure: Whatever `find_measure` takes.
        value: f of an episode with a collision.

    Raises:
        ValueError: If the measure is unknown.

    Example:
        >>> import rare_envs
        >>> gap = with_collision(lambda moment: moment.lead.gap, -5.0)
        >>> problem = rare_envs.DrivingProblem("rare_envs/CarFollowing-v0", measure=gap)
        >>> problem.evaluate([[20.0, 10.0, 5.0], [20.0, 20.0, 40.0]]).round(1).tolist()
        [-5.0, 40.0]
    """
    return Combined(_find_all([measure]), _least, float(value))


@dataclass(frozen=True)
class WeightedSum:
    """A weighted sum over the first axis."""

    weights: tuple[float, ...]

    def __call__(self, f: Tensor) -> Tensor:
        """Return the sum over the first axis: (K, B) to (B,)."""
        return (f * constant(tuple(self.weights), f)[:, None]).sum(0)


def _least(f: Tensor) -> Tensor:
    """Return the least over the first axis: (K, B) to (B,)."""
    return f.amin(0)


def _find_all(measures: Any) -> tuple[EpisodeMeasure, ...]:
    if not measures:
        raise ValueError("Expected one or more measures, got none.")
    return tuple(find_measure(measure) for measure in measures)
