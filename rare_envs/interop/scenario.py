"""Scenarios of HighwayEnv: an environment whose start is set by parameters, and the measures of its scenes."""

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs, seeding
from gymnasium.wrappers import OrderEnforcing, PassiveEnvChecker, TimeLimit
from highway_env.envs.common.abstract import AbstractEnv
from highway_env.envs.common.observation import KinematicObservation
from highway_env.utils import class_from_path, lmap
from numpy.typing import NDArray

from rare_envs.distributions.coordinates import FloatArray
from rare_envs.distributions.fitted import join_independent
from rare_envs.distributions.product import NoiseDistribution
from rare_envs.distributions.space import Parameter, ScenarioSpace
from rare_envs.interop.layouts import (
    LAYOUTS,
    SCENE_METHODS,
    STARTING_METHODS,
    Group,
    Layout,
    idm_groups,
    others_of,
    restore_class_parameters,
    set_idm,
)
from rare_envs.measures.base import COLLISION
from rare_envs.measures.longitudinal import TTC_MAX
from rare_envs.plugins import check_name
from rare_envs.scenarios.registry import HIGHWAY_ENV_IDS

TTC_MIN = 0.01
"""They are at least this [s], so that only a collision comes to 0 or less."""
_STILL = 1e-9
"""Speeds below this [m/s] do not close a gap."""


def ttc_to_any(env: Any) -> float:
    """Return the time until the ego's body would touch any other's at constant speed and heading [s], in [0.01, 10]."""
    ego, road = env.vehicle, env.road
    others = [other for other in (*road.vehicles, *road.objects) if other is not ego and other.solid]
    # only of bodies that can touch within `TTC_MAX`: circles around them, speeds added
    near = [
        other
        for other in others
        if math.dist(ego.position, other.position) - (ego.diagonal + other.diagonal) / 2
        <= TTC_MAX * math.dist(ego.velocity, other.velocity)
    ]
    return float(np.clip(min((contact_time(ego, other) for other in near), default=np.inf), TTC_MIN, TTC_MAX))


def ttc_to_front(env: Any) -> float:
    """Return gap over closing speed along the lane, to the vehicle that HighwayEnv finds in front of the ego [s]."""
    ego = env.vehicle
    front, _ = env.road.neighbour_vehicles(ego, ego.lane_index)
    if front is None:
        return TTC_MAX
    gap = ego.lane_distance_to(front) - (ego.LENGTH + front.LENGTH) / 2
    closing = float(np.dot(ego.velocity - front.velocity, ego.direction))
    return float(np.clip(gap / closing, TTC_MIN, TTC_MAX)) if closing > _STILL else TTC_MAX


def contact_time(one: Any, other: Any) -> float:
    """Return the time at which two bodies that keep their velocities and headings begin to overlap; inf if never [s].

    Two rectangles overlap while their shadows on each of their four axes do (separating axes). Each pair of shadows
    overlaps during one interval of time, so the bodies do during what the four intervals have in common.
    """
    away, drift = other.position - one.position, other.velocity - one.velocity
    angles = np.array([each.heading + turn for each in (one, other) for turn in (0.0, np.pi / 2)])
    sides = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    halves = np.array([half for each in (one, other) for half in (each.LENGTH / 2, each.WIDTH / 2)])
    reach = np.abs(sides @ sides.T) @ halves
    distance, speed = sides @ away, sides @ drift
    still = np.abs(speed) < _STILL
    if np.any(np.abs(distance[still]) >= reach[still]):
        return np.inf
    if still.all():
        return 0.0
    ends = np.stack([-reach - distance, reach - distance])[:, ~still] / speed[~still]
    enter, leave = float(ends.min(axis=0).max()), float(ends.max(axis=0).min())
    return max(enter, 0.0) if enter < leave and leave > 0.0 else np.inf


HIGHWAY_ENV_MEASURES: dict[str, Callable[[Any], float]] = {"ttc": ttc_to_any, "front_ttc": ttc_to_front}
"""Measures of a moment by name; that of a drive is the least of them, or -1 if the ego crashes."""


