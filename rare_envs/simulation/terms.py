"""Terms of rollouts, what samplers search by beside f, and their gradients with respect to x, by autograd."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rare_envs.distributions.coordinates import FloatArray
from rare_envs.measures.base import Measure, Moment
from rare_envs.measures.registry import TermTracker, find_order
from rare_envs.simulation.episode import Episode
from rare_envs.simulation.settings import Measurement
from rare_envs.simulation.world import Driver, World, drive_tick, noise_columns, split_noise
from rare_envs.traffic.state import map_tensors

GRADIENT_TILE = 256
"""Rollouts that are differentiated at once, at most."""
ROLLOUTS_PER_GRADIENT = 6.5
"""Rollouts that a gradient through a whole episode takes as long as: on the highway with learned drivers (processor
time), a gradient in a batch of 24, 64, 128 or 256 takes 13.0, 6.5, 4.4 or 3.1 times a rollout in a batch of 512. In
batches of the same size it is 2.6 to 3.0 throughout."""
KEPT_SHARE = 0.8
"""Share of the rollouts up to which those that are finished are left out; to copy the others costs a part of a tick."""
Integers = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class EpisodeTerms:
    """f of n rollouts and the J terms of the measure by which to search; has what `samplers.problem.Terms` has."""

    f: FloatArray
    """The measure, shape (n,)."""
    values: FloatArray
    """Terms, shape (n, J); f <= gamma exactly where the least of them is at or below the threshold."""
    ticks: Integers
    """Tick at which each term is attained, shape (n, J)."""
    threshold: float
    """Terms fail at or below it."""
    names: tuple[str, ...]
    """Of the J terms."""

    @property
    def least(self) -> Integers:
        """Number of the least term, shape (n,)."""
        return np.asarray(self.values.argmin(axis=1), dtype=np.int64)

    @property
    def lowest(self) -> FloatArray:
        """Value of the least term, shape (n,)."""
        return np.asarray(self.values.min(axis=1))


def simulate_terms(world: World, gamma: float, simulate: Callable[[World], Iterable[Episode]]) -> EpisodeTerms:
    """Drive scenarios to the horizon, tile by tile by `simulate`, and tell the terms of their measure apart.

    A measure that is no least over moments has one term, f itself, known at the horizon.
    """
    own, collisions = world.measurement.episode_measure, world.measurement.collisions
    order, threshold = find_order(own, collisions, gamma)
    tracker = None if order is None else TermTracker(own, order)
    if tracker is None:
        f = torch.cat([end.f for end in simulate(world)]).double().numpy(force=True)
        return EpisodeTerms(f, f[:, None], np.full((len(f), 1), world.clock.ticks), threshold, ("f",))
    tracked = replace(world, measurement=Measurement(tracker, collisions))
    parts = [(end.f, end.measure_state.values, end.measure_state.ticks) for end in simulate(tracked)]
    f, values, ticks = (torch.cat(each).numpy(force=True) for each in zip(*parts, strict=True))
    names = tracker.names(world.scenario.vehicle_names)
    return EpisodeTerms(f.astype(np.float64), values.astype(np.float64), ticks, threshold, names)


@dataclass(frozen=True, eq=False)
class EpisodeGradients:
    """Gradients of one term of each of n rollouts; has what `samplers.problem.TermGradients` has."""

    values: FloatArray
    """With respect to x, shape (n, d); NaN in rows that have none."""
    cost: float
    """Rollouts that they took, all rows together."""
    through_ego: bool
    """Whether they know how the ego reacts. If not, its actions were taken as given: it is a black box."""


Differentiator = Callable[..., EpisodeGradients]
"""From x (n, d), the numbers of terms (n,), the ticks (n,) at which `DrivingProblem.terms` found them attained, and
gamma, on which it depends what the terms are, to gradients."""
_COASTING: Any = SimpleNamespace(act=lambda episode, memory: (torch.zeros_like(episode.state.x[:, :2]), memory))
"""An ego that does nothing."""


def find_differentiator(world: World, driver: Driver, black_box: bool, x: FloatArray) -> Differentiator | None:
    """Return the gradients of a problem; None if a tick of x (1, d) shows that measure or world have none."""
    order, _ = find_order(world.measurement.episode_measure, world.measurement.collisions, 0.0)
    if order is None or not _is_differentiable(world, _COASTING, order, x[:, : world.dim]):
        return None
    through = not black_box and _is_differentiable(world, driver, order, x)
    return partial(_differentiate, world, driver, through)


def _is_differentiable(world: World, driver: Driver, order: Measure, x: FloatArray) -> bool:
    """Return whether one tick of a rollout can be differentiated."""
    one = np.ones(1, dtype=np.int64)
    try:
        differentiate_terms(world, driver, order, x, 0 * one, one)
    except Exception:  # whatever a user's measure, driver or world raises here: nobody needs gradients
        return False
    return True


def _differentiate(
    world: World, driver: Driver, through_ego: bool, x: FloatArray, term: Integers, ticks: Integers, gamma: float = 0.0
) -> EpisodeGradients:
    """Differentiate one term of each rollout, with the ego's reactions or its actions as given: a `Differentiator`."""
    measurement = world.measurement
    order, _ = find_order(measurement.episode_measure, measurement.collisions, gamma)
    if order is None:
        raise ValueError(f"The measure {measurement.measure!r} has no moments whose gradient could be taken.")
    of = partial(differentiate_terms, world, driver, order, np.asarray(x, float), np.asarray(term), np.asarray(ticks))
    if through_ego:
        try:
            return of()
        except RuntimeError:  # an ego of the user's that leaves torch on the way
            pass
    return of(through_ego=False)


