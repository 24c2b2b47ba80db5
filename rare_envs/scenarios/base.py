"""Scenarios: parameters, an initial state, the motion of the vehicles around the ego, and their traffic models."""

from __future__ import annotations

import math
import reprlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from importlib import resources
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias, cast

import numpy as np
import torch
from torch import Tensor

from rare_envs.devices import scalars
from rare_envs.distributions.fitted import FITTED_KEYS, FileDistribution, FittedDistribution, read_distribution
from rare_envs.distributions.space import Distribution, Parameter
from rare_envs.files import parse_json_object, read_text_file
from rare_envs.plugins import did_you_mean, make_object, names_object
from rare_envs.traffic.road import Road
from rare_envs.traffic.state import State, point_mass


class Others(NamedTuple):
    """Vehicles 1 to N - 1 after a tick, as `rare_envs.traffic.state.Motion`, and what their script remembers.

    Example:
        >>> one = torch.full((1, 1), 12.0)
        >>> Others(x=one, y=0 * one, heading=0 * one, speed=one).theta is None  # a script without memory
        True
    """

    x: Tensor
    """Centres along the road [m], shape (B, N - 1)."""
    y: Tensor
    """Centres across the road [m], positive to the right, shape (B, N - 1)."""
    heading: Tensor
    """Headings relative to the road [rad], shape (B, N - 1)."""
    speed: Tensor
    """Speeds along the headings [m/s], shape (B, N - 1)."""
    theta: Tensor | None = None
    """The state's theta after the tick, shape (B, P), where the script keeps its memory in it; None if it stays."""


SPEED_RANGE = ("m/s", 0.0, 45.0)
"""Unit and range of a speed as a parameter. Nobody drives backwards, and 45 m/s (162 km/h) is above what congested
US 101 (at most 27 m/s in the events) and free-flow traffic reach."""


@dataclass(frozen=True, kw_only=True)
class Scenario:
    """A scenario: parameters, initial state, motion of the others, and defaults.

    The shipped ones are a file each and a line in `SCENARIOS`; `rare_envs.register_scenario` adds one of your own, and
    `docs/environments.md` shows how to write it.

    Raises:
        ValueError: If it contradicts itself.

    Example:
        >>> from rare_envs.scenarios import find_scenario
        >>> cut_in = find_scenario("cut_in")
        >>> cut_in.vehicle_names, cut_in.labels
        (('ego', 'cutter', 'lead'), ('the ego', 'the cutter', 'the lead'))
        >>> state = cut_in.initial(torch.tensor([[20.0, 15.0, 25.0, 10.0, 50.0, 3.5, 4.0, *[0.0] * 6]]))
        >>> cut_in.others(state, 0.1).x.round(decimals=1).tolist()  # cutter and lead one tick later
        [[16.5, 72.5]]
    """

    name: str
    """Short name, such as "cut_in"."""
    road: Road
    """The road that all vehicles are on."""
    vehicle_names: tuple[str, ...]
    """Names of the N vehicles, "ego" first; agents are called by them."""
    labels: tuple[str, ...] = ()
    """The same in words for pictures; by default from the names: "the cutter", "vehicle 1"."""
    horizon: float
    """Default length of an episode [s]."""
    parameters: tuple[Parameter, ...]
    """Parameters in the columns of x, in order."""
    bases: Mapping[str, Any]
    """Traffic models by name, the default first: JSON files, contents of such a file (names and box may be left
    out there), or distribution objects."""
    initial: Callable[[Tensor], State]
    """x (B, d) to the state at time 0."""
    others: Callable[[State, float], Others]
    """The script: state and dt [s] to the other vehicles after the tick."""
    driven: Callable[[State, Tensor, float], Others]
    """State, the other vehicles' accelerations and yaw rates (B, N - 1, 2) and dt [s] to the same, for vehicles that
    have drivers."""
    drivers: str | None = None
    """Drivers of the other vehicles unless told otherwise; None for the script."""
    signals: Callable[[State], Tensor] | None = None
    """State, the ego first, to which other vehicles have their indicator on towards the ego's lane, boolean,
    (B, N - 1); None if nobody ever has."""
    evades: Callable[[State], Tensor] | None = None
    """State to whether a vehicle that had not looked has evaded the ego by now, boolean, (B,): a rapid evasive
    manoeuvre by another vehicle, which makes an episode without contact a near-crash. None if nobody ever does."""

    def __post_init__(self) -> None:
        if not all(isinstance(vehicle, str) and vehicle.strip() for vehicle in self.vehicle_names):
            raise ValueError(
                f"Expected vehicles with names, got {self.vehicle_names!r} in the scenario {self.name!r}; an empty one "
                "has no label and calls no agent."
            )
        names = [p.name for p in self.parameters]
        words = (vehicle.replace("_", " ") for vehicle in self.vehicle_names)
        labels = self.labels or tuple(each if each[-1].isdigit() else f"the {each}" for each in words)
        object.__setattr__(self, "labels", labels)
        for what, right in {
            'vehicles with different names, "ego" first': self.vehicle_names[:1] == ("ego",)
            and len(set(self.vehicle_names)) == self.vehicles,
            "as many labels as vehicles": len(labels) == self.vehicles,
            "parameters with different names, none of them 'x'": 0 < len(names) == len({*names, "x"}) - 1,
            "parameters with low < high": all(p.low < p.high and p.size >= 1 for p in self.parameters),
            "at least one traffic model": len(self.bases) > 0,
            "a horizon in s": math.isfinite(self.horizon) and self.horizon > 0,
        }.items():
            if not right:
                raise ValueError(f"Expected {what} in the scenario {self.name!r}.")

    @property
    def vehicles(self) -> int:
        """N, the ego included."""
        return len(self.vehicle_names)

    @property
    def default_base(self) -> str:
        """Name of the traffic model that is used unless another is named."""
        return next(iter(self.bases))

    @property
    def size(self) -> int:
        """Number of columns of x."""
        return sum(p.size for p in self.parameters)

    @property
    def column_parameters(self) -> list[Parameter]:
        """The parameter of each column of x."""
        return [parameter for parameter in self.parameters for _ in range(parameter.size)]