def install_fast_observation(env: Any, blind: bool = False) -> None:
    """Replace the `Kinematics` observation of a HighwayEnv environment from its next reset on, by zeros if `blind`."""
    define_spaces = env.define_spaces

    def define_spaces_fast() -> None:
        define_spaces()
        kind = env.observation_type
        if blind and isinstance(kind, KinematicObservation):
            kind.observe = partial(np.zeros, kind.space().shape, kind.space().dtype)
        elif type(kind) is KinematicObservation:
            kind.observe = partial(observe_without_pandas, kind)

    env.define_spaces = define_spaces_fast


def observe_without_pandas(kind: Any) -> NDArray[np.float32]:
    """Return what `KinematicObservation.observe` of this kind returns."""
    space, env, observer = kind.space(), kind.env, kind.observer_vehicle
    if not env.road:
        return np.zeros(space.shape, space.dtype)
    near = env.road.close_objects_to(
        observer,
        env.PERCEPTION_DISTANCE,
        count=kind.vehicles_count - 1,
        see_behind=kind.see_behind,
        sort=kind.order == "sorted",
        vehicles_only=not kind.include_obstacles,
    )
    origin = None if kind.absolute else observer
    shown = near[-kind.vehicles_count + 1 :]
    records = [observer.to_dict(), *(v.to_dict(origin, observe_intentions=kind.observe_intentions) for v in shown)]
    values = np.array([[record.get(name, np.nan) for name in kind.features] for record in records], dtype=np.float64)
    if kind.normalize:
        if not kind.features_range:
            kind.normalize_obs({})  # finds the ranges
        for column, name in enumerate(kind.features):
            if name in kind.features_range:
                scaled = lmap(values[:, column], kind.features_range[name], [-1, 1])
                values[:, column] = np.clip(scaled, -1, 1) if kind.clip else scaled
    observation = np.zeros(space.shape)
    observation[: len(values)] = values
    if kind.order == "shuffled":
        env.np_random.shuffle(observation[1:])
    return observation.astype(space.dtype)


_FIXED_SEED = 12345
HIGHWAY_ENV = "highway_env."
"""HighwayEnv's modules begin with it."""


