"""Safety measures: from the moments of an episode to its f, which is small where it is dangerous and always finite."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol, TypeAlias, runtime_checkable

import torch
from torch import Tensor

from rare_envs.devices import may_hold, scalars
from rare_envs.measures.moment import Moment

COLLISION = -1.0
"""f of an episode with a collision, unless a measure says otherwise (Tian et al. 2024, equation 3)."""

MeasureState: TypeAlias = Any
"""State of a measure in B episodes: a tensor (B, ...), a tuple of such, or a `RowsReplaceable`."""


@runtime_checkable
class RowsReplaceable(Protocol):
    """A state of B episodes, some of which can be replaced by those of another state."""

    def replace_rows(self, rows: Tensor, new: Any) -> Any:
        """Return the state with the episodes `rows` (indices or mask) replaced by the episodes of `new`."""


@runtime_checkable
class EpisodeMeasure(Protocol):
    """A safety measure as a fold over the moments of B episodes, as they come. Nothing in it changes.

    A class of your own may inherit from it, and then needs the three methods only.

    Example:
        >>> class LastSpeed(EpisodeMeasure):
        ...     def start(self, moment, ticks):
        ...         return moment.state.speed[:, 0]
        ...
        ...     def update(self, state, moment, before, now):
        ...         return torch.where(before, state, moment.state.speed[:, 0])
        ...
        ...     def f(self, state):
        ...         return state
        >>> import rare_envs
        >>> problem = rare_envs.DrivingProblem("rare_envs/CarFollowing-v0", measure=LastSpeed(), horizon=1.0)
        >>> problem.evaluate([[20.0, 20.0, 100.0]]).round(1).tolist()  # [m/s] after 1 s
        [20.4]
    """

    @property
    def sees(self) -> bool:
        """Whether it needs the lidar features of the vehicles, `Moment.perception`."""
        return False

    @property
    def records(self) -> bool:
        """Whether it keeps whole episodes, which are then simulated in smaller batches."""
        return False

    @property
    def unit(self) -> str:
        """Unit of f; empty for a number without one."""
        return ""

    def start(self, moment: Moment, ticks: int) -> MeasureState:
        """Return the state after the first moment of episodes that are `ticks` long."""

    def update(self, state: MeasureState, moment: Moment, before: Tensor, now: Tensor) -> MeasureState:
        """Return the state after one more moment.

        Args:
            state: After the moments before.
            moment: The next moment.
            before: Whether the ego had collided before this moment, boolean, shape (B,): what follows is meaningless.
            now: Whether it has by this moment, boolean, shape (B,).
        """

    def f(self, state: MeasureState) -> Tensor:
        """Return the measure of the episodes so far, shape (B,)."""


def check_one_each(value: Any, like: Tensor) -> Tensor:
    """Return what a measure's function gave, if it is one number for each of B episodes.

    Args:
        value: What the function returned.
        like: A tensor of shape (B,).

    Raises:
        ValueError: If it is not a tensor of shape (B,).
    """
    if isinstance(value, Tensor) and value.shape == like.shape:
        return value
    came = f"a tensor of shape {tuple(value.shape)}" if isinstance(value, Tensor) else repr(value)
    raise ValueError(
        f"Expected one number for each of {len(like)} episodes, a tensor of shape ({len(like)},), got {came}."
    )


def _number_terms(vehicle_names: tuple[str, ...]) -> tuple[str, ...]:
    """Return a name for each other vehicle: its own."""
    return vehicle_names[1:]


@dataclass(frozen=True)
class MeasureTerms:
    """Terms of a measure: K numbers of a moment, the most dangerous of which is the measure; one of each vehicle, say.

    Samplers search among the failures of each term by itself, which are simpler than those of all together.

    Example:
        >>> import rare_envs
        >>> def distances(moment):
        ...     return (moment.state.x[:, 1:] - moment.state.x[:, :1]).abs()
        >>> nearest = Measure(lambda moment: distances(moment).amin(1), terms=MeasureTerms(distances), unit="m")
        >>> problem = rare_envs.DrivingProblem("rare_envs/CutIn-v0", measure=nearest)
        >>> terms = problem.terms([[20.0, 20.0, 20.0, 30.0, 40.0, 3.5]])
        >>> terms.names, terms.values.round(1).tolist(), terms.f.round(1).tolist()  # to the cutter and to the lead
        (('cutter', 'lead'), [[34.0, 79.8]], [34.0])
    """

    of: Callable[[Moment], Tensor]
    """A moment to the terms in the measure's own unit and sign, shape (B, K)."""
    hit: Callable[[Moment], Tensor] | None = None
    """The moment of a collision to the number of the term that the collision belongs to, int64, shape (B,); None for
    the most dangerous one at that moment."""
    names: Callable[[tuple[str, ...]], tuple[str, ...]] = _number_terms
    """Names of the N vehicles, the ego's first, to those of the K terms."""
    cuts: tuple[float, ...] = ()
    """Shares of the horizon at which each term is cut into one before and one after, which count as different terms."""
    unattained: float = 1e3
    """f of a term that has no moment, such as one of the late moments of an episode that ended early."""


