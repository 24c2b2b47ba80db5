"""Problem for samplers: the probability that an ego crashes in one of HighwayEnv's own environments."""

import warnings
from collections.abc import Mapping
from functools import cached_property
from typing import Any

import gymnasium as gym
import highway_env  # noqa: F401  (registers the ids)
import numpy as np
from highway_env.vehicle.behavior import IDMVehicle

from rare_envs.distributions.coordinates import FloatArray
from rare_envs.distributions.space import ScenarioSpace
from rare_envs.egos.needs import EgoWarning, name_ambiguities
from rare_envs.egos.wrappers import WrappedPolicy, find_normalisation_doubt, wrap_policy
from rare_envs.interop.layouts import idm_groups, restore_class_parameters, set_idm
from rare_envs.interop.scenario import HighwayEnvScenario, install_fast_observation
from rare_envs.plugins import as_errors, check_name, did_you_mean, is_policy, one_line, refuse_ego
from rare_envs.startup import use_one_thread

MAX_SECONDS = 100.0
"""Longest drive [s] unless told otherwise: HighwayEnv's merge ends at a place, where not every ego arrives."""


def make_highway_env(env_id: str, config: Mapping[str, Any] | None) -> gym.Env[Any, Any]:
    """Return a new environment of HighwayEnv."""
    known = [name for name, spec in gym.registry.items() if str(spec.entry_point).startswith("highway_env.")]
    if env_id not in known:
        raise ValueError(f"Unknown environment of HighwayEnv {env_id!r}{did_you_mean(str(env_id), known)}.")
    with restore_class_parameters(IDMVehicle), warnings.catch_warnings():
        # an older version is asked for on purpose: results belong to a version
        warnings.filterwarnings("ignore", message=".*is out of date", category=DeprecationWarning)
        try:
            env = gym.make(env_id, config=None if config is None else dict(config))
        except Exception as error:  # HighwayEnv reads its configuration without a check
            raise ValueError(f"HighwayEnv makes no {env_id} of the config {config}: {one_line(error)}.") from error
    for word in config or ():
        check_name(f"key of the config of {env_id}", word, env.unwrapped.default_config())  # type: ignore[attr-defined]
    return env


class BarePolicy:
    """The policy of a Stable-Baselines3 model and its `VecNormalize` statistics, without environment and buffers."""

    def __init__(self, model: Any) -> None:
        """Take the policy of a model."""
        self.predict, self.statistics = model.policy.predict, model.get_vec_normalize_env()
        self.observation_space, self.action_space = model.observation_space, model.action_space

    def get_vec_normalize_env(self) -> Any:
        """Return the statistics, or None."""
        return self.statistics


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
                f"The ego was made for {what}s {expected}, the environment has {given}; give the environment the "
                "config that the ego was trained with: highway_env_problem(..., config={...}), or env_config: FILE in "
                "a file for --config."
            )
    return wrap_policy(policy, env.observation_space)


def replace_ego_by_idm(env: HighwayEnvScenario) -> None:
    """Put HighwayEnv's own `IDMVehicle`, with HighwayEnv's parameters, in the place of the ego."""
    inner = env.scene
    old = inner.vehicle
    driver = IDMVehicle.create_from(old)
    set_idm([driver], {group.parameters[0].name: group.usual for group in idm_groups(env.layout, IDMVehicle)})
    inner.road.vehicles[inner.road.vehicles.index(old)] = driver
    inner.controlled_vehicles = [driver]
    inner.define_spaces()


