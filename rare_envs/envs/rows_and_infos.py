"""Parts of environments: scenarios drawn ahead, a step, rows of a batch replaced and picked, and infos."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import torch
from gymnasium.envs.registration import EnvSpec
from numpy.typing import NDArray
from torch import Tensor

from rare_envs.control.actions import read_actions
from rare_envs.distributions.beta import BetaDistribution
from rare_envs.distributions.coordinates import FloatArray
from rare_envs.distributions.fitted import FittedDistribution
from rare_envs.distributions.mixture import TruncatedGaussianMixture
from rare_envs.distributions.space import Distribution, ScenarioSpace
from rare_envs.distributions.stratified import StratifiedDistribution
from rare_envs.multi_agent import view_order
from rare_envs.simulation.decision import EgoReward, StepResult, advance, find_reward, name_terms, reward_terms
from rare_envs.simulation.episode import Episode
from rare_envs.simulation.observation import map_kinds
from rare_envs.traffic.bodies import overlaps, pairs
from rare_envs.traffic.crash import describe_crash
from rare_envs.traffic.state import map_leaves

if TYPE_CHECKING:
    from rare_envs.fast.choice import ScriptedStep
    from rare_envs.simulation.world import World

_T = TypeVar("_T")
ROWS_AHEAD = 256
"""Scenarios that are drawn at once: a few cost as much as these."""
REDRAWS = 100
"""Draws of the other parameters beside given ones before these are refused."""
DRAWS_IN_A_ROW = (TruncatedGaussianMixture, BetaDistribution, StratifiedDistribution)
"""Distributions whose draws of m rows and then of n are those of m + n rows."""


def draw_scenarios(
    world: World,
    space: ScenarioSpace,
    options: Mapping[str, Any] | None,
    n: int,
    rng: np.random.Generator,
    draw: Callable[[NDArray[np.intp]], FloatArray] | None = None,
) -> FloatArray:
    """Return scenarios as by `ScenarioSpace.scenario_x`, in which no vehicles begin in each other.

    Where given values put one into another, the others of that row are drawn again; what cannot be set apart is
    refused. `draw` draws some of the rows in place of the traffic model.
    """
    draw_rows = draw or (lambda rows: space.base.sample(len(rows), rng))
    x = space.scenario_x(options, n, rng, lambda n, rng: draw_rows(np.arange(n)))
    if not options:
        return x
    contacts, given = _find_contacts(world, x), np.isin(np.repeat(space.names, space.sizes), list(options))
    for _ in range(0 if "x" in options else REDRAWS):
        rows = np.flatnonzero(contacts.any(1).numpy())
        if not len(rows):
            break
        x[rows] = space.validate(np.where(given, x[rows], draw_rows(rows)))
        contacts = _find_contacts(world, x)
    if contacts.any():
        first, pair = contacts.nonzero()[0].tolist()
        one, other = (world.scenario.labels[of[pair]] for of in pairs(world.scenario.vehicles))
        row = f" (row {first})" if n > 1 else ""
        raise ValueError(f"Expected vehicles apart at the start, got {other} in {one}{row}; change gaps or places.")
    return x


def _find_contacts(world: World, x: FloatArray) -> Tensor:
    """Return which pairs of vehicles begin in each other, (n, pairs)."""
    own = torch.from_numpy(x).float()[:, : next(iter(world.columns.values()))]
    return overlaps(world.scenario.initial(own), world.scenario.road, "all")


class DrawsAhead:
    """Draws from a distribution, the same as by its `sample`, but many rows at once, which are kept for later calls.

    Of a distribution that is not known to draw row by row, just the wanted rows are drawn.
    """

    def __init__(self, base: Distribution) -> None:
        """Draw from a distribution."""
        self._base = base
        plain = base.distribution if type(base) is FittedDistribution else base
        self._in_a_row = type(plain) in DRAWS_IN_A_ROW
        self._rng: np.random.Generator | None = None
        self._before: Any = None
        """State of the generator before the rows, of which the first `_given` were given, and ..."""
        self._after = b""
        """... after them, as bytes, for some states have arrays in them."""
        self._rows = np.empty((0, 0))
        self._given = 0

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Return the next n rows, shape (n, d); the generator may be ahead of them until `settle`."""
        if not self._in_a_row:
            return self._base.sample(n, rng)
        left = self._rows[self._given :] if rng is self._rng else self._rows[:0]
        if len(left) < n:
            self._rng, self._before, self._given = rng, rng.bit_generator.state, n - len(left)
            self._rows = self._base.sample(max(self._given, ROWS_AHEAD), rng)
            self._after = pickle.dumps(rng.bit_generator.state)
            return np.concatenate([left, self._rows[: self._given]]) if len(left) else self._rows[:n].copy()
        self._given += n
        return left[:n].copy()

    def settle(self) -> None:
        """Put the generator where it is after the rows that were given, and forget the others.

        One that somebody else has drawn from since stays where it is: his draws would come again.
        """
        if self._rng is not None:
            if pickle.dumps(self._rng.bit_generator.state) == self._after:
                self._rng.bit_generator.state = self._before
                self._base.sample(self._given, self._rng)
            self._rng, self._rows = None, self._rows[:0]