@dataclass(frozen=True)
class Measure:
    """A measure that is decided by the most dangerous moment of an episode: f is the least over its moments.

    Where large values are dangerous, such as those of a deceleration, f is the critical value less the value, so that
    f <= 0 says that the critical value was reached.

    Example:
        >>> import rare_envs
        >>> from rare_envs.measures import drac
        >>> comfort = Measure(drac, critical=2.0, collision=-100.0, unit="m/s^2")
        >>> comfort.gamma(3.0)  # f <= -1 where avoiding a crash takes 3 m/s^2
        -1.0
        >>> problem = rare_envs.DrivingProblem("rare_envs/CarFollowing-v0", measure=comfort)
        >>> problem.evaluate([[20.0, 10.0, 25.0]]).round(2).tolist()  # at first 10^2 / (2 25) = 2 m/s^2, then less
        [0.0]
    """

    of: Callable[[Moment], Tensor]
    """A moment to the measure in its own unit and sign, shape (B,)."""
    sees: bool = False
    """Whether it needs the lidar features of the vehicles."""
    collision: float | Callable[[Moment], Tensor] | None = COLLISION
    """f of an episode with a collision: a number, a function of the moment of the collision, or None for the least of
    the moments before it."""
    critical: float | None = None
    """The critical value of a measure whose large values are dangerous; None where small ones are."""
    unit: str = "s"
    """Unit of f."""
    terms: MeasureTerms | None = field(default=None, repr=False)
    """Numbers of a moment of which `of` is the most dangerous; None for none but itself."""
    collisions_only: bool = False
    """Whether f is positive in episodes without a collision and only in those: then {f <= 0} is the collision."""

    @property
    def records(self) -> bool:
        """False: one number of each episode is kept."""
        return False

    def gamma(self, value: float) -> float:
        """Return the threshold of f that corresponds to a value in the measure's own unit and sign."""
        return value if self.critical is None else self.critical - value

    def start(self, moment: Moment, ticks: int) -> Tensor:
        """Return f of the first moment, which is the whole state."""
        return self._f_of_moment(moment)

    def update(self, state: Tensor, moment: Moment, before: Tensor, now: Tensor) -> Tensor:
        """Return the lesser of f so far and f of the moment, or what a collision counts as after one."""
        f = torch.minimum(state, self._f_of_moment(moment))
        return self._with_collisions(state, f, moment, before, now)

    def f(self, state: Tensor) -> Tensor:
        """Return the state, which is f."""
        return state

    def term_values(self, moment: Moment) -> Tensor:
        """Return f of each of the K terms of a moment, shape (B, K); their least is f of the moment."""
        if self.terms is None:
            return self._f_of_moment(moment)[:, None]
        values = self.terms.of(moment)
        return values if self.critical is None else self.critical - values

    def _f_of_moment(self, moment: Moment) -> Tensor:
        value = check_one_each(self.of(moment), moment.lead.gap)
        return value if self.critical is None else self.critical - value

    def _with_collisions(self, state: Tensor, f: Tensor, moment: Moment, before: Tensor, now: Tensor) -> Tensor:
        """Return f of the moments, but in episodes with a collision what that counts as."""
        worth: Tensor
        if self.collision is None:
            worth = state
        elif callable(self.collision):
            new = now & ~before
            worth = torch.where(new, self.collision(moment), state) if may_hold(new) else state
        else:
            (worth,) = scalars((self.collision,), f)
        return torch.where(now, worth, f)
