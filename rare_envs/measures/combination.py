"""Measures made of measures."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from rare_envs.measures.base import COLLISION, EpisodeMeasure, MeasureState
from rare_envs.measures.moment import Moment


@dataclass(frozen=True)
class Combined:
    """A function of the f of several measures, of which each folds the moments as it would alone."""

    parts: tuple[EpisodeMeasure, ...]
    how: Callable[[Tensor], Tensor]
    """From the f of the parts, shape (K, B), to shape (B,)."""
    collision: float | None = None
    """f of an episode with a collision; None for what comes of the parts."""

    @property
    def sees(self) -> bool:
        """Whether a part needs what the ego sees."""
        return any(part.sees for part in self.parts)

    @property
    def records(self) -> bool:
        """Whether a part keeps whole episodes."""
        return any(getattr(part, "records", False) for part in self.parts)

    @property
    def unit(self) -> str:
        """The unit that the parts have in common."""
        units = {getattr(part, "unit", "") for part in self.parts}
        return units.pop() if len(units) == 1 else ""

    def start(self, moment: Moment, ticks: int) -> tuple[MeasureState, ...]:
        """What each part keeps, and that nobody has collided."""
        nobody = torch.zeros(len(moment.state.x), dtype=torch.bool, device=moment.state.x.device)
        return (nobody, *(part.start(moment, ticks) for part in self.parts))

    def update(
        self, kept: tuple[MeasureState, ...], moment: Moment, before: Tensor, now: Tensor
    ) -> tuple[MeasureState, ...]:
        """What each part keeps after one more moment, and who has collided."""
        folded = (part.update(own, moment, before, now) for part, own in zip(self.parts, kept[1:], strict=True))
        return (now, *folded)

    def f(self, kept: tuple[MeasureState, ...]) -> Tensor:
        """The function of what the parts say."""
        f = self.how(torch.stack([part.f(own) for part, own in zip(self.parts, kept[1:], strict=True)]))
        return f if self.collision is None else torch.where(kept[0], self.collision, f)


def minimum(*measures: Any) -> Combined:
    """The most dangerous of several measures: the least of their f.

    Args:
        *measures: Whatever `find_measure` takes.

    Raises:
        ValueError: If there is none, or one is unknown.
    """
    return Combined(_found(measures), _least)


def weighted(*terms: tuple[Any, float]) -> Combined:
    """A weighted sum of the f of several measures; a collision counts as the sum of what it is worth to each.

    Args:
        *terms: Pairs of a measure, whatever `find_measure` takes, and its weight, positive and finite.

    Raises:
        ValueError: If there is none, or a measure is unknown, or a weight is not positive.
    """
    if not all(isinstance(term, tuple) and len(term) == 2 for term in terms):
        raise ValueError(f"Expected pairs of a measure and its weight, as in weighted(('ttc', 1.0)), got {terms!r}.")
    weights = tuple(float(weight) for _, weight in terms)
    if not all(0.0 < weight < float("inf") for weight in weights):
        raise ValueError(f"Expected positive weights (small f is dangerous, in each of the measures), got {weights}.")
    return Combined(_found([measure for measure, _ in terms]), Sum(weights))


def with_collision(measure: Any, value: float = COLLISION) -> Combined:
    """A measure, but an episode with a collision comes to one value: Tian et al.'s equation (3), for any measure.

    Args:
        measure: Whatever `find_measure` takes.
        value: f of an episode with a collision.

    Raises:
        ValueError: If the measure is unknown.
    """
    return Combined(_found([measure]), _least, float(value))


@dataclass(frozen=True)
class Sum:
    """A weighted sum over the first axis."""

    weights: tuple[float, ...]

    def __call__(self, f: Tensor) -> Tensor:
        """From shape (K, B) to shape (B,)."""
        return (f * f.new_tensor(self.weights)[:, None]).sum(0)


def _least(f: Tensor) -> Tensor:
    return f.amin(0)


def _found(measures: Any) -> tuple[EpisodeMeasure, ...]:
    from rare_envs.measures.registry import find_measure  # which lists the measures of this package

    if not measures:
        raise ValueError("Expected one or more measures, got none.")
    return tuple(find_measure(measure) for measure in measures)