def base_files(prefix: str, *names: str) -> dict[str, Any]:
    """Return the traffic models of these names that come with the package, as files."""
    folder = resources.files("rare_envs") / "data"
    return {name: folder / f"{prefix}_{name.replace('-', '_')}.json" for name in names}


def columns(*values: Tensor) -> Tensor:
    """Return columns (B,) side by side as (B, N), each contiguous in memory: ticks work on one vehicle's at a time.

    Example:
        >>> columns(torch.tensor([1.0, 2.0]), torch.tensor([3.0, 4.0])).tolist()
        [[1.0, 3.0], [2.0, 4.0]]
    """
    return torch.stack(values).T


def keep_lane(state: State, action: Tensor, dt: float) -> Others:
    """Move vehicles 1 to N - 1 straight on with the accelerations of their drivers, actions (B, N - 1, 2)."""
    return keep_straight(state, action[..., 0], dt)


def keep_straight(state: State, acceleration: Tensor | float, dt: float) -> Others:
    """Move vehicles 1 to N - 1 straight on along a straight road, down to a standstill.

    Args:
        state: Traffic of B scenarios.
        acceleration: Theirs [m/s^2], shape (B, N - 1).
        dt: Tick [s].

    Example:
        >>> from rare_envs.scenarios import State
        >>> x = torch.tensor([[0.0, 30.0]])
        >>> state = State(x, 0 * x, 0 * x, torch.full((1, 2), 20.0), theta=x[:, :0])
        >>> keep_straight(state, -2.0, dt=0.5).speed.tolist()
        [[19.0]]
    """
    speed, (tick,) = state.speed[:, 1:], scalars((dt,), state.speed)
    after = (speed + acceleration * tick).clamp_min(0.0)
    return Others(state.x[:, 1:] + speed * tick, state.y[:, 1:], state.heading[:, 1:], after)


def drive_points(state: State, action: Tensor, dt: float, road: Road) -> Others:
    """Move vehicles 1 to N - 1 as points that turn at will, wherever they are on the road.

    Args:
        state: Traffic of B scenarios.
        action: Their accelerations [m/s^2] and yaw rates relative to the road [rad/s], shape (B, N - 1, 2).
        dt: Tick [s].
        road: The road.

    Example:
        >>> from rare_envs.scenarios import State, straight
        >>> x = torch.tensor([[0.0, 30.0]])
        >>> state = State(x, 0 * x, 0 * x, torch.full((1, 2), 20.0), theta=x[:, :0])
        >>> drive_points(state, torch.tensor([[[1.0, 0.2]]]), 0.5, straight(2)).speed.item()
        20.5
    """
    x, y, heading, speed = (field[:, 1:] for field in (state.x, state.y, state.heading, state.speed))
    curvature = road.curvature(x)
    ahead = torch.cos(heading) * speed / (1.0 - curvature * y)
    return Others(*point_mass(x, y, heading, speed, action[..., 0], action[..., 1] + curvature * ahead, dt, curvature))


