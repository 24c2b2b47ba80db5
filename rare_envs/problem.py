"""DrivingProblem: a scenario and an ego as a function f(x), in the shape that samplers expect."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rare_envs.devices import (
    CAMERA_TILE,
    GPU_TILES,
    LIDAR_TILE,
    POLICY_CHUNK,
    POLICY_TILE,
    RULE_CHUNK,
    RULE_TILE,
    find_device,
    move_to,
)
from rare_envs.egos.dense_policies import NotCompiled
from rare_envs.egos.human import HumanDriver
from rare_envs.egos.needs import (
    DRIVES_ITSELF,
    TAKEN_AS_ACCELERATIONS,
    EgoWarning,
    choose_action,
    choose_observation,
    load_named_ego,
    name_ambiguities,
    resolve,
)
from rare_envs.egos.policy import PolicyDriver, as_driver, find_device_driver
from rare_envs.egos.reference import ReferenceDriver
from rare_envs.egos.wrappers import find_normalisation_doubt
from rare_envs.fast.choice import CORES, CompilerFails, is_compiled, leave_to_torch, simulate
from rare_envs.make import refuse_unknown, set_up
from rare_envs.measures.registry import NearCrash
from rare_envs.plugins import as_errors, check_name, reason_of
from rare_envs.scenarios.registry import find_scenario, split_layout
from rare_envs.simulation.cuda_graphs import RecordedRollouts
from rare_envs.simulation.episode import Episode
from rare_envs.simulation.observation import read_kinds
from rare_envs.simulation.settings import Measurement
from rare_envs.simulation.terms import (
    ROLLOUTS_PER_GRADIENT,
    Differentiator,
    EpisodeTerms,
    find_differentiator,
    simulate_terms,
)
from rare_envs.simulation.world import Driver, World, rollout
from rare_envs.traffic.crash import CRASH_KINDS, Crash

COMPILED_DRAWS = 300_000
"""Compiled rollouts of some seconds; without a failure among them p is below 1e-5."""
TORCH_DRAWS = 100_000
"""Rollouts of some seconds by torch, in which a human or reference driver answers 20,000 to 40,000 a second."""


class DrivingProblem:
    """P[f(X) <= gamma] for an ego in a scenario; fits `samplers.Problem`.

    f(x) is the safety measure of one rollout from scenario parameters x: -1 if the ego collides, else the least time
    to collision [s] (capped at 10 s). It is a deterministic function of x.

    Attributes:
        env_id: The environment's id.
        ego: The ego as it was given.
        device: Where torch simulates.
        needs: What the ego needs of the world, and says about itself.
        world: The simulation.
        driver: The ego as a Driver.
        space: Names, units, bounds and traffic model of x.
        dim: Number of columns of x.
        column_names: Their names, for the tables of results.
        base: Distribution of x in ordinary traffic.
        varies: Whether the ego answers differently from run to run, by randomness that is not part of x: an attribute
            `deterministic` of it that is False says so. Then p is over that randomness as well, outcomes count as they
            fell, and failures may not replay.

    Example:
        >>> import rare_envs
        >>> problem = rare_envs.DrivingProblem("rare_envs/CarFollowing-v0", ego="idm")
        >>> x = [[20.0, 15.0, 30.0], [30.0, 5.0, 20.0]]  # speed of the ego and of its lead [m/s], gap [m]
        >>> problem.evaluate(x).round(2)  # time to collision 30 m / (5 m/s), and a collision
        array([ 6., -1.])
    """

    gradient_cost = ROLLOUTS_PER_GRADIENT
    """Rollouts that a row of `gradient` takes as long as, at most."""

    def __init__(
        self,
        env_id: str,
        ego: Any = "idm",
        measure: Any = "ttc",
        base: Any = None,
        noise: bool | str = True,
        chunk_size: int | None = None,
        core: str = "auto",
        device: str = "cpu",
        **make_kwargs: Any,
    ) -> None:
        """Check everything that can be checked before a simulation.

        Args:
            env_id: For example "rare_envs/CutIn-v0"; an id with HighwayEnv's layout, such as
                "rare_envs/CutIn-kinematics-v0", stands for observation="kinematics" and action="meta".
            ego: "idm", a `Driver`, an object with Stable-Baselines3's `predict`, called on whole batches, a function or
                torch module from observations (B, F) to actions (B, 2), or a name or file that `agents.load_ego`
                knows, such as "ppo.zip" (its further arguments: `ego=agents.load_ego("ppo.zip", stats=...)`).
            measure: The safety measure: a name, an object or a function, see
                `rare_envs.measures.find_measure`.
            base: Traffic model of x; None takes the environment's default ("us101").
            noise: How the randomness of learned drivers is treated: True, it is part of x, standard normal columns
                behind the others; "fixed", one sequence for all x, so that p is conditional on it; False, mean
                actions. Scripts and most egos have none (policies act by their means), so there the three agree; the
                noise of an ego behind a stack (`noisy:EGO`) goes with it.
            chunk_size: Rollouts that a worker of `samplers.estimate(..., workers=2)` makes at once; None for 4096 with
                rules and 256 with a policy, or what fits into memory. Few suit a slow ego. A network rounds differently
                by batch, so another number gives other bits; another number of workers does not.
            core: What simulates: "torch", the reference, for everything; "numba", compiled rollouts, for the scripted
                scenarios with the IDM or a policy of dense layers as ego and the measure `ttc`; "auto" for the compiled
                ones where they can be had. They differ by rounding; an estimate says which it used
                (`DrivingProblem.core`).
            device: Where torch simulates: "cpu", or a GPU, "cuda" or "cuda:1". Networks of learned drivers and dense
                layers of Stable-Baselines3 are copied there, a torch module stays on its own device, and other
                policies are queried through the CPU. A `Driver` of your own is shown episodes there; it is moved by
                its method `to`, if it has one. Rounding differs by device.
            **make_kwargs: Further keyword arguments of `gym.make` for this id. Without an `observation` the ego's
                `observation_space` decides: a `Dict` names the kinds, the space of the lidar stands for "lidar", and
                any other for "features".

        Raises:
            FileNotFoundError: If the ego is a file that does not exist.
            ValueError: If an argument is invalid or the ego's spaces are not the environment's.
        """
        env_id, layout = split_layout(env_id)
        named = {name: value for name, value in make_kwargs.items() if value is not None or name not in layout}
        settings = {**layout, **named}
        check_name("core", core, CORES)
        self.env_id, self.ego, self.device = env_id, ego, find_device(device)
        self._chunk_size, self._core = chunk_size, core
        self._recorded: RecordedRollouts | None = None
        ego, scenario = load_named_ego(ego), find_scenario(env_id)
        refuse_unknown(scenario, settings, more=("ego", "core", "chunk_size", "device"))
        with _ego_errors_as_value_errors(ego):
            self.needs = needs = resolve(ego, scenario.vehicles)
        kinds = settings.get("observation") or choose_observation(needs, scenario.vehicles)
        settings["observation"] = kinds
        acted = needs.action_space if needs.queries_policy else None
        settings["action"] = settings.get("action") or choose_action(acted, read_kinds(kinds))
        self.world, self.space = set_up(scenario, needs, measure=measure, base=base, noise=noise, **settings)
        self.dim, self.column_names, self.base = self.space.dim, self.space.column_names, self.space.base
        with _ego_errors_as_value_errors(ego):
            self.driver = as_driver(ego, self.world, needs)
        if self.device.type != "cpu":
            self.world, self.driver = self._move(self.device)
        self.varies = needs.varies
        if core == "numba":
            self._simulate_compiled(np.empty((0, self.dim)))
        said_by_id = bool(layout) and not needs.queries_policy  # nobody named its actions
        doubts = [note for note in self.notes if note != TAKEN_AS_ACCELERATIONS and not said_by_id]
        doubts.append(find_normalisation_doubt(ego, self.world.observation_space))
        for doubt in filter(None, doubts):
            warnings.warn(doubt, EgoWarning, stacklevel=2)

    def __repr__(self) -> str:
        """Return one line."""
        ego = self.ego if isinstance(self.ego, str) else type(self.ego).__name__
        measure = self.world.measurement.measure
        name = measure if isinstance(measure, str) else getattr(measure, "__name__", type(measure).__name__)  # a user's
        return f"<DrivingProblem {self.env_id}, ego {ego}, measure {name}, {self.dim} dimensions>"

    @property
    def core(self) -> str:
        """What simulates `evaluate`: "torch" or "numba", which compiles now what it has not yet."""
        return "torch" if self._simulate_compiled(np.empty((0, self.dim))) is None else "numba"

    @property
    def terms_with_f(self) -> bool:
        """Whether methods may ask for terms wherever they ask for f.

        Not in scripts that have compiled rollouts: these have no terms. Nor do methods ask torch for them there, so
        that both cores are asked the same questions, and give the same answers but for rounding.
        """
        return not is_compiled(self.world, self.driver)

    @property
    def plain_draws(self) -> int:
        """Rollouts that are made of a stratum in which nothing failed, for its upper limit: a matter of seconds."""
        if is_compiled(self.world, self.driver):
            return COMPILED_DRAWS
        return TORCH_DRAWS if isinstance(self.driver, HumanDriver | ReferenceDriver) else 0

    @property
    def notes(self) -> tuple[str, ...]:
        """What cannot be checked or changes nothing; the grave ones also came as an `EgoWarning`."""
        action = self.world.clock.action
        if not self.needs.queries_policy:
            return () if action == "continuous" else (DRIVES_ITSELF.format(action=action),)
        if action != "continuous":
            return self.needs.notes
        return (*self.needs.notes, *name_ambiguities(self.needs.action_space, self.world.sensing.kinds))

    @property
    def given(self) -> str:
        """Condition of p, in words for `samplers.Estimate.given`; empty if nothing is held fixed."""
        fixed = ["the ego's own noise is not part of x, so that failures may not replay"] if self.varies else []
        names = self.world.scenario.vehicle_names
        fixed += [f"{policy.name} drives the {names[policy.vehicle]}" for policy in self.world.policies]
        if self.world.noise != "fixed":
            return ", ".join(fixed)
        if hasattr(self.driver, "with_draws"):
            fixed.append("the ego's noise is one fixed sequence")
        if self.world.background is not None and self.world.background.noisy:
            fixed.append("the drivers' noise is one fixed sequence")
        if self.world.sensing.weather:
            fixed.append("the camera's noise is one fixed pattern of each tick")
        return ", ".join(fixed)

    def evaluate(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Simulate.

        Args:
            x: Scenario parameters, shape (n, d).

        Returns:
            Safety measures, shape (n,).

        Raises:
            ValueError: If x has the wrong shape, is NaN or outside the physical box, or if the policy or the measure
                returns NaN.
        """
        return self._simulate(x, None)

    def attempt(self, x: NDArray[np.float64]) -> tuple[NDArray[np.float64], dict[int, str]]:
        """Simulate, and go on with the other rows when the policy fails on some.

        Args:
            x: Scenario parameters, shape (n, d).

        Returns:
            Safety measures, shape (n,), NaN in rows on which it fails, and the reasons by row. An error of a policy
            with a memory is raised: it may be the fault of any row.
        """
        failed_rows: dict[int, str] = {}
        return self._simulate(x, failed_rows), failed_rows

    def terms(self, x: NDArray[np.float64], gamma: float = 0.0) -> EpisodeTerms:
        """Simulate, and tell apart the terms of which f is the least, one of each vehicle say.

        If f <= gamma means a collision, they are distances to the vehicles, early and late in the episode, for any
        the measure; see `rare_envs.measures.registry.find_order`.

        Args:
            x: Scenario parameters, shape (n, d).
            gamma: Threshold of f.

        Raises:
            ValueError: As `evaluate`.

        Example:
            >>> import rare_envs
            >>> problem = rare_envs.DrivingProblem("rare_envs/CutIn-v0")
            >>> terms = problem.terms([[20.0, 12.0, 12.0, 20.0, 40.0, 3.5]])
            >>> terms.names[terms.least[0]], terms.lowest.round(1).tolist(), terms.f.round(1).tolist()  # [m] and [s]
            ('cutter, 0 to 45 % of the time', [6.6], [1.7])
        """
        return self._simulate_terms(x, gamma, None)

    def attempt_terms(self, x: NDArray[np.float64], gamma: float = 0.0) -> tuple[EpisodeTerms, dict[int, str]]:
        """Simulate as `terms` does, and go on as `attempt` does; f and terms are NaN in rows on which it fails."""
        failed_rows: dict[int, str] = {}
        terms = self._simulate_terms(x, gamma, failed_rows)
        rows = list(failed_rows)
        terms.f[rows], terms.values[rows] = np.nan, np.nan
        return terms, failed_rows

    @cached_property
    def gradient(self) -> Differentiator | None:
        """Gradients of the terms: `gradient(x, term, ticks)`; None if measure or drivers have none."""
        x = self.base.sample(1, np.random.default_rng(0))
        world, driver = self.on_cpu()  # which has gradients of the few rollouts that methods ask for at once sooner
        return find_differentiator(world, driver, self.needs.queries_policy, x)

    def on_cpu(self) -> tuple[World, Driver]:
        """Return the world and the driver as they simulate on the CPU."""
        return (self.world, self.driver) if self.device.type == "cpu" else self._move(torch.device("cpu"))

    def _move(self, device: torch.device) -> tuple[World, Driver]:
        """Return the world and the driver on a device."""
        return replace(self.world, background=move_to(device, self.world.background)), move_to(device, self.driver)

    def crashes(self, x: NDArray[np.float64]) -> Crash:
        """Simulate again and return the kind of crash that each scenario ends in.

        Args:
            x: Scenario parameters, shape (n, d).

        Returns:
            Who ran into whom, how fast and how bad that is; `rare_envs.traffic.crash.CRASH_KINDS` has the words for the
            kinds. Of kind "others" are collisions between other vehicles in episodes in which the ego has none.

        Raises:
            ValueError: If x has the wrong shape, is NaN or outside the physical box, or if the policy returns NaN.
        """
        measurement = Measurement("ttc", self.world.measurement.collisions, statistics=True)
        world, x = replace(self.world, measurement=measurement), self.space.validate(np.atleast_2d(x))
        if not len(x):
            none, pairs = torch.empty(0), torch.empty(0, 2)
            return Crash(none.long(), pairs.long(), none, none, pairs, pairs)
        parts = [end.statistics.crash for end in self._roll_out(world, x, None) if end.statistics is not None]
        return Crash(*(torch.cat(values).cpu() for values in zip(*parts, strict=True)))

    def crash_kinds(self, x: NDArray[np.float64]) -> list[str]:
        """Return words for the kinds of crash that scenarios x (n, d) end in, such as "rear_end"; see `crashes`."""
        return [CRASH_KINDS[kind] for kind in self.crashes(x).kind]

    @property
    def tile(self) -> int:
        """Number of rollouts simulated at once; lidar, or a measure of whole episodes, keeps much."""
        size = POLICY_TILE if isinstance(self.driver, PolicyDriver) else RULE_TILE
        if self.needs.queries_policy and "camera" in self.world.sensing.kinds:
            size = CAMERA_TILE
        elif self.world.uses_lidar or self.world.measurement.episode_measure.records:
            size = LIDAR_TILE
        return size if self.device.type == "cpu" else GPU_TILES * size

    @property
    def chunk_size(self) -> int:
        """Number of rollouts that a worker makes at once, a tile at most."""
        usual = POLICY_CHUNK if isinstance(self.driver, PolicyDriver) else RULE_CHUNK
        return min(self.tile, usual) if self._chunk_size is None else self._chunk_size

    def _simulate(self, x: NDArray[np.float64], failed_rows: dict[int, str] | None) -> NDArray[np.float64]:
        """Return f of scenarios x (n, d); NaN in `failed_rows`, which takes the reasons, unless it is None."""
        x = self.space.validate(np.atleast_2d(x))
        f = self._simulate_compiled(x)
        if f is None:
            f = self._simulate_by_torch(x, failed_rows)
        elif self.needs.queries_policy and np.isnan(f).any():  # torch tells what fails there, and how
            rows, failed = np.flatnonzero(np.isnan(f)), None if failed_rows is None else dict[int, str]()
            f[rows] = self._simulate_by_torch(x[rows], failed)
            if failed_rows is not None and failed is not None:
                failed_rows.update({int(rows[row]): reason for row, reason in failed.items()})
        self._check_known(x, f, failed_rows)
        f[list(failed_rows or ())] = np.nan
        return f

    def _simulate_compiled(self, x: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """Return f of scenarios x (n, d), NaN where it is not known; None if torch has to simulate."""
        if self._core == "torch":
            return None
        try:
            if self.device.type != "cpu":
                raise NotCompiled(f"compiled rollouts are for the CPU, and device={str(self.device)!r} was asked for")
            return simulate(self.world, self.driver, x)
        except NotCompiled as reason:
            leave_to_torch(reason, self._core, stacklevel=4)
            self._core = "torch" if isinstance(reason, CompilerFails) else self._core
            return None

    def _simulate_by_torch(self, x: NDArray[np.float64], failed_rows: dict[int, str] | None) -> NDArray[np.float64]:
        parts = [end.f.numpy(force=True) for end in self._roll_out(self.world, x, failed_rows)]
        return np.concatenate([np.empty(0), *parts])

    def _simulate_terms(self, x: NDArray[np.float64], gamma: float, failed_rows: dict[int, str] | None) -> EpisodeTerms:
        x = self.space.validate(np.atleast_2d(x))
        terms = simulate_terms(self.world, gamma, lambda world: self._roll_out(world, x, failed_rows))
        self._check_known(x, terms.f, failed_rows)
        return terms

    def _roll_out(self, world: World, x: NDArray[np.float64], failed_rows: dict[int, str] | None) -> Iterator[Episode]:
        """Yield the episodes of x (n, d) at the horizon by tiles; `failed_rows` takes reasons, None raises them."""
        for first in range(0, len(x), self.tile):
            rows = torch.from_numpy(x[first : first + self.tile]).float().to(self.device)
            mine = None if failed_rows is None else dict[int, str]()
            end = self.settle(self._drive(world, rows, mine), rows, mine)
            if failed_rows is not None and mine is not None:
                failed_rows.update({first + row: reason for row, reason in mine.items()})
            yield end

    def _drive(self, world: World, rows: Tensor, failed_rows: dict[int, str] | None) -> Episode:
        """Return the episodes of x (B, d), a tile, at the horizon; `failed_rows` as in `_roll_out`."""
        driver = self.driver
        if failed_rows is not None and isinstance(driver, PolicyDriver):
            driver = replace(driver, failed_rows=failed_rows)
        with torch.inference_mode():
            end = None if self.device.type == "cpu" else self._replay(world, rows)
            return rollout(world, driver, rows) if end is None else end

    def settle(self, end: Episode, rows: Tensor, failed_rows: dict[int, str] | None = None) -> Episode:
        """Return episodes at the horizon, of x (B, d), with what their measure takes from second rollouts, if any."""
        measure = end.measure
        if not isinstance(measure, NearCrash):
            return end
        at = measure.find_undecided(end.measure_state)
        if not len(at):
            return end
        mine = None if failed_rows is None else dict[int, str]()
        ttc = Measurement("ttc", self.world.measurement.collisions)
        again = self._drive(replace(self.world, rapid=False, measurement=ttc), rows[at.to(rows.device)], mine)
        if failed_rows is not None and mine is not None:
            failed_rows.update({int(at[row]): reason for row, reason in mine.items()})
        return end._replace(measure_state=measure.settle(end.measure_state, at, again.f.to(at.device)))

    def _replay(self, world: World, rows: Tensor) -> Episode | None:
        """Return the episodes of x (B, d) on a GPU; None if the CPU has to ask a policy, or to tell how it fails."""
        known = self._recorded
        if world.policies:
            return None
        driver = find_device_driver(self.driver, self.device, None if known is None else known.driver)
        if driver is None:
            return None
        if known is None or known.driver is not driver:
            known = self._recorded = RecordedRollouts(driver, self.tile)
        if not isinstance(self.driver, PolicyDriver):
            return known(world, rows)
        try:
            with as_errors():
                end = known(world, rows)
        except Exception:  # the policy is the user's: anything may happen in it
            return None
        # an action that is NaN leaves the ego so for good; f need not notice, since nobody is seen by such an ego
        unknown = torch.stack([end.f.isnan(), *(values[:, 0].isnan() for values in end.state[:4])])
        return None if bool(unknown.any()) else end

    def _check_known(self, x: NDArray[np.float64], f: NDArray[np.float64], failed_rows: dict[int, str] | None) -> None:
        """Raise a ValueError where f is NaN, or add the row to those that failed."""
        for row in np.flatnonzero(np.isnan(f)):
            if failed_rows is None:
                named = {name: value for name, value in self.space.named(x[row]).items() if np.size(value) == 1}
                measure = self.world.measurement.measure
                raise ValueError(f"The measure {measure!r} gave NaN, first at row {row}: {named}.")
            failed_rows.setdefault(int(row), "the measure gave NaN")


@contextmanager
def _ego_errors_as_value_errors(ego: Any) -> Iterator[None]:
    """Turn any error of an ego that is read or wrapped into a ValueError: the ego is the user's."""
    try:
        yield
    except ValueError:
        raise
    except Exception as error:
        raise ValueError(f"An ego of class {type(ego).__name__} cannot be used: {reason_of(error)}") from error