class HighwayEnvScenario(gym.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """A HighwayEnv environment with scenario parameters as reset options, and a traffic model over them.

    `reset(options={"gap": [20.0, 15.0, 30.0, 30.0], "ego_speed": 28.0})` sets these; what is not given is drawn from
    `space.base`, and `options={"x": vector}` sets all. Everything after reset is HighwayEnv's own, and a function of x
    and the actions: what HighwayEnv still draws (the traffic beyond the vehicles that have parameters) is seeded by the
    parameter `noise`, a standard normal number of which every bit counts.

    `info` carries `scenario` (names to values), `x`, `collision`, `min_measure` (so far), and at the end `measure`: -1
    if the ego crashed, else the least measure over all simulation steps, not only those at which the policy is queried.

    Attributes:
        space: Names, units, bounds and traffic model of x.
        fixed: Parameters that are held, name to value; they are not in x.

    Example:
        >>> import gymnasium as gym, highway_env, rare_envs
        >>> env = rare_envs.HighwayEnvScenario(gym.make("highway-fast-v0", config={"vehicles_count": 5}))
        >>> observation, info = env.reset(seed=0, options={"ego_speed": 30.0, "gap": [12.0, 20.0, 20.0, 20.0]})
        >>> info["scenario"]["gap"], env.space.dim
        (array([12., 20., 20., 20.]), 19)
    """

    def __init__(
        self,
        env: gym.Env[Any, Any],
        *,
        vehicles: int | None = None,
        measure: str | Callable[[Any], float] = "ttc",
        fixed: Mapping[str, Any] | str | None = None,
        noise: bool | str = True,
        base: Any = None,
    ) -> None:
        """Wrap an environment.

        Args:
            env: From `gym.make` of HighwayEnv, with any configuration; wrappers that change observations go around
                this one.
            vehicles: Number of vehicles with parameters, on the highway only; 4 by default.
            measure: "ttc", "front_ttc", or a function of HighwayEnv's environment, called at each simulation step;
                small is dangerous, and 0 or less is for collisions only if gamma = 0 is to count just them.
            fixed: Values of parameters that are to be held, or "highway_env" for all that HighwayEnv itself holds: x is
                then what it draws, with the distribution from which it draws it.
            noise: True, what is left random is seeded by the parameter `noise`; "fixed", by one number for all x.
            base: Distribution of the parameters without noise, in place of HighwayEnv's: an object with the methods
                of `rare_envs.distributions.space.Distribution`.

        Raises:
            ValueError: If the environment is not one of HighwayEnv's that are known here, or an argument is invalid.
        """
        RecordConstructorArgs.__init__(self, vehicles=vehicles, measure=measure, fixed=fixed, noise=noise, base=base)
        gym.Wrapper.__init__(self, env)
        self.layout = _find_layout(env)
        self._kind = class_from_path(self.scene.config["other_vehicles_type"])
        if not callable(measure):
            check_name("measure", measure, HIGHWAY_ENV_MEASURES)
        self._measure = measure if callable(measure) else HIGHWAY_ENV_MEASURES[measure]
        if noise is not True and noise != "fixed":
            raise ValueError(f"Expected noise True or 'fixed', got {noise!r}.")
        self._rng = np.random.default_rng()
        self.layout.prepare(self.scene)
        groups = self.layout.groups(self.scene, self._count_vehicles(vehicles)) + idm_groups(self.layout, self._kind)
        self.fixed = _hold_parameters(groups, fixed)
        varying = [group for group in groups if group.parameters[0].name not in self.fixed]
        self.space = _make_space(varying, self.layout.leftover and noise is True, base)
        self._x: FloatArray = np.full(self.space.dim, np.nan)
        self._least = TTC_MAX

    @property
    def scene(self) -> Any:
        """HighwayEnv's environment itself: its road, vehicles and configuration."""
        return self.env.unwrapped

    def _count_vehicles(self, asked: int | None) -> int:
        """Return the number of vehicles with parameters."""
        default, most = self.layout.vehicles
        available = most if most is not None else int(self.scene.config["vehicles_count"])
        count = min(default, available) if asked is None else asked
        low = 1 if most is None else most
        if isinstance(count, bool) or not isinstance(count, int) or not low <= count <= available:
            raise ValueError(f"Expected vehicles from {low} to {available} for this environment, got {asked!r}.")
        return count

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode.

        Args:
            seed: Seeds the draw of what is not given.
            options: Parameters by name, or {"x": vector}.

        Returns:
            Observation and info.

        Raises:
            ValueError: If an option is unknown, held, of the wrong shape, NaN or outside its range.
        """
        if seed is not None:
            self._rng, _ = seeding.np_random(seed)
        self._x = self.space.scenario_x(options, 1, self._rng)[0]
        scene, values = self.scene, self._values()
        noise = values.get("noise")
        with restore_class_parameters(self._kind):
            self.env.reset(seed=_FIXED_SEED if noise is None else int(np.float64(noise).view(np.uint64)))
        self.layout.arrange(scene, values)
        set_idm(others_of(scene), values)
        self._measure_every_step()
        scene.define_spaces()  # links observation and action to the scene again, as HighwayEnv's own reset does
        observation = scene.observation_type.observe()
        return observation, scene._info(observation, action=scene.action_space.sample()) | self._info()

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Take one decision of the policy, as in HighwayEnv."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        set_idm(others_of(self.scene), self._values())  # of vehicles that came during the step
        info = info | self._info()
        if terminated or truncated:
            info["measure"] = self.measured
        return observation, reward, bool(terminated), bool(truncated), info

    @property
    def measured(self) -> float:
        """The measure of the episode so far."""
        return COLLISION if self.scene.vehicle.crashed else self._least

    def _values(self) -> dict[str, Any]:
        """Return all parameters, those that are held included."""
        return {**self.fixed, **self.space.named(self._x)}

    def _measure_every_step(self) -> None:
        """Measure now and after every simulation step of this episode."""
        scene, road = self.scene, self.scene.road
        step = road.step
        self._least = self._measure_now()

        def step_and_measure(dt: float) -> None:
            step(dt)
            if not scene.vehicle.crashed:
                self._least = min(self._least, self._measure_now())

        road.step = step_and_measure

    def _measure_now(self) -> float:
        value = self._measure(self.scene)
        if isinstance(value, bool | np.bool_) or math.isnan(value):
            gave = value if isinstance(value, bool | np.bool_) else "NaN"
            raise ValueError(f"The measure {self._measure!r} gave {gave}; expected a number that is small in danger.")
        return float(value)

    def _info(self) -> dict[str, Any]:
        crashed = bool(self.scene.vehicle.crashed)
        return {"scenario": self._values(), "x": self._x.copy(), "min_measure": self.measured, "collision": crashed}


def _find_layout(env: gym.Env[Any, Any]) -> Layout:
    """Return the layout of an environment."""
    inner: Any = env.unwrapped
    plain: Any = env
    while isinstance(plain, OrderEnforcing | PassiveEnvChecker | TimeLimit):
        plain = plain.env
    if not isinstance(inner, AbstractEnv):
        raise ValueError(f"Expected an environment of HighwayEnv ({', '.join(HIGHWAY_ENV_IDS)}), got {env}.")
    if plain is not inner:
        raise ValueError(f"Expected the environment as gym.make gives it, got {plain}; put wrappers around this one.")
    known = next((kind for kind in LAYOUTS if isinstance(inner, kind)), None)
    names = f"{', '.join(HIGHWAY_ENV_IDS)}, with one ego"
    if known is None or len(inner.controlled_vehicles) != 1 or isinstance(inner.action_space, gym.spaces.Tuple):
        raise ValueError(f"No parameters are known for {type(inner).__name__}; expected {names}.")
    kind: type = class_from_path(inner.config["other_vehicles_type"])
    places = {name: getattr(getattr(kind, name, None), "__module__", HIGHWAY_ENV) for name in STARTING_METHODS}
    functions = {name: getattr(getattr(inner, name, None), "__func__", None) for name in SCENE_METHODS}
    own = [f"{kind.__name__}.{name}" for name, place in places.items() if not place.startswith(HIGHWAY_ENV)]
    own += [f"{type(inner).__name__}.{name}" for name, it in functions.items() if it is not getattr(known, name, None)]
    if own:
        raise ValueError(
            f"No parameters are known for the scene by {own[0]}, which is not {known.__name__}'s; expected {names}."
        )
    simulated, decided = (inner.config[f"{name}_frequency"] for name in ("simulation", "policy"))
    numbers = all(isinstance(each, int | float | np.number) and each > 0 for each in (simulated, decided))
    if not numbers or simulated < decided or simulated % decided:
        raise ValueError(
            f"Expected simulation_frequency as a multiple of policy_frequency, both above 0, got {simulated!r} and "
            f"{decided!r}: HighwayEnv would simulate less time than a step lasts, or none."
        )
    return LAYOUTS[known]


def _hold_parameters(groups: list[Group], fixed: Mapping[str, Any] | str | None) -> dict[str, Any]:
    """Return the values of the parameters that are held, checked against their ranges."""
    usual = {group.parameters[0].name: group.usual for group in groups if group.usual is not None}
    if fixed is None or fixed == "highway_env":
        return usual if fixed else {}
    if not isinstance(fixed, Mapping):
        raise ValueError(f"Expected fixed as a mapping of names to values or 'highway_env', got {fixed!r}.")
    alone = {group.parameters[0].name: group for group in groups if len(group.parameters) == 1}
    for name in fixed:
        check_name("parameter to hold", name, alone)
    if not fixed:
        return {}
    held = _make_space([alone[name] for name in fixed], False, None)
    return held.named(held.scenario_x(dict(fixed), 1, np.random.default_rng(0))[0])


def _make_space(groups: list[Group], noise: bool, base: Any) -> ScenarioSpace:
    """Return the space of the parameters that vary."""
    parameters = [parameter for group in groups for parameter in group.parameters]
    distributions = [group.distribution for group in groups] if base is None else [base]
    if noise:
        parameters.append(Parameter("noise", "", -np.inf, np.inf, "seeds what HighwayEnv still draws"))
        distributions.append(NoiseDistribution(1))
    if not parameters:
        raise ValueError("Every parameter is held; expected at least one that varies.")
    return ScenarioSpace(parameters, join_independent(*distributions))