_TRIAL_DRAWS = 1000
"""Draws by which a user's distribution is tried before it is used."""
DISTRIBUTION_METHODS = ("sample", "log_prob", "to_standard_normal", "from_standard_normal")


def load_base(scenario: Scenario, base: str | PathLike[str] | Distribution | None = None) -> Distribution:
    """Return the traffic model of a scenario.

    A JSON file holds what the shipped ones do: names, low, high, weights, means, covariances, and if wanted units,
    provenance, coordinates and order (see `TruncatedGaussianMixture`); or, for independent Beta variables, names, low,
    high, alpha and beta, one for each column of x (see `BetaDistribution`). A file with refits, events, family,
    frequency or checks gives a `FittedDistribution`, see its `from_dict`.

    Args:
        scenario: The scenario.
        base: The name of one of `scenario.bases`, a path to a JSON file, an object with the four methods of
            `Distribution`, or "module:name" of what makes such an object without arguments; None for the scenario's
            default, which is its first.

    Raises:
        ValueError: There is no such file, or it does not fit the scenario.

    Example:
        >>> from rare_envs.scenarios import find_scenario
        >>> load_base(find_scenario("car_following"), "us101").dim
        3
    """
    base = scenario.default_base if base is None else base
    found: Any = scenario.bases.get(str(base), Path(base)) if isinstance(base, str | PathLike) else base
    if isinstance(found, Path) and names_object(str(base)) and not found.exists():
        found = make_object(str(base), "traffic model")
    where = (scenario.name, tuple(p.name for p in scenario.parameters), str(base))
    if isinstance(found, Mapping):
        box = scenario.column_parameters
        own = {"names": list(where[1]), "low": [p.low for p in box], "high": [p.high for p in box]}
        return _fit_to(scenario, str(base), _read(*where, {**own, **found}))
    if not callable(getattr(found, "read_text", None)):
        return _check_object(scenario, found)
    if isinstance(found, Path) and (not found.exists() or found.is_dir()):
        raise ValueError(
            f"No traffic model {str(base)!r} for {scenario.name}"
            f"{did_you_mean(str(base), scenario.bases)}: neither one of {', '.join(scenario.bases)} nor a file. "
            "Of recordings rare-envs fit makes one."
        )
    try:
        text = read_text_file(found) if isinstance(found, Path) else found.read_text(encoding="utf-8")
    except (OSError, ValueError) as error:
        raise ValueError(f"Cannot read the traffic model {str(found)!r}: {error}") from None
    return _fit_to(scenario, str(base), _read_text(*where, text))


Known: TypeAlias = FileDistribution | FittedDistribution


@lru_cache(maxsize=64)
def _read_text(scenario: str, names: tuple[str, ...], source: str, text: str) -> Known:
    """Return the distribution of a text. It is kept: a file has some 100 refits, an environment is made often."""
    try:
        data = parse_json_object(text, f"Traffic model {source}")
    except ValueError as error:
        raise ValueError(f"{error} Of recordings rare-envs fit makes a traffic model.") from None
    return _read(scenario, names, source, data)


def _read(scenario: str, names: tuple[str, ...], source: str, data: Mapping[str, Any]) -> Known:
    """Return the distribution of a file, a fitted one if the file says what it was fitted to."""
    if data.get("names") != list(names):
        raise ValueError(
            f"Traffic model {source} does not fit {scenario}: "
            f"expected names {list(names)} in this order, got {reprlib.repr(data.get('names'))}."
        )
    try:
        fitted = any(key in data for key in FITTED_KEYS)
        return FittedDistribution.from_dict(data) if fitted else read_distribution(data)
    except ValueError as error:
        raise ValueError(f"Traffic model {source}: {error}") from None


def _fit_to(scenario: Scenario, source: str, distribution: Known) -> Distribution:
    """Return the distribution as one of a scenario, with its size and range checked."""
    box, wrong = scenario.column_parameters, f"Traffic model {source} does not fit {scenario.name}: "
    if distribution.dim != len(box):
        raise ValueError(f"{wrong}expected {len(box)} columns, got {distribution.dim}.")
    for p, low, high in zip(box, distribution.low, distribution.high, strict=True):
        if low < p.low or high > p.high:
            allowed = f"[{p.low:g}, {p.high:g}] {p.unit}"
            raise ValueError(f"{wrong}expected {p.name} within {allowed}, got [{low:g}, {high:g}].")
    if isinstance(distribution, FittedDistribution):
        return replace(distribution, siblings=partial(load_base, scenario))
    return distribution


