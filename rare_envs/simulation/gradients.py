"""Gradients of the terms of rollouts with respect to x, by autograd, with or without the ego's reactions."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rare_envs.arrays import FloatArray
from rare_envs.measures.base import Moment
from rare_envs.measures.terms import TermMeasure, find_order
from rare_envs.simulation.episode import Episode
from rare_envs.simulation.measurement import Measurement
from rare_envs.simulation.rollout import Driver, StochasticDriver, begin_drive, drive_tick
from rare_envs.simulation.world import World
from rare_envs.traffic.state import map_tensors

GRADIENT_TILE = 256
"""Rollouts that are differentiated at once, at most."""
ROLLOUTS_PER_GRADIENT = 6.5
"""Rollouts that a gradient through a whole episode takes as long as: on the highway with learned drivers (processor
time), a gradient in a batch of 24, 64, 128 or 256 takes 13.0, 6.5, 4.4 or 3.1 times a rollout in a batch of 512. In
batches of the same size it is 2.6 to 3.0 throughout."""
KEPT_SHARE = 0.8
"""Share of the rollouts up to which those that are finished are left out; to copy the others costs a part of a tick."""


@dataclass(frozen=True, eq=False)
class EpisodeGradients:
    """Gradients of one term of each of n rollouts; has what `samplers.TermGradients` has."""

    values: FloatArray
    """With respect to x, shape (n, d); NaN in rows that have none."""
    cost: float
    """Rollouts that they took, all rows together."""
    through_ego: bool
    """Whether they know how the ego reacts. If not, its actions were taken as given: it is a black box."""


def differentiate_terms(
    world: World,
    driver: Driver,
    order: TermMeasure,
    x: FloatArray,
    term: NDArray[np.int64],
    ticks: NDArray[np.int64],
    dtype: torch.dtype = torch.float32,
) -> tuple[FloatArray, float]:
    """Differentiate one term of each rollout with respect to x, by autograd as far as the tick at which it is attained.

    After contact a measure is flat: where a term is attained by a collision, it is differentiated one tick before.

    Args:
        world: The world.
        driver: The ego.
        order: Measure whose terms they are.
        x: Scenarios, shape (n, d).
        term: Number of the term of each, shape (n,).
        ticks: Tick at which it is attained, shape (n,).
        dtype: Precision of the rollouts.

    Returns:
        Gradients (n, d), NaN where they are not finite, and the rollouts that they took, by the moments simulated.

    Raises:
        RuntimeError: Something in the way cannot be differentiated.
    """
    gradients, moments = np.empty(x.shape), 0
    rows_by_tick = np.argsort(ticks, kind="stable")
    for first in range(0, len(x), GRADIENT_TILE):
        rows = rows_by_tick[first : first + GRADIENT_TILE]
        leaf = torch.from_numpy(x[rows]).to(dtype).requires_grad_()
        rollouts = _Unfinished(world, driver, leaf, torch.from_numpy(ticks[rows]))
        values = rollouts.attained_values(order, torch.from_numpy(term[rows]))
        (slope,) = torch.autograd.grad(values.sum(), leaf)
        gradients[rows] = slope.double().numpy()
        moments += rollouts.moments
    gradients[~np.isfinite(gradients).all(axis=1)] = np.nan
    return gradients, ROLLOUTS_PER_GRADIENT * moments / (world.clock.ticks + 1)


class _Unfinished:
    """Rollouts that go on until their ticks, each; those that have got there are left out where that is possible."""

    def __init__(self, world: World, driver: Driver, x: Tensor, ticks: Tensor) -> None:
        measure = world.measurement.episode_measure
        self.world = replace(world, measurement=Measurement(_Unmeasured(measure.sees), world.measurement.collisions))
        self.episode, self.driver = begin_drive(self.world, driver, x)
        self.memory: Any = None
        self.before: Moment | None = None
        self.ticks = ticks
        self.index = torch.arange(len(ticks))
        self.moments = len(ticks)
        """Moments of rollouts so far."""

    def attained_values(self, order: TermMeasure, term: Tensor) -> Tensor:
        """Return the values of terms (B,) when they are attained, in no order, with their graph."""
        values, last = [], int(self.ticks.max())
        for tick in range(last + 1):
            moment = self._moment()
            due, collided = self.ticks == tick, self.episode.collided
            for rows, at in ((due & ~collided, moment), (due & collided, self.before)):
                chosen = rows.nonzero()[:, 0]
                if len(chosen) and at is not None:
                    of_rows = order.term_values(_select(at, chosen))
                    number = term[self.index[chosen]] % of_rows.shape[1]
                    values.append(of_rows.gather(1, number[:, None])[:, 0])
            if tick < last:
                self._go_on(moment, self.ticks > tick)
        # where all have collided before the first moment, nothing depends on x
        return torch.cat(values) if values else self.episode.state.x[:0, 0]

    def _moment(self) -> Moment:
        episode, before = self.episode, self.before
        state = None if before is None else before.state
        return Moment(episode.state, episode.lead, episode.road, episode.perception, state, self.world.clock.dt)

    def _go_on(self, moment: Moment, unfinished: Tensor) -> None:
        """Move on by one tick."""
        if self.memory is None and self.episode.camera_context is None and not _has_noise(self.driver):
            keep = unfinished.nonzero()[:, 0]
            if len(keep) <= KEPT_SHARE * len(unfinished):
                self.episode, moment = _select(self.episode, keep), _select(moment, keep)
                self.ticks, self.index = self.ticks[keep], self.index[keep]
        self.before = moment
        self.episode, self.memory = drive_tick(self.world, self.driver, self.episode, self.memory)
        self.moments += len(self.index)


@dataclass(frozen=True)
class _Unmeasured:
    """A measure that measures nothing."""

    sees: bool
    records: ClassVar[bool] = False
    unit: ClassVar[str] = ""

    def start(self, moment: Moment, ticks: int) -> None:
        return None

    def update(self, state: None, moment: Moment, before: Tensor, now: Tensor) -> None:
        return None

    def f(self, state: None) -> Tensor:
        raise AssertionError("Gradients are those of the terms: nobody reads f of their rollouts.")


def _has_noise(driver: Driver) -> bool:
    return isinstance(driver, StochasticDriver) and driver.noise_columns > 0


def _select(tree: Any, rows: Tensor) -> Any:
    """Return some of the episodes of a tree of tensors."""
    return map_tensors(lambda part: part[rows], tree)


@dataclass(frozen=True)
class TermDifferentiator:
    """The gradients of the terms of a problem."""

    world: World
    driver: Driver
    black_box: bool
    """Whether the ego is a policy with `predict`, through which nothing is differentiated."""

    def __call__(
        self, x: FloatArray, term: NDArray[np.int64], ticks: NDArray[np.int64], gamma: float = 0.0
    ) -> EpisodeGradients:
        """Differentiate one term of each rollout with respect to x.

        Args:
            x: Scenarios, shape (n, d).
            term: Number of the term of each, shape (n,).
            ticks: Tick at which `DrivingProblem.terms` found it attained, shape (n,).
            gamma: Threshold of f, on which it depends what the terms are.
        """
        measurement = self.world.measurement
        order, _ = find_order(measurement.episode_measure, measurement.collisions, gamma)
        if order is None:
            raise ValueError(f"The measure {measurement.measure!r} has no moments whose gradient could be taken.")
        x, term, ticks = np.asarray(x, dtype=np.float64), np.asarray(term), np.asarray(ticks)
        if not self.black_box:
            try:
                return EpisodeGradients(*differentiate_terms(self.world, self.driver, order, x, term, ticks), True)
            except RuntimeError:  # an ego of the user's that leaves torch on the way
                pass
        given = ActionsAsGiven(self.driver)
        return EpisodeGradients(*differentiate_terms(self.world, given, order, x, term, ticks), False)


def find_differentiator(world: World, driver: Driver, black_box: bool, x: FloatArray) -> TermDifferentiator | None:
    """Return the gradients of a problem; None if its measure has none, or its world, measure or drivers leave torch.

    Args:
        world: The world.
        driver: The ego.
        black_box: Whether nothing is differentiated through it.
        x: Any scenario, shape (1, d), of which one tick is tried.
    """
    order, _ = find_order(world.measurement.episode_measure, world.measurement.collisions, 0.0)
    if order is None:
        return None
    coasting = _Coasting(driver.noise_columns if isinstance(driver, StochasticDriver) else 0)
    if not _is_differentiable(world, coasting, order, x):
        return None
    return TermDifferentiator(world, driver, black_box or not _is_differentiable(world, driver, order, x))


def _is_differentiable(world: World, driver: Driver, order: TermMeasure, x: FloatArray) -> bool:
    """Return whether one tick of a rollout can be differentiated."""
    one = np.ones(1, dtype=np.int64)
    try:
        differentiate_terms(world, driver, order, x, 0 * one, one)
    except Exception:  # whatever a user's measure, driver or world raises here: nobody needs gradients
        return False
    return True


@dataclass(frozen=True)
class _Coasting:
    """An ego that does nothing, and ignores its noise."""

    noise_columns: int

    def with_draws(self, draws: Tensor) -> _Coasting:
        return self

    def act(self, episode: Episode, memory: Any) -> tuple[Tensor, Any]:
        return torch.zeros_like(episode.state.x[:, :2]), memory


@dataclass(frozen=True)
class ActionsAsGiven:
    """An ego whose actions have no gradient: a black box, in a rollout that is differentiated.

    Example:
        >>> import torch
        >>> from rare_envs.control.idm import IDM
        >>> from rare_envs.scenarios.car_following import CAR_FOLLOWING
        >>> x = torch.tensor([[20.0, 15.0, 30.0]], requires_grad=True)
        >>> episode = World(CAR_FOLLOWING).start(x)
        >>> [driver.act(episode, None)[0].requires_grad for driver in (IDM(), ActionsAsGiven(IDM()))]
        [True, False]
    """

    driver: Driver
    """The ego."""

    @property
    def noise_columns(self) -> int:
        """Number of columns of x that are its noise."""
        return self.driver.noise_columns if isinstance(self.driver, StochasticDriver) else 0

    def with_draws(self, draws: Tensor) -> Driver:
        """Return the driver of B episodes with standard normal draws."""
        assert isinstance(self.driver, StochasticDriver)
        return ActionsAsGiven(self.driver.with_draws(draws.detach()))

    def act(self, episode: Episode, memory: Any) -> tuple[Tensor, Any]:
        """Return what the ego does in these episodes, as if they were constants."""
        with torch.no_grad():
            action, memory = self.driver.act(map_tensors(Tensor.detach, episode), memory)
        return action.detach(), memory
