"""Problem for samplers: the probability that an ego crashes in one of HighwayEnv's own environments."""

import multiprocessing
import os
import warnings
import weakref
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import cached_property
from typing import Any

import gymnasium as gym
import highway_env  # noqa: F401  (registers the ids)
import numpy as np
from highway_env.vehicle.behavior import IDMVehicle
from numpy.typing import NDArray

from rare_envs.distributions.coordinates import FloatArray
from rare_envs.distributions.space import Distribution, ScenarioSpace
from rare_envs.egos.wrappers import wrap_policy
from rare_envs.interop.layouts import IDM_PARAMETERS, restore_class_parameters, set_idm
from rare_envs.interop.scenario import HighwayEnvScenario, install_fast_observation
from rare_envs.plugins import did_you_mean, is_policy, one_line, refuse_ego
from rare_envs.startup import use_one_thread

MAX_SECONDS = 100.0
"""Longest drive [s] unless told otherwise: HighwayEnv's merge ends at a place, where not every ego arrives."""
DRIVES_AT_ONCE = 4
"""Drives that a worker of `samplers.estimate(..., workers=2)` makes at once: each takes a good part of a second."""


def make_highway_env(env_id: str, config: Mapping[str, Any] | None) -> gym.Env[Any, Any]:
    """Return a new environment of HighwayEnv."""
    known = [name for name, spec in gym.registry.items() if str(spec.entry_point).startswith("highway_env.")]
    if env_id not in known:
        raise ValueError(f"Unknown environment of HighwayEnv {env_id!r}{did_you_mean(str(env_id), known)}.")
    with restore_class_parameters(IDMVehicle), warnings.catch_warnings():
        # an older version is asked for on purpose: results belong to a version
        warnings.filterwarnings("ignore", message=".*is out of date", category=DeprecationWarning)
        env = gym.make(env_id, config=None if config is None else dict(config))
    words = list(env.unwrapped.default_config())  # type: ignore[attr-defined]
    for word in config or ():
        if word not in words:
            raise ValueError(f"{env_id} has no {word!r} to configure{did_you_mean(word, words)}; {', '.join(words)}.")
    return env


class BarePolicy:
    """The policy of a Stable-Baselines3 model and its `VecNormalize` statistics, without environment and buffers."""

    def __init__(self, policy: Any, statistics: Any) -> None:
        self.predict, self.statistics = policy.predict, statistics
        self.observation_space, self.action_space = policy.observation_space, policy.action_space

    def get_vec_normalize_env(self) -> Any:
        """Return the statistics, or None."""
        return self.statistics


def strip_ego(ego: Any) -> Any:
    """Return "idm", a policy without the objects of its training, or a function that makes one; refuse all else."""
    if isinstance(ego, str) and ego == "idm":
        return ego
    if not is_policy(ego):
        if isinstance(ego, type) or not callable(ego):
            refuse_ego(ego)
        return ego
    statistics = getattr(ego, "get_vec_normalize_env", None)  # a model has it; anybody's object need not
    return ego if statistics is None else BarePolicy(ego.policy, statistics())


def make_policy(ego: Any, env: gym.Env[Any, Any]) -> Any:
    """Return a policy, or what the user's function makes, with the wrappers of its training, for an environment."""
    policy = ego
    if not is_policy(ego):
        try:
            policy = ego()
        except Exception as error:  # the function is the user's
            raise ValueError(
                f"Expected an ego with predict, or a function without arguments that makes one, got {ego!r}, which "
                f"fails: {one_line(error)}."
            ) from error
        if not is_policy(policy):
            refuse_ego(policy, f"from {ego!r}")
    for what in ("observation", "action"):  # the ego and its spaces are anybody's objects
        given, expected = getattr(env, f"{what}_space"), getattr(policy, f"{what}_space", None)
        fits = type(expected) is type(given) and getattr(expected, "shape", None) == getattr(given, "shape", None)
        if expected is not None and not (fits and getattr(expected, "n", None) == getattr(given, "n", None)):
            raise ValueError(
                f"The ego was made for {what}s {expected}, the environment has {given}; "
                f"give the environment the config that the ego was trained with."
            )
    return wrap_policy(policy, env.observation_space)


def drive(env: HighwayEnvScenario, policy: Any, seconds: float, x: NDArray[np.float64]) -> float:
    """Return the measure of the drive of a policy, None for HighwayEnv's IDM, from x (d,)."""
    observation, _ = env.reset(options={"x": x})
    space = env.action_space
    idle: Any = 1 if isinstance(space, gym.spaces.Discrete) else np.zeros(space.shape or (), dtype=np.float32)
    if policy is None:
        replace_ego_by_idm(env)
    period, memory = 1.0 / env.scene.config["policy_frequency"], None
    for step in range(round(seconds / period)):
        action = idle
        if policy is not None:
            actions, memory = policy.predict(
                np.asarray(observation)[None], state=memory, episode_start=np.array([step == 0]), deterministic=True
            )
            action = np.asarray(actions)[0]
            if not np.isfinite(action).all():
                raise ValueError(f"The ego's action is not finite: {action}.")
        observation, _, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            break
    return env.measured