class StatesLength:
    """`spec` of an environment that says the length of an episode, `max_episode_steps`, as its world has it."""

    world: World
    _last_tick: int
    """Tick at which an episode is truncated."""
    _spec: EnvSpec | None = None

    @property
    def spec(self) -> EnvSpec | None:
        """How `gym.make` or `gym.make_vec` has made it."""
        return self._spec

    @spec.setter
    def spec(self, value: EnvSpec | None) -> None:
        steps = self._last_tick // self.world.clock.stride
        self._spec = value and replace(value, max_episode_steps=value.max_episode_steps or steps)


def take_step(
    world: World,
    compiled: ScriptedStep | None,
    episode: Episode,
    actions: Any,
    ignored: NDArray[np.bool_] | None = None,
    watch: Callable[[Episode], None] | None = None,
    reward: EgoReward = reward_terms,
) -> StepResult:
    """Carry out decisions (B, ...) as `decision.advance`, compiled or by torch; `ignored` rows do not count."""
    mask = None if ignored is None else torch.from_numpy(ignored)
    read = read_actions(world.clock.action, torch.as_tensor(np.asarray(actions)), len(episode.collided), mask)
    tick = None if compiled is None else compiled.advance
    return advance(world, episode, read.to(episode.collided.device), watch, reward, tick)


@torch.inference_mode()
def open_reward(reward: Any, world: World, space: ScenarioSpace) -> EgoReward:
    """Return the reward that an argument means, tried on two drives so that a broken one is found at once."""
    found = find_reward(reward)
    if found is not reward_terms:
        x = torch.from_numpy(space.sample(2, np.random.default_rng(0))[:, : world.dim]).float()
        found(world.start(x), torch.zeros(2, 2))
    return found


def merge_rows(old: _T, rows: Tensor, new: _T) -> _T:
    """Return nested tuples of tensors of B scenarios with rows (R,) replaced; the rest, as the road, is common."""

    def merge(old: Any, new: Any) -> Any:
        if not isinstance(old, Tensor):
            replace = getattr(old, "replace_rows", None)  # of the record of a measure
            return old if replace is None else replace(rows, new)
        old = old.clone()
        old[rows] = new
        return old

    result: _T = map_leaves(merge, old, new)
    return result


def list_tensors(value: Any) -> list[Tensor]:
    """Return the tensors in nested tuples, in their order; the rest, as the road, stays the same for a whole batch."""
    found = list[Tensor]()

    def collect(leaf: Any) -> None:
        if hasattr(leaf, "replace_rows"):
            raise ValueError(f"Expected tensors, to keep them in a file, got {type(leaf).__name__}.")
        if isinstance(leaf, Tensor):
            found.append(leaf)

    map_leaves(collect, value)
    return found


def to_object_rows(observation: Any, mask: NDArray[np.bool_]) -> NDArray[Any]:
    """Return rows of an observation as objects, None if the mask (B,) is not set: `final_obs` of Gymnasium."""
    rows = np.full(len(mask), None, dtype=object)
    for row in np.flatnonzero(mask):
        rows[row] = map_kinds(lambda part, row=row: part[row].copy(), observation)
    return rows


def mask_infos(values: dict[str, Any], mask: NDArray[np.bool_]) -> dict[str, Any]:
    """Return entries, also those of mappings in them, each with its mask, in Gymnasium's vector form."""
    infos: dict[str, Any] = {}
    for key, value in values.items():
        infos[key] = mask_infos(value, mask) if isinstance(value, dict) else value
        infos[f"_{key}"] = mask.copy()
    return infos


Info = dict[str, Any]
SingleObservation = NDArray[np.float32]
"""Observation of one environment; in a world of several kinds a mapping of such by name."""


def episode_info(space: ScenarioSpace, x: NDArray[Any], episode: Episode) -> Info:
    """Return `scenario`, `x`, `min_ttc` [s], `collision`, `crashed` (the same) and `speed` [m/s] of a batch of one."""
    assert episode.statistics is not None
    collided = bool(episode.collided)
    return {
        "scenario": space.named(x),
        "x": x.copy(),
        "min_ttc": 0.0 if collided else float(episode.statistics.least_ttc),
        "collision": collided,
        "crashed": collided,
        "speed": float(episode.state.speed[0, 0]),
    }


def step_info(
    space: ScenarioSpace, x: NDArray[Any], episode: Episode, reward: Any, over: bool, vehicle: int = 0
) -> Info:
    """Return the info after a step, of an episode as a vehicle sees it."""
    info = episode_info(space, x, episode)
    info["reward_terms"] = {name: float(value) for name, value in name_terms(reward).items()}
    if over:
        assert episode.statistics is not None
        info["measure"] = float(episode.f)
        info["crash"] = crash = describe_crash(episode.statistics.crash)
        info["collision_type"] = None if crash is None else crash["kind"]
        if crash is not None and vehicle:
            order = view_order(vehicle, episode.state.x.shape[1])
            crash["vehicles"] = [each if each < 0 else order[each] for each in crash["vehicles"]]
    return info
