"""From the moments of an episode to its f: small is dangerous, always finite."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, TypeAlias

import torch
from torch import Tensor

from rare_envs.measures.moment import Moment

COLLISION = -1.0
"""f of an episode with a collision, unless a measure says otherwise (Tian et al. 2024, equation 3)."""

MeasureState: TypeAlias = Any
"""What a measure keeps of an episode so far: a tensor whose first axis is the scenario, a tuple of such, or an object
with a method `put(rows, new)` that returns it with the scenarios `rows` replaced by those of another."""


class EpisodeMeasure(Protocol):
    """Folds the moments of B episodes, as they come, into one number each. Nothing in it changes."""

    @property
    def sees(self) -> bool:
        """Whether it needs what the ego sees, `Moment.perception`."""

    def start(self, moment: Moment, ticks: int) -> MeasureState:
        """What it keeps of the first moment of episodes that are `ticks` long."""

    def update(self, kept: MeasureState, moment: Moment, before: Tensor, now: Tensor) -> MeasureState:
        """What it keeps after one more moment.

        Args:
            kept: Of the moments before.
            moment: The next.
            before: Whether the ego had collided before this moment, boolean, shape (B,): what came after means nothing.
            now: Whether it has by this moment, boolean, shape (B,).
        """

    def f(self, kept: MeasureState) -> Tensor:
        """The measure of the episodes so far, shape (B,)."""


def one_each(value: Any, like: Tensor) -> Tensor:
    """What a measure's function returned, if it is one number for each of B episodes.

    Raises:
        ValueError: If it is not.
    """
    if isinstance(value, Tensor) and value.shape == like.shape:
        return value
    came = f"a tensor of shape {tuple(value.shape)}" if isinstance(value, Tensor) else repr(value)
    raise ValueError(
        f"Expected one number for each of {len(like)} episodes, a tensor of shape ({len(like)},), got {came}."
    )


@dataclass(frozen=True)
class Measure:
    """The most dangerous moment of an episode decides: f is the least over its moments.

    Where large values are dangerous, such as those of a deceleration, f is the critical value less the value, so that
    f <= 0 says that the critical value was reached.
    """

    of: Callable[[Moment], Tensor]
    """A moment to the measure in its own unit and sign, shape (B,)."""
    sees: bool = False
    """Whether it needs what the ego sees."""
    collision: float | Callable[[Moment], Tensor] | None = COLLISION
    """f of an episode with a collision: a number, a function of the moment of the collision, or None for the least of
    the moments before it."""
    critical: float | None = None
    """The critical value of a measure whose large values are dangerous; None where small ones are."""
    unit: str = "s"

    def gamma(self, value: float) -> float:
        """The threshold of f that stands for a value in the measure's own unit and sign."""
        return value if self.critical is None else self.critical - value

    def start(self, moment: Moment, ticks: int) -> Tensor:
        """What it keeps is f, here of the first moment."""
        return self._danger(moment)

    def update(self, kept: Tensor, moment: Moment, before: Tensor, now: Tensor) -> Tensor:
        """The lesser of f so far and f of the moment, and what a collision counts as after one."""
        return self._ended(kept, torch.minimum(kept, self._danger(moment)), moment, before, now)

    def f(self, kept: Tensor) -> Tensor:
        """It keeps f itself."""
        return kept

    def _danger(self, moment: Moment) -> Tensor:
        value = one_each(self.of(moment), moment.lead.gap)
        return value if self.critical is None else self.critical - value

    def _ended(self, kept: Tensor, f: Tensor, moment: Moment, before: Tensor, now: Tensor) -> Tensor:
        """Take f of the moments, or what a collision is worth."""
        worth: Tensor | float
        if self.collision is None:
            worth = kept
        elif callable(self.collision):
            new = now & ~before
            worth = torch.where(new, self.collision(moment), kept) if bool(new.any()) else kept
        else:
            worth = self.collision
        return torch.where(now, worth, f)