def _check_object(scenario: Scenario, base: object) -> Distribution:
    # an object of the user's: the message says which it lacks
    missing = [name for name in DISTRIBUTION_METHODS if not callable(getattr(base, name, None))]
    if missing:
        raise ValueError(
            f"A traffic model must be one of {', '.join(scenario.bases)}, a path to a JSON file, or an "
            f"object with {', '.join(DISTRIBUTION_METHODS)}; got {type(base).__name__} without "
            f"{', '.join(missing)}."
        )
    distribution = cast(Distribution, base)
    box = scenario.column_parameters
    draws = np.asarray(distribution.sample(_TRIAL_DRAWS, np.random.default_rng(0)), dtype=np.float64)
    wrong = f"Traffic model {type(base).__name__} does not fit {scenario.name}: "
    if draws.shape != (_TRIAL_DRAWS, len(box)):
        raise ValueError(
            f"{wrong}sample({_TRIAL_DRAWS}, rng) must have shape ({_TRIAL_DRAWS}, {len(box)}), one column for each "
            f"of {', '.join(p.name for p in box)}; got {draws.shape}."
        )
    for p, column in zip(box, draws.T, strict=True):
        if not ((column >= p.low) & (column <= p.high)).all():  # NaN is outside too
            raise ValueError(f"{wrong}it draws {p.name} outside [{p.low:g}, {p.high:g}] {p.unit}; truncate it.")
    return distribution


_DRAWS = 8
"""Episodes of the trial."""
_DT = 0.1
"""Its tick [s], the default of environments."""


def try_scenario(scenario: Scenario) -> None:
    """Start a few episodes and move the vehicles around the ego by one tick, by the script and by commands."""
    for name in scenario.bases:
        load_base(scenario, name)
    x = torch.from_numpy(load_base(scenario).sample(_DRAWS, np.random.default_rng(0))).float()
    state, wrong, n = scenario.initial(x), f"Scenario {scenario.name!r}: ", scenario.vehicles
    if not isinstance(state, State):
        raise ValueError(f"{wrong}expected initial(x) to give a State, got {type(state).__name__}.")
    if len(state.theta) != _DRAWS:
        raise ValueError(f"{wrong}expected theta of {_DRAWS} rows, got {tuple(state.theta.shape)}.")
    _check(wrong, "initial(x)", state[:4], n)
    action = torch.zeros_like(state.x[:, 1:, None]).expand(-1, -1, 2)
    for what, after in {
        "others(state, dt)": scenario.others(state, _DT),
        "driven(state, action, dt)": scenario.driven(state, action, _DT),
    }.items():
        _check(wrong, what, after, n - 1)
        theta = getattr(after, "theta", None)
        if theta is not None and (not isinstance(theta, Tensor) or theta.shape != state.theta.shape):
            raise ValueError(f"{wrong}expected {what} to keep the shape {tuple(state.theta.shape)} of theta.")
    for name, shape in (("signals", (_DRAWS, n - 1)), ("evades", (_DRAWS,))):
        tell: Callable[[State], Tensor] | None = getattr(scenario, name)
        if tell is not None and (told := tell(state)).shape != shape:
            raise ValueError(f"{wrong}expected {name}(state) of shape {shape}, got {tuple(told.shape)}.")


def _check(wrong: str, what: str, fields: tuple[Any, ...], vehicles: int) -> None:
    """Check that fields are tensors (B, vehicles) of finite numbers."""
    if not isinstance(fields, tuple) or len(fields) < 4 or not all(isinstance(field, Tensor) for field in fields[:4]):
        raise ValueError(f"{wrong}expected {what} to give x, y, heading and speed, as State or Others; got {fields!r}.")
    for name, field in zip(State._fields, fields[:4], strict=False):
        if field.shape != (_DRAWS, vehicles):
            shapes = f"{name} of shape (B, {vehicles}) from {what}, got {tuple(field.shape)} for B = {_DRAWS}"
            raise ValueError(f"{wrong}expected {shapes}.")
        if not bool(torch.isfinite(field).all()):
            raise ValueError(f"{wrong}{name} from {what} is not finite.")
