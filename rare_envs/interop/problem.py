"""Problem for samplers: the probability that an ego crashes in one of HighwayEnv's own environments."""

import multiprocessing
import os
import weakref
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import cached_property
from typing import Any

import numpy as np

from rare_envs.arrays import FloatArray
from rare_envs.distributions.space import Distribution, ScenarioSpace
from rare_envs.interop.simulation import (
    MAX_SECONDS,
    DriveRunner,
    DriveTask,
    drive_in_worker,
    start_worker,
    strip_ego,
)
from rare_envs.threads import use_one_thread

DRIVES_AT_ONCE = 4
"""Drives that a worker of `samplers.estimate(..., workers=2)` makes at once: each takes a good part of a second."""


class HighwayEnvProblem:
    """P[f(X) <= gamma] for an ego in a HighwayEnv environment; fits `samplers.Problem`. See `highway_env_problem`.

    Worker processes start with the first evaluation and end with `close`, at the end of a `with` block, or with the
    program.

    Attributes:
        env_id: The environment's id.
        ego: What was given.
        workers: Number of processes.
        space: Names, units, bounds and base distribution of x.
        fixed: Parameters that are held, and their values.
        chunk_size: Drives that a worker of an executor makes at once.

    Example:
        >>> problem = highway_env_problem("highway-fast-v0", config={"vehicles_count": 5}, fixed="highway_env")
        >>> problem.space.names
        ('ego_lane', 'speed', 'gap', 'lane', 'noise')
        >>> problem.fixed["ego_speed"]
        25.0
    """

    def __init__(self, task: DriveTask, ego: Any, workers: int) -> None:
        """Build the environment once, so that errors show before the simulations.

        Args:
            task: Description of a drive.
            ego: As the user gave it.
            workers: Number of processes.

        Raises:
            ValueError: If the task cannot be made.
        """
        if isinstance(workers, bool) or not isinstance(workers, int) or workers < 1:
            raise ValueError(f"Expected workers of at least 1, got {workers!r}.")
        self.env_id, self.ego, self.workers, self.chunk_size = task.env_id, ego, workers, DRIVES_AT_ONCE
        self._task = task
        if workers > 1:
            _pickle_task(task)
        self._driven: DriveRunner | None = task.build()
        self.space: ScenarioSpace = self._driven.env.space
        self.fixed: dict[str, Any] = self._driven.env.fixed
        self._noise = task.settings["noise"]
        self._random = self._driven.env.layout.leftover

    @property
    def dim(self) -> int:
        """Number of columns of x."""
        return self.space.dim

    @property
    def column_names(self) -> tuple[str, ...]:
        """Names of the columns of x, for the tables of results."""
        return self.space.column_names

    @property
    def base(self) -> Distribution:
        """Distribution of x."""
        return self.space.base

    @property
    def given(self) -> str:
        """Condition of p in words, for `samplers.Estimate.given`; empty if nothing is held fixed."""
        fixed = self._random and self._noise == "fixed"
        return "what HighwayEnv draws beyond x is one fixed draw" if fixed else ""

    def evaluate(self, x: FloatArray) -> FloatArray:
        """Return the measure of the drive from each x.

        Args:
            x: Scenario parameters, shape (n, d).

        Returns:
            Measures, shape (n,); the same whatever the number of workers.

        Raises:
            ValueError: If x has the wrong shape, is NaN or outside its ranges, or an action is not finite.
            RuntimeError: If a worker process died.
        """
        x = self.space.validate(np.atleast_2d(x))
        if self.workers == 1 or len(x) == 1:
            self._driven = self._driven or self._task.build()
            with use_one_thread():
                return np.array([self._driven.measure_drive(row) for row in x])
        chunk = max(1, min(8, len(x) // (4 * self.workers)))
        try:
            return np.array(list(self._pool.map(drive_in_worker, x, chunksize=chunk)))
        except BrokenProcessPool as error:
            self.close()
            raise RuntimeError(
                "A worker process ended before its work: the ego cannot be loaded there (give a function that makes "
                "it, in a module that can be imported), or memory ran out (use fewer workers)."
            ) from error

    @cached_property
    def _pool(self) -> ProcessPoolExecutor:
        pool = ProcessPoolExecutor(
            self.workers,
            mp_context=multiprocessing.get_context("spawn"),
            initializer=start_worker,
            initargs=(_pickle_task(self._task),),
        )
        self._end = weakref.finalize(self, pool.shutdown, wait=False, cancel_futures=True)
        return pool

    def close(self) -> None:
        """End the worker processes; another evaluation starts new ones."""
        if "_pool" in self.__dict__:
            self._end.detach()
            self.__dict__.pop("_pool").shutdown(cancel_futures=True)

    def __enter__(self) -> "HighwayEnvProblem":
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def __getstate__(self) -> dict[str, Any]:
        """Processes and environments stay where they are."""
        return {**{k: v for k, v in self.__dict__.items() if k not in ("_pool", "_end")}, "_driven": None}


def _pickle_task(task: DriveTask) -> bytes:
    """Return a task as bytes, as it goes to worker processes.

    Raises:
        ValueError: If something in it cannot be pickled.
    """
    import cloudpickle

    try:
        packed: bytes = cloudpickle.dumps(task)
    except Exception as error:  # the ego is the user's: anything may happen in it
        raise ValueError(
            f"The ego cannot be sent to worker processes ({type(error).__name__}: {error}); give a function without "
            "arguments that makes it, or take workers=1."
        ) from error
    return packed


def highway_env_problem(
    env_id: str,
    ego: Any = "idm",
    *,
    config: Mapping[str, Any] | None = None,
    vehicles: int | None = None,
    measure: str | Callable[[Any], float] = "ttc",
    fixed: Mapping[str, Any] | str | None = None,
    noise: bool | str = True,
    base: Any = None,
    horizon: float = MAX_SECONDS,
    workers: int | None = 1,
) -> HighwayEnvProblem:
    """Return a HighwayEnv environment with an ego as a problem for `samplers.estimate`.

    x are scenario parameters; f(x) is -1 if the ego crashes, else the least measure over all simulation steps. It is
    a deterministic function of x: what HighwayEnv draws beyond the named parameters is seeded by the parameter `noise`.

    Args:
        env_id: "highway-v0", "highway-fast-v0", "merge-v0", "intersection-v0", "roundabout-v0" or a later version of
            these.
        ego: "idm" for HighwayEnv's `IDMVehicle`, an object with Stable-Baselines3's `predict`, or a function without
            arguments that makes one in each worker process. Policies act by their means.
        config: HighwayEnv's configuration, such as the observation that the ego was trained with.
        vehicles: Number of vehicles with parameters, on the highway; 4 by default.
        measure: "ttc" (least time until the ego's body touches any other), "front_ttc" (to the vehicle in front), or a
            function of HighwayEnv's environment.
        fixed: Values of parameters that are held, or "highway_env" for those that HighwayEnv itself holds: p is then
            the share of crashes in the environment as it is (up to what docs/highway_env.md says of each).
        noise: True, what is left random is seeded by the parameter `noise`; "fixed", by one number for all x.
        base: Distribution of the parameters without noise; HighwayEnv's own by default.
        horizon: Drives are cut off here [s], if the environment does not end them before.
        workers: Processes, each with one thread; None for one per core. They are started afresh, so a script that uses
            them needs `if __name__ == "__main__":`.

    Returns:
        The problem.

    Raises:
        ValueError: If an argument is invalid, or the ego's spaces are not the environment's.

    Example:
        >>> problem = highway_env_problem("highway-fast-v0", config={"vehicles_count": 5, "duration": 3})
        >>> problem.evaluate(problem.base.sample(3, np.random.default_rng(0))).shape
        (3,)
    """
    if isinstance(horizon, bool) or not isinstance(horizon, int | float) or not 0.0 < horizon <= 1e4:
        raise ValueError(f"Expected a horizon in seconds, positive and at most 10,000, got {horizon!r}.")
    settings = {"vehicles": vehicles, "measure": measure, "fixed": fixed, "noise": noise, "base": base}
    task = DriveTask(env_id, strip_ego(ego), config, settings, float(horizon))
    return HighwayEnvProblem(task, ego, (os.cpu_count() or 1) if workers is None else workers)
