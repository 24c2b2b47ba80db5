"""Drives of an ego in a HighwayEnv scenario: from x to f, here or in a worker process."""

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import highway_env  # noqa: F401  (registers the ids)
import numpy as np
from highway_env.vehicle.behavior import IDMVehicle
from numpy.typing import NDArray

from rare_envs.egos.validation import is_policy, refuse_ego
from rare_envs.egos.wrappers import wrap_policy
from rare_envs.interop.fast_observation import install_fast_observation
from rare_envs.interop.parameters import restore_class_parameters, set_idm
from rare_envs.interop.scenario import HighwayEnvScenario
from rare_envs.plugins import did_you_mean, one_line
from rare_envs.threads import use_one_thread

MAX_SECONDS = 100.0
"""Longest drive [s] unless told otherwise: HighwayEnv's merge ends at a place, where not every ego arrives."""


@dataclass(frozen=True)
class DriveTask:
    """Description of a drive. It can be pickled; the environment is made where it is first needed."""

    env_id: str
    ego: Any
    """"idm", an object with `predict`, or a function without arguments that makes one."""
    config: Mapping[str, Any] | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Keyword arguments of `HighwayEnvScenario`."""
    seconds: float = MAX_SECONDS
    """Duration after which drives are cut off [s]."""

    def build(self) -> "DriveRunner":
        """Make the environment and the ego.

        Raises:
            ValueError: If the environment, the ego or their spaces are not what is expected.
        """
        env = HighwayEnvScenario(make_highway_env(self.env_id, self.config), **self.settings)
        install_fast_observation(env.scene, blind=self.ego == "idm")
        if self.ego == "idm":
            return DriveRunner(env, None, self.seconds)
        ego = self.ego if is_policy(self.ego) else _call_maker(self.ego)
        if not is_policy(ego):
            refuse_ego(ego, f"from {self.ego!r}")
        check_ego_spaces(ego, env)
        return DriveRunner(env, wrap_policy(ego, env.observation_space), self.seconds)


@dataclass(frozen=True)
class BarePolicy:
    """The policy of a Stable-Baselines3 model and its `VecNormalize` statistics, without environment and buffers."""

    policy: Any
    statistics: Any

    @property
    def observation_space(self) -> Any:
        """Observations that the policy was trained on."""
        return self.policy.observation_space

    @property
    def action_space(self) -> Any:
        """Actions that the policy was trained on."""
        return self.policy.action_space

    def get_vec_normalize_env(self) -> Any:
        """Return the statistics, or None."""
        return self.statistics

    def predict(self, *args: Any, **kwargs: Any) -> Any:
        """Return what the policy predicts."""
        return self.policy.predict(*args, **kwargs)


def make_highway_env(env_id: str, config: Mapping[str, Any] | None) -> gym.Env[Any, Any]:
    """Return a new environment of HighwayEnv.

    Raises:
        ValueError: If there is none of this name, or the configuration has a key that it does not know, which
            HighwayEnv itself would ignore.
    """
    known = [name for name, spec in gym.registry.items() if str(spec.entry_point).startswith("highway_env.")]
    if env_id not in known:
        raise ValueError(f"Unknown environment of HighwayEnv {env_id!r}{did_you_mean(str(env_id), known)}.")
    with (
        restore_class_parameters(IDMVehicle),
        warnings.catch_warnings(),
    ):  # an older version is asked for on purpose: results belong to a version
        warnings.filterwarnings("ignore", message=".*is out of date", category=DeprecationWarning)
        env = gym.make(env_id, config=None if config is None else dict(config))
    words = list(env.unwrapped.default_config())  # type: ignore[attr-defined]
    for word in config or ():
        if word not in words:
            raise ValueError(f"{env_id} has no {word!r} to configure{did_you_mean(word, words)}; {', '.join(words)}.")
    return env


def _call_maker(maker: Callable[[], Any]) -> Any:
    """Return what a function of the user's makes, or raise a ValueError if it fails."""
    try:
        return maker()
    except Exception as error:  # the function is the user's
        raise ValueError(
            f"Expected an ego with predict, or a function without arguments that makes one, got {maker!r}, which "
            f"fails: {one_line(error)}."
        ) from error