class HighwayEnvProblem:
    """P[f(X) <= gamma] for an ego in a HighwayEnv environment; fits `samplers.Problem`. Also `highway_env_problem`.

    x are scenario parameters; f(x) is -1 if the ego crashes, else the least measure over all simulation steps. It is
    a deterministic function of x: what HighwayEnv draws beyond the named parameters is seeded by the parameter `noise`.

    Attributes:
        env_id: The environment's id.
        ego: What was given; in another process its policy alone.
        config: HighwayEnv's configuration as it was given.
        space: Names, units, bounds and traffic model of x.
        dim: Number of columns of x.
        column_names: Their names, for the tables of results.
        base: Distribution of x.
        fixed: Parameters that are held, and their values.
        given: Condition of p in words, for `samplers.Estimate.given`; empty if nothing is held fixed.
        chunk_size: Drives that a worker of `samplers.estimate(..., workers=2)` makes at once: each takes a good part of
            a second.

    Example:
        >>> import numpy as np, rare_envs
        >>> config = {"vehicles_count": 5, "duration": 3}
        >>> problem = rare_envs.highway_env_problem("highway-fast-v0", config=config, fixed="highway_env")
        >>> problem.space.names
        ('ego_lane', 'speed', 'gap', 'lane', 'noise')
        >>> problem.fixed["ego_speed"]
        25.0
        >>> problem.evaluate(problem.base.sample(3, np.random.default_rng(0))).shape
        (3,)
    """

    chunk_size = 4

    def __init__(
        self,
        env_id: str,
        ego: Any = "idm",
        *,
        config: Mapping[str, Any] | None = None,
        horizon: float = MAX_SECONDS,
        **settings: Any,
    ) -> None:
        """Build the environment once, so that errors show before the simulations.

        Args:
            env_id: "highway-v0", "highway-fast-v0", "merge-v0", "intersection-v0", "roundabout-v0" or a later version
                of these.
            ego: "idm" for HighwayEnv's `IDMVehicle`, an object with Stable-Baselines3's `predict`, or a function
                without arguments that makes one in each worker process. Policies act by their means.
            config: HighwayEnv's configuration, such as the observation that the ego was trained with.
            horizon: Drives are cut off here [s], if the environment does not end them before.
            **settings: Keyword arguments of `HighwayEnvScenario`: `vehicles`, `measure`, `fixed`, `noise`, `base`. With
                `fixed="highway_env"` p is the share of crashes in the environment as it is (up to what
                docs/highway_env.md says of each).

        Raises:
            ValueError: If an argument is invalid, or the ego's spaces are not the environment's.
        """
        if isinstance(horizon, bool) or not isinstance(horizon, int | float) or not 0.0 < horizon <= 1e4:
            raise ValueError(f"Expected a horizon in seconds, positive and at most 10,000, got {horizon!r}.")
        is_idm = isinstance(ego, str) and ego == "idm"
        if not is_idm and not is_policy(ego) and (isinstance(ego, type) or not callable(ego)):
            refuse_ego(ego)
        self.env_id, self.ego, self.config = env_id, ego, config
        self._settings = settings
        is_model = is_policy(ego) and hasattr(ego, "get_vec_normalize_env")  # anybody's object need not have it
        self._policy = None if is_idm else BarePolicy(ego) if is_model else ego
        env, policy = self._driven
        if isinstance(policy, WrappedPolicy) and policy.bounds is not None:
            warnings.warn(name_ambiguities(policy.policy.action_space, ())[-1], EgoWarning, stacklevel=2)
        usual = env.scene.config["observation"] == {"type": "Kinematics"}
        if usual and (doubt := find_normalisation_doubt(ego, env.observation_space)):
            warnings.warn(doubt, EgoWarning, stacklevel=2)
        self._decisions = round(horizon * env.scene.config["policy_frequency"])
        if self._decisions < 1:
            raise ValueError(f"Expected a horizon of one decision of HighwayEnv or more, got {horizon!r} s.")
        if env.scene.config["manual_control"]:
            raise ValueError("Expected manual_control False, got True: HighwayEnv would not carry out the actions.")
        self.space: ScenarioSpace = env.space
        self.dim, self.column_names, self.base = env.space.dim, env.space.column_names, env.space.base
        self.fixed: dict[str, Any] = env.fixed
        held = env.layout.leftover and settings.get("noise") == "fixed"
        self.given = "what HighwayEnv draws beyond x is one fixed draw" if held else ""

    @use_one_thread()
    def evaluate(self, x: FloatArray) -> FloatArray:
        """Return the measure of the drive from each x.

        Args:
            x: Scenario parameters, shape (n, d).

        Returns:
            Measures, shape (n,).

        Raises:
            ValueError: If x has the wrong shape, is NaN or outside its ranges, or an action is not finite.
        """
        return np.array([self._drive(row) for row in self.space.validate(np.atleast_2d(x))])

    def _drive(self, x: FloatArray) -> float:
        """Return the measure of the drive from x (d,)."""
        env, policy = self._driven
        observation, _ = env.reset(options={"x": x})
        space = env.action_space
        action: Any = 1 if isinstance(space, gym.spaces.Discrete) else np.zeros(space.shape or (), dtype=np.float32)
        if policy is None:
            replace_ego_by_idm(env)
        state = None
        for step in range(self._decisions):
            if policy is not None:
                begun, seen = np.array([step == 0]), np.asarray(observation)[None]
                with as_errors():
                    actions, state = policy.predict(seen, state=state, episode_start=begun, deterministic=True)
                action = np.asarray(actions)[0]
                if not np.isfinite(action).all():
                    raise ValueError(f"The ego's action is not finite: {action}.")
            observation, _, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                break
        return env.measured

    @cached_property
    def _driven(self) -> tuple[HighwayEnvScenario, Any]:
        """The environment, made where it is first needed, and the policy; None for HighwayEnv's IDM."""
        env = HighwayEnvScenario(make_highway_env(self.env_id, self.config), **self._settings)
        install_fast_observation(env.scene, blind=self._policy is None)
        return env, None if self._policy is None else make_policy(self._policy, env)

    def __getstate__(self) -> dict[str, Any]:
        """Environments and the objects of a training stay where they are."""
        state = {name: value for name, value in vars(self).items() if name != "_driven"}
        return {**state, "ego": "idm" if self._policy is None else self._policy}


highway_env_problem = HighwayEnvProblem
"""The class, by the name of a function."""