def replace_ego_by_idm(env: HighwayEnvScenario) -> None:
    """Put HighwayEnv's own `IDMVehicle`, with HighwayEnv's parameters, in the place of the ego."""
    inner = env.scene
    old = inner.vehicle
    driver = IDMVehicle.create_from(old)
    set_idm([driver], dict(zip(IDM_PARAMETERS, env.layout.idm, strict=True)))
    inner.road.vehicles[inner.road.vehicles.index(old)] = driver
    inner.controlled_vehicles = [driver]
    inner.define_spaces()


class HighwayEnvProblem:
    """P[f(X) <= gamma] for an ego in a HighwayEnv environment; fits `samplers.Problem`. See `highway_env_problem`.

    Worker processes start with the first evaluation and end with `close`, at the end of a `with` block, or with the
    program.

    Attributes:
        env_id: The environment's id.
        ego: What was given; in another process its policy alone.
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

    def __init__(
        self,
        env_id: str,
        ego: Any,
        config: Mapping[str, Any] | None,
        settings: Mapping[str, Any],
        seconds: float,
        workers: int,
    ) -> None:
        """Build the environment once, so that errors show before the simulations; `highway_env_problem` has the words.

        `settings` are keyword arguments of `HighwayEnvScenario`; drives are cut off after `seconds`.
        """
        if isinstance(workers, bool) or not isinstance(workers, int) or workers < 1:
            raise ValueError(f"Expected workers of at least 1, got {workers!r}.")
        self.env_id, self.ego, self.workers, self.chunk_size = env_id, ego, workers, DRIVES_AT_ONCE
        self._stripped, self._config, self._settings, self._seconds = strip_ego(ego), config, settings, seconds
        if workers > 1:
            _ = self._packed
        env, _ = self._driven
        self.space: ScenarioSpace = env.space
        self.fixed: dict[str, Any] = env.fixed
        held = env.layout.leftover and settings["noise"] == "fixed"
        self.given = "what HighwayEnv draws beyond x is one fixed draw" if held else ""
        """Condition of p in words, for `samplers.Estimate.given`; empty if nothing is held fixed."""

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
            return np.array([self._drive(row) for row in x])
        chunk = max(1, min(8, len(x) // (4 * self.workers)))
        try:
            return np.array(list(self._pool.map(drive_in_worker, x, chunksize=chunk)))
        except BrokenProcessPool as error:
            self.close()
            raise RuntimeError(
                "A worker process ended before its work: the ego cannot be loaded there (give a function that makes "
                "it, in a module that can be imported), or memory ran out (use fewer workers)."
            ) from error

    @use_one_thread()
    def _drive(self, x: NDArray[np.float64]) -> float:
        return drive(*self._driven, self._seconds, x)

    @cached_property
    def _driven(self) -> tuple[HighwayEnvScenario, Any]:
        """The environment, made where it is first needed, and the policy."""
        env = HighwayEnvScenario(make_highway_env(self.env_id, self._config), **self._settings)
        is_idm = isinstance(self._stripped, str)
        install_fast_observation(env.scene, blind=is_idm)
        return env, None if is_idm else make_policy(self._stripped, env)

    @cached_property
    def _packed(self) -> bytes:
        """The problem as bytes, as it goes to worker processes."""
        import cloudpickle

        try:
            packed: bytes = cloudpickle.dumps(self)
        except Exception as error:  # the ego is the user's: anything may happen in it
            raise ValueError(
                f"The ego cannot be sent to worker processes ({type(error).__name__}: {error}); give a function "
                "without arguments that makes it, or take workers=1."
            ) from error
        return packed

    @cached_property
    def _pool(self) -> ProcessPoolExecutor:
        context = multiprocessing.get_context("spawn")
        pool = ProcessPoolExecutor(self.workers, context, start_worker, (self._packed,))
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
        """Processes, environments and the objects of a training stay where they are."""
        stay = ("_pool", "_end", "_driven", "_packed")
        return {**{name: value for name, value in self.__dict__.items() if name not in stay}, "ego": self._stripped}


_problem: HighwayEnvProblem | None = None
"""The problem in a worker process."""


def start_worker(packed: bytes) -> None:
    """Unpack the problem in a worker process."""
    global _problem
    import cloudpickle

    _problem = cloudpickle.loads(packed)


def drive_in_worker(x: NDArray[np.float64]) -> float:
    """Return f(x) of one drive, x (d,), in a worker process."""
    assert _problem is not None
    return _problem._drive(x)


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
    count = (os.cpu_count() or 1) if workers is None else workers
    return HighwayEnvProblem(env_id, ego, config, settings, float(horizon), count)
