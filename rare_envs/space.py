"""Scenario parameters: names, units, ranges, and the base distribution over them.

`ScenarioSpace` is what a scenario exposes as `space`; `load_base` finds the law behind it, shipped
(`"us101"`, `"highway"`), in a JSON file of the same form, or as an object of the user's own.
"""

from __future__ import annotations

import difflib
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from importlib import resources
from os import PathLike
from pathlib import Path
from typing import Any, Protocol, cast, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rare_envs.beta_law import BetaLaw
from rare_envs.distributions import TruncatedGaussianMixture
from rare_envs.log_mixture import LogMixture

Array = NDArray[np.float64]

BASES = {
    "car_following": ("us101", "highway"),
    "cut_in": ("us101", "highway"),
    "highway": ("okelly2018",),
}
"""Base distributions that are shipped for each scenario; the first is the default."""


@runtime_checkable
class Distribution(Protocol):
    """A law on d-dimensional points with an exact map to standard normal space."""

    def sample(self, n: int, rng: np.random.Generator) -> Array:
        """Independent points, shape (n, d)."""

    def log_prob(self, x: Array) -> Array:
        """Log density, (n, d) -> (n,); -inf outside the support."""

    def to_standard_normal(self, x: Array) -> Array:
        """Map (n, d) -> (n, d) under which the law becomes N(0, I)."""

    def from_standard_normal(self, u: Array) -> Array:
        """Inverse of `to_standard_normal`, (n, d) -> (n, d)."""


_TRIAL_DRAWS = 1000
"""Draws by which a user's distribution is tried before it is used."""
METHODS = ("sample", "log_prob", "to_standard_normal", "from_standard_normal")


@dataclass(frozen=True)
class Parameter:
    """One named scenario parameter and the physical range it is allowed."""

    name: str
    unit: str
    low: float
    high: float
    meaning: str
    size: int = 1
    """Columns of x that it takes: 1 for a scalar, more for a block of like values, one for each vehicle, say."""


# Speeds: none backwards, and 45 m/s (162 km/h) is above what congested US 101 (at most 27 m/s in
# the events) and free-flow traffic reach. Gaps: under 1 m is below IDM's standstill distance and
# of the order of the position error of the recordings (1.2 m along the road); beyond 150 m the lead
# no longer matters within 10 s (120 m for the gap that a vehicle cuts into: a longer one is no
# cut-in). Lateral offset: vehicles 2 m wide with at least 0.2 m between their sides, and at most
# one lane (4 m) plus half a metre off-centre each.
_SPEED = ("m/s", 0.0, 45.0)
PARAMETERS: dict[str, tuple[Parameter, ...]] = {
    "car_following": (
        Parameter("ego_speed", *_SPEED, "initial speed of the ego"),
        Parameter("lead_speed", *_SPEED, "speed of the lead, which keeps it"),
        Parameter("gap", "m", 1.0, 150.0, "initial gap from ego to lead, bumper to bumper"),
    ),
    "cut_in": (
        Parameter("ego_speed", *_SPEED, "initial speed of the ego"),
        Parameter("cut_in_speed", *_SPEED, "initial speed of the vehicle that cuts in"),
        Parameter("lead_speed", *_SPEED, "speed of the lead in the ego's lane, which keeps it"),
        Parameter("cut_in_gap", "m", 1.0, 120.0, "initial gap from ego to cutter along the road"),
        Parameter("lead_gap", "m", 1.0, 150.0, "initial gap from cutter to lead along the road"),
        Parameter("lateral_offset", "m", 2.2, 5.0, "initial distance of the centres across"),
    ),
    # The ranges of O'Kelly et al. (2018), section 4, which are those of their Beta laws.
    "highway": (
        Parameter("s", "m", 80.0, 120.0, "initial place along the road, the ego's first", 6),
        Parameter("t", "m", -0.25, 0.25, "initial place to the right of the lane's middle", 6),
        Parameter("heading", "deg", -3.6, 3.6, "initial heading relative to the road, positive to the right", 6),
        Parameter("speed", "m/s", 10.0, 20.0, "initial speed", 6),
    ),
}


