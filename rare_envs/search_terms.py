"""Terms of rollouts and their gradients: what samplers search by, beside f, in scenarios that many cars make."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rare_envs.arrays import FloatArray
from rare_envs.measures.moment import Moment
from rare_envs.measures.terms import TermMeasure, TermTracker, find_order
from rare_envs.simulation.episode import Episode
from rare_envs.simulation.measurement import Measurement
from rare_envs.simulation.rollout import Driver, StochasticDriver, drive, rollout
from rare_envs.simulation.world import World
from rare_envs.traffic.lead import Lead
from rare_envs.traffic.state import State

GRADIENT_TILE = 64
"""Rollouts that are differentiated at once."""
ROLLOUTS_PER_GRADIENT = 6.5
"""Rollouts that a gradient through a whole episode takes as long as, on the highway with learned drivers."""


@dataclass(frozen=True, eq=False)
class EpisodeTerms:
    """f of n rollouts and the J terms of the measure by which to search; has what `samplers.Terms` has."""

    f: FloatArray
    """The measure, shape (n,)."""
    values: FloatArray
    """Terms, shape (n, J); f <= gamma exactly where the least of them is at or below the threshold."""
    ticks: NDArray[np.int64]
    """Tick at which each term is attained, shape (n, J)."""
    threshold: float
    """Terms fail at or below it."""
    names: tuple[str, ...]
    """Of the J terms."""

    @property
    def least(self) -> NDArray[np.int64]:
        """Number of the least term, shape (n,)."""
        return np.asarray(self.values.argmin(axis=1), dtype=np.int64)

    @property
    def lowest(self) -> FloatArray:
        """Value of the least term, shape (n,)."""
        return np.asarray(self.values.min(axis=1))


@dataclass(frozen=True, eq=False)
class EpisodeGradients:
    """Gradients of one term of each of n rollouts; has what `samplers.TermGradients` has."""

    values: FloatArray
    """With respect to x, shape (n, d); NaN in rows that have none."""
    cost: float
    """Rollouts that they took, all rows together."""
    through_ego: bool
    """Whether they know how the ego reacts. If not, its actions were taken as given: it is a black box."""


def simulate_terms(world: World, driver: Driver, x: FloatArray, gamma: float, tile: int) -> EpisodeTerms:
    """Drive scenarios from start to horizon.

    Args:
        world: The world, with its measure.
        driver: The ego.
        x: Scenarios within the physical box, shape (n, d).
        gamma: Threshold of f.
        tile: Rollouts at once.

    Returns:
        f and its terms. A measure that is no least over moments has one term, f itself, known at the horizon.
    """
    own, collisions = world.measurement.episode_measure, world.measurement.collisions
    order, threshold = find_order(own, collisions, gamma)
    tracker = None if order is None else TermTracker(own, order)
    if tracker is not None:
        world = replace(world, measurement=Measurement(tracker, collisions))
    f, values, ticks = [], [], []
    with torch.inference_mode():
        for first in range(0, len(x), tile):
            end = rollout(world, driver, torch.from_numpy(x[first : first + tile]).float())
            f.append(end.f)
            values.append(end.f[:, None] if tracker is None else end.measure_state.values)
            ticks.append(torch.full((len(end.f), 1), world.clock.ticks) if tracker is None else end.measure_state.ticks)
    names = ("f",) if tracker is None else tracker.names(world.scenario.vehicle_names)
    return EpisodeTerms(_join(f), _join(values), torch.cat(ticks).numpy(), threshold, names)


def _join(parts: list[Tensor]) -> FloatArray:
    return torch.cat(parts).double().numpy()


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
        Gradients (n, d), NaN where they are not finite, and the rollouts that they took: each tile goes on until the
        last of its ticks, so rows are taken in the order of these.

    Raises:
        RuntimeError: Something in the way cannot be differentiated.
    """
    gradients, cost = np.empty(x.shape), 0.0
    rows_by_tick = np.argsort(ticks, kind="stable")
    for first in range(0, len(x), GRADIENT_TILE):
        rows = rows_by_tick[first : first + GRADIENT_TILE]
        leaf = torch.from_numpy(x[rows]).to(dtype).requires_grad_()
        values = _attained_values(
            world, driver, order, leaf, torch.from_numpy(term[rows]), torch.from_numpy(ticks[rows])
        )
        (slope,) = torch.autograd.grad(values.sum(), leaf)
        gradients[rows] = slope.double().numpy()
        share = (int(ticks[rows].max()) + 1) / (world.clock.ticks + 1)
        cost += ROLLOUTS_PER_GRADIENT * share * len(rows)
    gradients[~np.isfinite(gradients).all(axis=1)] = np.nan
    return gradients, cost


def _attained_values(
    world: World, driver: Driver, order: TermMeasure, x: Tensor, term: Tensor, ticks: Tensor
) -> Tensor:
    """Return the values of terms (B,) at their ticks (B,), in no order, with their graph."""
    values, before, last = [], None, int(ticks.max())
    with torch.enable_grad():
        for tick, (moment, collided) in enumerate(_moments(world, driver, x)):
            due = ticks == tick
            for rows, at in ((due & ~collided, moment), (due & collided, before)):
                index = rows.nonzero()[:, 0]
                if len(index) and at is not None:
                    of_rows = order.term_values(_take(at, index))
                    values.append(of_rows.gather(1, (term[index] % of_rows.shape[1])[:, None])[:, 0])
            before = moment
            if tick == last:
                break
    return torch.cat(values)


def _moments(world: World, driver: Driver, x: Tensor) -> Iterator[tuple[Moment, Tensor]]:
    """Yield the moments of B episodes, and which have collided by then."""
    before = None
    for episode in drive(world, driver, x):
        state, road = episode.state, episode.road
        yield Moment(state, episode.lead, road, episode.perception, before, world.clock.dt), episode.collided
        before = state


def _take(moment: Moment, rows: Tensor) -> Moment:
    """Return some of the scenarios of a moment."""
    seen, before = moment.perception, moment.before
    return moment._replace(
        state=State(*(field[rows] for field in moment.state)),
        lead=Lead(*(field[rows] for field in moment.lead)),
        perception=None if seen is None else seen[rows],
        before=None if before is None else State(*(field[rows] for field in before)),
    )


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
    one = np.ones(1, dtype=np.int64)
    try:
        differentiate_terms(world, coasting, order, x, 0 * one, one)
    except RuntimeError:
        return None
    return TermDifferentiator(world, driver, black_box)


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
            action, memory = self.driver.act(_detach(episode), memory)
        return action.detach(), memory


def _detach(tree: Any) -> Any:
    """Return a tensor, or a tuple of tensors, without its graph."""
    if isinstance(tree, Tensor):
        return tree.detach()
    if isinstance(tree, tuple) and hasattr(tree, "_fields"):  # a named tuple, of which `Episode` is made
        return type(tree)(*map(_detach, tree))
    return tree