def strip_ego(ego: Any) -> Any:
    """Return an ego without the objects of its training: of a Stable-Baselines3 model the policy and its statistics.

    Args:
        ego: "idm", an object with `predict`, or a function without arguments that makes one.

    Raises:
        ValueError: If it is none of these.
    """
    if isinstance(ego, str) and ego == "idm":
        return ego
    if not is_policy(ego):
        if isinstance(ego, type) or not callable(ego):
            refuse_ego(ego)
        return ego
    statistics = getattr(ego, "get_vec_normalize_env", None)  # a model has it; anybody's object need not
    return ego if statistics is None else BarePolicy(ego.policy, statistics())


def check_ego_spaces(ego: Any, env: gym.Env[Any, Any]) -> None:
    """Refuse an ego that was made for other observations or actions; one that declares no spaces is accepted.

    Raises:
        ValueError: If its spaces do not fit.
    """
    for what in ("observation", "action"):  # the ego and its spaces are anybody's objects
        given, expected = getattr(env, f"{what}_space"), getattr(ego, f"{what}_space", None)
        fits = type(expected) is type(given) and getattr(expected, "shape", None) == getattr(given, "shape", None)
        if expected is not None and not (fits and getattr(expected, "n", None) == getattr(given, "n", None)):
            raise ValueError(
                f"The ego was made for {what}s {expected}, the environment has {given}; "
                f"give the environment the config that the ego was trained with."
            )


@dataclass(frozen=True)
class DriveRunner:
    """An environment and its ego, ready to drive."""

    env: HighwayEnvScenario
    ego: Any
    seconds: float

    def measure_drive(self, x: NDArray[np.float64]) -> float:
        """Return the measure of the drive from x, shape (d,).

        Raises:
            ValueError: If the ego's action is not finite.
        """
        env = self.env
        observation, _ = env.reset(options={"x": x})
        if self.ego is None:
            replace_ego_by_idm(env)
        period, memory = 1.0 / env.scene.config["policy_frequency"], None
        for step in range(round(self.seconds / period)):
            action: Any = make_idle_action(env.action_space)
            if self.ego is not None:
                action, memory = self.ego.predict(
                    np.asarray(observation)[None], state=memory, episode_start=np.array([step == 0]), deterministic=True
                )
                action = np.asarray(action)[0]
                if not np.isfinite(action).all():
                    raise ValueError(f"The ego's action is not finite: {action}.")
            observation, _, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                break
        return env.measured


def make_idle_action(space: gym.Space[Any]) -> Any:
    """Return an action for an ego that ignores it because it decides itself."""
    return 1 if isinstance(space, gym.spaces.Discrete) else np.zeros(space.shape or (), dtype=np.float32)


def replace_ego_by_idm(env: HighwayEnvScenario) -> None:
    """Put HighwayEnv's own `IDMVehicle`, with HighwayEnv's parameters, in the place of the ego."""
    inner = env.scene
    old = inner.vehicle
    driver = IDMVehicle.create_from(old)
    set_idm([driver], env.usual_idm)
    inner.road.vehicles[inner.road.vehicles.index(old)] = driver
    inner.controlled_vehicles = [driver]
    inner.define_spaces()


_worker_runner: DriveRunner | None = None
"""The environment and ego of a worker process."""


def start_worker(blob: bytes) -> None:
    """Make environment and ego in a worker process, from the bytes of a pickled `DriveTask`."""
    global _worker_runner
    import cloudpickle

    _worker_runner = cloudpickle.loads(blob).build()


def drive_in_worker(x: NDArray[np.float64]) -> float:
    """Return f(x) of one drive in a worker process."""
    assert _worker_runner is not None
    with use_one_thread():
        return _worker_runner.measure_drive(x)