@dataclass(frozen=True, eq=False)
class ScenarioSpace:
    """The parameters of a scenario in the order of x, and their base distribution.

    Attributes:
        names: Parameter names.
        units: Their units.
        low: Lower ends of the allowed ranges, one for each column of x, shape (d,).
        high: Upper ends, shape (d,).
        base: Law of x; the methods of the same name go to it.
        sizes: Columns of x that each parameter takes; by default one each.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    low: Array
    high: Array
    base: Distribution
    sizes: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "names", tuple(self.names))
        object.__setattr__(self, "units", tuple(self.units))
        object.__setattr__(self, "sizes", tuple(self.sizes) or (1,) * len(self.names))
        for name in ("low", "high"):
            bound = np.array(getattr(self, name), dtype=np.float64)
            bound.setflags(write=False)
            object.__setattr__(self, name, bound)
        fits = len(self.names) == len(self.units) == len(self.sizes)
        if not (fits and self.low.shape == self.high.shape == (sum(self.sizes),)):
            raise ValueError(
                f"Expected as many names, units and bounds, got {len(self.names)} names, {len(self.units)} units, "
                f"sizes {self.sizes}, low {self.low.shape} and high {self.high.shape}."
            )

    @property
    def dim(self) -> int:
        """Number of columns of x, d."""
        return sum(self.sizes)

    def sample(self, n: int, rng: np.random.Generator) -> Array:
        """Independent scenarios from the base distribution, shape (n, d)."""
        return self.base.sample(n, rng)

    def log_prob(self, x: Array) -> Array:
        """Log density of the base distribution, (n, d) -> (n,)."""
        return self.base.log_prob(x)

    def to_standard_normal(self, x: Array) -> Array:
        """Map to standard normal space, (n, d) -> (n, d)."""
        return self.base.to_standard_normal(x)

    def from_standard_normal(self, u: Array) -> Array:
        """Map from standard normal space, (n, d) -> (n, d)."""
        return self.base.from_standard_normal(u)

    def named(self, x_row: ArrayLike) -> dict[str, Any]:
        """One scenario, shape (d,), as a mapping from names to numbers, or to arrays for blocks."""
        row = np.asarray(x_row, dtype=np.float64)
        if row.shape != (self.dim,):
            raise ValueError(f"Expected one scenario of shape ({self.dim},), got {row.shape}.")
        return {name: float(part[0]) if size == 1 else part for name, size, part in self._parts(row)}

    def columns(self, x: Array) -> dict[str, Array]:
        """Scenarios (n, d) as a mapping from names to columns: (n,), or (n, size) for blocks."""
        return {name: part[:, 0] if size == 1 else part for name, size, part in self._parts(x)}

    def _parts(self, x: Array) -> list[tuple[str, int, Array]]:
        """Name, size and columns of each parameter."""
        parts = zip(self.names, self.sizes, self._slices, strict=True)
        return [(name, size, x[..., at].copy()) for name, size, at in parts]

    @cached_property
    def _slices(self) -> tuple[slice, ...]:
        """Columns of x of each parameter."""
        ends = np.cumsum(self.sizes).tolist()
        return tuple(slice(end - size, end) for size, end in zip(self.sizes, ends, strict=True))

    def describe(self) -> str:
        """All valid names with their ranges, in the order of x."""
        return ", ".join(f"{self._title(j)} {self._range(j)}" for j in range(len(self.names)))

    def _title(self, j: int) -> str:
        return self.names[j] if self.sizes[j] == 1 else f"{self.names[j]} ({self.sizes[j]} values)"

    def validate(self, x: ArrayLike) -> Array:
        """Checks shape and ranges.

        Args:
            x: Scenarios, shape (n, d), or one of shape (d,).

        Returns:
            The same as float64, shape (n, d).

        Raises:
            ValueError: Wrong shape, NaN, or a value outside its range.
        """
        points = _as_numbers("x", x)
        if points.ndim == 1:
            points = points[None]
        if points.ndim != 2 or points.shape[1] != self.dim:
            raise ValueError(
                f"Expected x of shape (n, {self.dim}) or ({self.dim},), got {np.shape(x)}; "
                f"its columns are {self.describe()}."
            )
        for j in range(len(self.names)):
            self._check_range(j, points[:, self._slices[j]])
        return points

    def scenario_x(self, options: Mapping[str, Any] | None, n: int, rng: np.random.Generator) -> Array:
        """Scenarios with some parameters given and the others drawn from the base distribution.

        The given values replace drawn ones: the rest is not conditioned on them.

        Args:
            options: Parameter names to scalars or (n,) arrays, blocks to (size,) or (n, size) arrays, or
                {"x": (d,) or (n, d)} for all of them; None draws everything.
            n: Number of scenarios.
            rng: Source of randomness.

        Returns:
            Scenarios, shape (n, d).

        Raises:
            ValueError: Unknown name, wrong shape, NaN, or a value outside its range.
        """
        options = {} if options is None else options
        if not isinstance(options, Mapping):
            raise ValueError(f"Expected options as a mapping of parameter names to values, got {options!r}.")
        if "x" in options:
            return self._given_x(options, n)
        columns = {self._index(name): self._column(name, value, n) for name, value in options.items()}
        points = np.array(self.base.sample(n, rng), dtype=np.float64)
        for j, column in columns.items():
            points[:, self._slices[j]] = column
        return self.validate(points)

    def _given_x(self, options: Mapping[str, Any], n: int) -> Array:
        others = sorted(str(name) for name in options if name != "x")
        if others:
            raise ValueError(f"x gives every parameter, so {', '.join(others)} cannot be given beside it.")
        points = self.validate(options["x"])
        if len(points) not in (1, n):
            raise ValueError(f"Expected x with 1 or {n} rows, one per scenario, got {len(points)}.")
        return np.repeat(points, n, axis=0) if len(points) == 1 else points

    def _column(self, name: str, value: Any, n: int) -> Array:
        values, j = _as_numbers(name, value), self._index(name)
        size = self.sizes[j]
        if size == 1:
            if values.shape not in ((), (1,), (n,)):
                raise ValueError(f"Expected {name} as one number or an array of shape ({n},), got {values.shape}.")
            column = np.atleast_1d(values)[:, None]
        else:
            if values.shape not in ((size,), (n, size)):
                raise ValueError(f"Expected {name} of shape ({size},) or ({n}, {size}), got {values.shape}.")
            column = np.atleast_2d(values)
        self._check_range(j, column)
        return column

    def _index(self, name: str) -> int:
        if name in self.names:
            return self.names.index(name)
        raise ValueError(
            f"Unknown scenario parameter {name!r}{did_you_mean(str(name), (*self.names, 'x'))}; "
            f"valid are {self.describe()}, or 'x' for all of them in this order."
        )

    def _range(self, j: int) -> str:
        at = self._slices[j].start
        return f"[{self.low[at]:g}, {self.high[at]:g}] {self.units[j]}".rstrip()

    def _check_range(self, j: int, values: Array) -> None:
        """Check the columns of a parameter, shape (n, size)."""
        low, high = self.low[self._slices[j]], self.high[self._slices[j]]
        wrong = ~((values >= low) & (values <= high) & np.isfinite(values))  # True for NaN too
        if wrong.any():
            i, k = np.unravel_index(int(np.argmax(wrong)), wrong.shape)
            row = f" (row {i})" if len(values) > 1 else ""
            which = f"[{k}]" if self.sizes[j] > 1 else ""
            raise ValueError(
                f"{self.names[j]}{which} = {values[i, k]:.10g}{row} is outside its range {self._range(j)}; "
                f"the parameters are {self.describe()}."
            )


def load_base(scenario: str, base: str | PathLike[str] | Distribution | None) -> Distribution:
    """The base distribution of a scenario.

    A JSON file holds what the shipped ones do: names, low, high, weights, means, covariances, and
    if wanted units, provenance (see `TruncatedGaussianMixture`) and logarithmic (see `LogMixture`); or, for independent
    Beta laws, names, low, high, alpha and beta, one for each column of x (see `BetaLaw`).

    Args:
        scenario: A key of PARAMETERS.
        base: The name of a shipped one (see `BASES`), a path to a JSON file, or an object with the four methods of
            `Distribution`; None for the scenario's default.

    Raises:
        ValueError: There is no such scenario or file, or it does not fit the scenario.
    """
    if scenario not in PARAMETERS:
        raise ValueError(
            f"Unknown scenario {scenario!r}{did_you_mean(str(scenario), PARAMETERS)}; "
            f"base distributions exist for {', '.join(PARAMETERS)}."
        )
    shipped = BASES[scenario]
    base = shipped[0] if base is None else base
    if not isinstance(base, str | PathLike):
        return _checked_object(scenario, base)
    if base in shipped:
        file = resources.files("rare_envs") / "data" / f"{scenario}_{base}.json"
        return _from_json(scenario, str(base), file.read_text(encoding="utf-8"))
    path = Path(base)
    if not path.is_file():
        raise ValueError(
            f"No base distribution {str(base)!r} for {scenario}"
            f"{did_you_mean(str(base), shipped)}: neither one of {', '.join(shipped)} nor a file."
        )
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"Cannot read the base distribution {path}: {error}.") from None
    return _from_json(scenario, str(path), text)


def _from_json(scenario: str, source: str, text: str) -> TruncatedGaussianMixture | LogMixture | BetaLaw:
    try:
        data = json.loads(text)
    except json.JSONDecodeError as error:
        raise ValueError(f"Base distribution {source} is not valid JSON: {error}.") from None
    if not isinstance(data, dict):
        raise ValueError(f"Base distribution {source}: expected a JSON object, got {type(data).__name__}.")
    wanted = [p.name for p in PARAMETERS[scenario]]
    names = data.get("names")
    if names != wanted:
        raise ValueError(
            f"Base distribution {source} does not fit {scenario}: expected names {wanted} in this order, got {names}."
        )
    try:
        kind = BetaLaw if "alpha" in data else LogMixture if data.get("logarithmic") else TruncatedGaussianMixture
        law: TruncatedGaussianMixture | LogMixture | BetaLaw = kind.from_dict(data)
    except ValueError as error:
        raise ValueError(f"Base distribution {source}: {error}") from None
    columns = sum(p.size for p in PARAMETERS[scenario])
    if law.dim != columns:
        raise ValueError(
            f"Base distribution {source} does not fit {scenario}: expected {columns} columns, got {law.dim}."
        )
    _check_box(scenario, source, law)
    return law


def _check_box(scenario: str, source: str, law: TruncatedGaussianMixture | LogMixture | BetaLaw) -> None:
    box = [parameter for parameter in PARAMETERS[scenario] for _ in range(parameter.size)]
    for parameter, low, high in zip(box, law.low, law.high, strict=True):
        if low < parameter.low or high > parameter.high:
            raise ValueError(
                f"Base distribution {source} gives {parameter.name} the range [{low:g}, {high:g}] "
                f"{parameter.unit}; {scenario} allows [{parameter.low:g}, {parameter.high:g}]."
            )


def _checked_object(scenario: str, base: object) -> Distribution:
    missing = [name for name in METHODS if not callable(getattr(base, name, None))]
    if missing:
        raise ValueError(
            f"A base distribution must be one of {', '.join(BASES[scenario])}, a path to a JSON file, or an "
            f"object with {', '.join(METHODS)}; got {type(base).__name__} without "
            f"{', '.join(missing)}."
        )
    law = cast(Distribution, base)
    box = [parameter for parameter in PARAMETERS[scenario] for _ in range(parameter.size)]
    draws = np.asarray(law.sample(_TRIAL_DRAWS, np.random.default_rng(0)), dtype=np.float64)
    wrong = f"Base distribution {type(base).__name__} does not fit {scenario}: "
    if draws.shape != (_TRIAL_DRAWS, len(box)):
        raise ValueError(
            f"{wrong}sample({_TRIAL_DRAWS}, rng) must have shape ({_TRIAL_DRAWS}, {len(box)}), one column for each "
            f"of {', '.join(p.name for p in box)}; got {draws.shape}."
        )
    for p, column in zip(box, draws.T, strict=True):
        if not ((column >= p.low) & (column <= p.high)).all():  # NaN is outside too
            raise ValueError(f"{wrong}it draws {p.name} outside [{p.low:g}, {p.high:g}] {p.unit}; truncate it.")
    return law


def did_you_mean(name: str, valid: Iterable[str]) -> str:
    """`" (did you mean 'x'?)"` for the nearest valid name, empty if none is near."""
    names = {v: v for v in valid}
    names |= {v.split("/")[-1]: v for v in names}  # an id without its namespace
    near = difflib.get_close_matches(name, list(names), n=1)
    return f" (did you mean {names[near[0]]!r}?)" if near else ""


def _as_numbers(name: str, value: Any) -> Array:
    """Float64 array of any shape; text, booleans and ragged lists are refused."""
    try:
        raw = np.asarray(value)
        if raw.dtype.kind not in "iuf":
            raise TypeError
        return raw.astype(np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"{name} must be a number or an array of numbers, got {value!r}.") from None