def differentiate_terms(
    world: World,
    driver: Driver,
    order: Measure,
    x: FloatArray,
    term: Integers,
    ticks: Integers,
    through_ego: bool = True,
    dtype: torch.dtype = torch.float32,
) -> EpisodeGradients:
    """Return gradients (n, d) of one term of each rollout at the tick at which it is attained, and what they cost.

    After contact a measure is flat: where a term is attained by a collision, it is differentiated one tick before. NaN
    where they are not finite. The cost is in rollouts, by the moments simulated. A RuntimeError where something in the
    way cannot be differentiated.
    """
    gradients, moments = np.empty(x.shape), 0
    rows_by_tick = np.argsort(ticks, kind="stable")
    for first in range(0, len(x), GRADIENT_TILE):
        rows = rows_by_tick[first : first + GRADIENT_TILE]
        leaf, of, at = torch.from_numpy(x[rows]).to(dtype).requires_grad_(), term[rows], ticks[rows]
        values, simulated = _attain(world, driver, order, leaf, torch.from_numpy(of), torch.from_numpy(at), through_ego)
        (slope,) = torch.autograd.grad(values.sum(), leaf)
        gradients[rows] = slope.double().numpy()
        moments += simulated
    gradients[~np.isfinite(gradients).all(axis=1)] = np.nan
    return EpisodeGradients(gradients, ROLLOUTS_PER_GRADIENT * moments / (world.clock.ticks + 1), through_ego)


def _attain(
    world: World, driver: Driver, order: Measure, x: Tensor, term: Tensor, ticks: Tensor, through_ego: bool
) -> tuple[Tensor, int]:
    """Return the values of terms (B,) when they are attained, in no order, with their graph; and moments simulated."""
    unread = Measure(lambda moment: moment.lead.gap.detach(), sees=world.measurement.episode_measure.sees)
    world = replace(world, measurement=Measurement(unread, world.measurement.collisions))
    own = noise_columns(driver)
    _, driver = split_noise(driver, x if through_ego else x.detach())
    driver = driver if through_ego else _take_as_given(driver)
    memory: Any = None
    before: Moment | None = None
    episode = world.start(x[:, : x.shape[1] - own])
    values, moments, last = [], 0, int(ticks.max())
    for tick in range(last + 1):
        moments += len(ticks)
        old = None if before is None else before.state
        moment = Moment(episode.state, episode.lead, episode.road, episode.perception, old, world.clock.dt)
        due = ticks == tick
        for rows, at in ((due & ~episode.collided, moment), (due & episode.collided, before)):
            if at is not None and rows.any():
                of_rows = order.term_values(_select(at, rows))
                values.append(of_rows.gather(1, term[rows][:, None] % of_rows.shape[1])[:, 0])
        if tick == last:
            break
        unfinished = ticks > tick
        free = memory is None and episode.camera_context is None and not own  # nothing else knows the number of rows
        if free and int(unfinished.sum()) <= KEPT_SHARE * len(ticks):
            episode, moment, ticks, term = _select((episode, moment, ticks, term), unfinished)
        before = moment
        episode, memory = drive_tick(world, driver, episode, memory)
    # where all have collided before the first moment, nothing depends on x
    return torch.cat(values) if values else episode.state.x[:0, 0], moments


def _take_as_given(driver: Driver) -> Any:
    """Return an ego whose actions have no gradient: a black box, in a rollout that is differentiated."""

    def act(episode: Episode, memory: Any) -> tuple[Tensor, Any]:
        with torch.no_grad():
            action, memory = driver.act(map_tensors(Tensor.detach, episode), memory)
        return action.detach(), memory

    return SimpleNamespace(act=act)


def _select(tree: Any, rows: Tensor) -> Any:
    """Return some of the episodes of a tree of tensors, by a mask (B,)."""
    chosen = rows.nonzero()[:, 0]
    return map_tensors(lambda part: part[chosen], tree)
