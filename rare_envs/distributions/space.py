"""Scenario spaces: parameters with names, units and ranges, and their distribution; `env.unwrapped.space` is one."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from rare_envs.distributions.coordinates import FloatArray
from rare_envs.plugins import did_you_mean

MOST_SHOWN = 8
"""Parameters that `repr` names."""
RELATIVE_CHANGE = 0.1
"""Change of a positive parameter for which sensitivities are stated, as a share of its value."""


@runtime_checkable
class Distribution(Protocol):
    """A distribution of d-dimensional points with an exact map to and from standard normal space.

    Example:
        >>> from rare_envs.distributions import BetaDistribution
        >>> isinstance(BetaDistribution([2.0], [2.0], [0.0], [1.0]), Distribution)
        True
    """

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw independent points, shape (n, d)."""

    def log_prob(self, x: FloatArray) -> FloatArray:
        """Return the log density, (n, d) -> (n,); -inf outside the support."""

    def to_standard_normal(self, x: FloatArray) -> FloatArray:
        """Map points to u ~ N(0, I), (n, d) -> (n, d)."""

    def from_standard_normal(self, u: FloatArray) -> FloatArray:
        """Map u ~ N(0, I) to points, (n, d) -> (n, d)."""


class DistributionParameter(NamedTuple):
    """One parameter of a distribution, in interpretable units: what sensitivities of p are stated for.

    A distribution offers them by two methods: `parameters(names, like)` lists them, given names of the columns of x
    (x1, x2, ... by default) and a distribution of the same family whose numbering of components is followed, and
    `with_parameters(values)` returns the same distribution with other values of them. The box is no parameter.

    Example:
        >>> from rare_envs.distributions import BetaDistribution
        >>> gap = BetaDistribution([2.0], [3.0], [1.0], [40.0])
        >>> [(each.name, each.value, each.change) for each in gap.parameters(["gap"])]
        [('alpha of gap', 2.0, 0.2), ('beta of gap', 3.0, 0.30000000000000004)]
    """

    name: str
    """In words, such as "mean of log gap"."""
    value: float
    change: float
    """Change for which a sensitivity is stated, in units of the value: a standard deviation for a mean, a tenth of a
    standard deviation, of a weight or of a shape parameter, 0.1 for a correlation."""
    change_name: str
    """The same in words, such as "1 sd"."""
    columns: tuple[int, ...] = ()
    """Columns of x that it is about; none for the weight of a component, which is about all."""


def name_columns(dim: int) -> tuple[str, ...]:
    """Return names of columns: x1, x2, ..."""
    return tuple(f"x{j + 1}" for j in range(dim))


def check_values(values: FloatArray, n: int) -> None:
    """Raise a ValueError unless there are n values."""
    if values.shape != (n,):
        raise ValueError(f"Expected {n} values, one for each parameter, got shape {values.shape}.")


@dataclass(frozen=True)
class Parameter:
    """A named scenario parameter and the physical range it is allowed.

    Example:
        >>> Parameter("gap", "m", 1.0, 150.0, "from ego to lead, bumper to bumper").size
        1
    """

    name: str
    """As in reset options."""
    unit: str
    """Empty for a number without one."""
    low: float
    """Lower bound of the range."""
    high: float
    """Upper bound of the range."""
    meaning: str
    """In words."""
    size: int = 1
    """Columns of x that it takes: 1 for a scalar, more for a block of like values, one for each vehicle, say."""

    @property
    def range(self) -> str:
        """The range in words, with its unit."""
        return f"[{self.low:g}, {self.high:g}] {self.unit}".rstrip()


@dataclass(frozen=True, eq=False, repr=False)
class ScenarioSpace:
    """The parameters of a scenario in the order of x, and their distribution, the traffic model.

    Example:
        >>> import gymnasium as gym, rare_envs
        >>> space = gym.make("rare_envs/CarFollowing-v0").unwrapped.space
        >>> space.describe()
        'ego_speed [0, 45] m/s, lead_speed [0, 45] m/s, gap [1, 150] m'
        >>> space.named([20.0, 10.0, 30.0])
        {'ego_speed': 20.0, 'lead_speed': 10.0, 'gap': 30.0}
        >>> space.validate([20.0, 10.0, 300.0])
        Traceback (most recent call last):
        ...
        ValueError: gap = 300 is outside its range [1, 150] m; the parameters are ego_speed [0, 45] m/s, lead_speed [0, 45] m/s, gap [1, 150] m.
    """  # noqa: E501 (the example shows a whole message)

    parameters: Sequence[Parameter]
    """In the order of x."""
    base: Distribution
    """Distribution of x; the methods of the same name go to it."""
    names: tuple[str, ...] = field(init=False)
    """Names of the parameters."""
    units: tuple[str, ...] = field(init=False)
    """Their units."""
    sizes: tuple[int, ...] = field(init=False)
    """Columns of x that each takes."""
    low: FloatArray = field(init=False)
    """Lower bounds of the allowed ranges, one for each column of x, shape (d,)."""
    high: FloatArray = field(init=False)
    """Upper bounds, shape (d,)."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "parameters", tuple(self.parameters))
        for field_name, own in (("names", "name"), ("units", "unit"), ("sizes", "size")):
            object.__setattr__(self, field_name, tuple(getattr(p, own) for p in self.parameters))  # fields by name
        for name in ("low", "high"):
            ends = np.repeat([float(getattr(p, name)) for p in self.parameters], self.sizes)  # a field by its name
            ends.setflags(write=False)
            object.__setattr__(self, name, ends)

    @property
    def dim(self) -> int:
        """Number of columns of x, d."""
        return sum(self.sizes)

    @property
    def column_names(self) -> tuple[str, ...]:
        """Names of the columns of x; those of a block have their number in it, such as "speed[0]"."""
        return tuple(p.name if p.size == 1 else f"{p.name}[{k}]" for p in self.parameters for k in range(p.size))

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw independent scenarios from the traffic model, shape (n, d)."""
        return self.base.sample(n, rng)

    def log_prob(self, x: FloatArray) -> FloatArray:
        """Return the log density of the traffic model, (n, d) -> (n,)."""
        return self.base.log_prob(x)

    def to_standard_normal(self, x: FloatArray) -> FloatArray:
        """Map to standard normal space, (n, d) -> (n, d)."""
        return self.base.to_standard_normal(x)

    def from_standard_normal(self, u: FloatArray) -> FloatArray:
        """Map from standard normal space, (n, d) -> (n, d)."""
        return self.base.from_standard_normal(u)

    def named(self, x_row: ArrayLike) -> dict[str, Any]:
        """Return one scenario, shape (d,), as a mapping from names to numbers, or to arrays for blocks."""
        row = np.asarray(x_row, dtype=np.float64)
        if row.shape != (self.dim,):
            raise ValueError(f"Expected one scenario of shape ({self.dim},), got {row.shape}.")
        return {name: part if part.ndim else float(part) for name, part in self.columns(row).items()}

    def columns(self, x: FloatArray) -> dict[str, FloatArray]:
        """Return scenarios (n, d) as a mapping from names to columns: (n,), or (n, size) for blocks."""
        parts = ((p, x[..., at]) for p, at in zip(self.parameters, self._slices, strict=True))
        return {p.name: np.array(part[..., 0] if p.size == 1 else part) for p, part in parts}

    @cached_property
    def _slices(self) -> tuple[slice, ...]:
        """Columns of x of each parameter."""
        ends = np.cumsum(self.sizes).tolist()
        return tuple(slice(end - size, end) for size, end in zip(self.sizes, ends, strict=True))

    def describe(self) -> str:
        """Return all valid names with their ranges, in the order of x."""
        values = ("" if p.size == 1 else f" ({p.size} values)" for p in self.parameters)
        return ", ".join(f"{p.name}{many} {p.range}" for p, many in zip(self.parameters, values, strict=True))

    def __repr__(self) -> str:
        """Return one line; `describe` has the ranges."""
        n = len(self.names)
        names = ", ".join(self.names[:MOST_SHOWN]) + (", ..." if n > MOST_SHOWN else "")
        return f"<ScenarioSpace of {n} parameters in {self.dim} dimensions: {names}>"

    def validate(self, x: ArrayLike) -> FloatArray:
        """Check shape and ranges.

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
        for parameter, at in zip(self.parameters, self._slices, strict=True):
            self._check_range(parameter, points[:, at])
        return points

    def scenario_x(
        self,
        options: Mapping[str, Any] | None,
        n: int,
        rng: np.random.Generator,
        draw: Callable[[int, np.random.Generator], FloatArray] | None = None,
    ) -> FloatArray:
        """Return scenarios with some parameters given and the others drawn from the traffic model.

        The given values replace drawn ones: the rest is not conditioned on them.

        Args:
            options: Parameter names to scalars or (n,) arrays, blocks to (size,) or (n, size) arrays, or
                {"x": (d,) or (n, d)} for all of them; None draws everything.
            n: Number of scenarios.
            rng: Source of randomness.
            draw: Draws in place of `base.sample`, the same rows in a way of its own.

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
        columns = [self._column(name, value, n) for name, value in options.items()]
        points = np.array((draw or self.base.sample)(n, rng), dtype=np.float64)
        for at, column in columns:
            points[:, at] = column
        return self.validate(points)

    def _given_x(self, options: Mapping[str, Any], n: int) -> FloatArray:
        """Return the rows that options give as x, (n, d)."""
        others = sorted(str(name) for name in options if name != "x")
        if others:
            raise ValueError(f"x gives every parameter, so {', '.join(others)} cannot be given beside it.")
        points = self.validate(options["x"])
        if len(points) not in (1, n):
            raise ValueError(f"Expected x with 1 or {n} rows, one per scenario, got {len(points)}.")
        return np.repeat(points, n, axis=0) if len(points) == 1 else points

    def _column(self, name: str, value: Any, n: int) -> tuple[slice, FloatArray]:
        """Return where a parameter stands in x, and its values in n rows, (n, size) or (1, size)."""
        if name not in self.names:
            raise ValueError(
                f"Unknown scenario parameter {name!r}{did_you_mean(str(name), (*self.names, 'x'))}; "
                f"valid are {self.describe()}, or 'x' for all of them in this order."
            )
        j, values = self.names.index(name), _as_numbers(name, value)
        size = self.sizes[j]
        if size == 1:
            if values.shape not in ((), (1,), (n,)):
                raise ValueError(f"Expected {name} as one number or an array of shape ({n},), got {values.shape}.")
            column = np.atleast_1d(values)[:, None]
        else:
            if values.shape not in ((size,), (n, size)):
                raise ValueError(f"Expected {name} of shape ({size},) or ({n}, {size}), got {values.shape}.")
            column = np.atleast_2d(values)
        self._check_range(self.parameters[j], column)
        return self._slices[j], column

    def _check_range(self, parameter: Parameter, values: FloatArray) -> None:
        """Raise a ValueError unless the columns of a parameter, (n, size), are finite and in its range."""
        inside = (values >= parameter.low) & (values <= parameter.high) & np.isfinite(values)
        if not inside.all():
            i, k = np.argwhere(~inside)[0]
            row = f" (row {i})" if len(values) > 1 else ""
            which = f"[{k}]" if parameter.size > 1 else ""
            raise ValueError(
                f"{parameter.name}{which} = {values[i, k]:.10g}{row} is outside its range {parameter.range}; "
                f"the parameters are {self.describe()}."
            )


def _as_numbers(name: str, value: Any) -> FloatArray:
    """Return a float64 array of any shape; text, booleans and ragged lists are refused."""
    try:
        raw = np.asarray(value)
        if raw.dtype.kind not in "iuf":
            raise TypeError
        return raw.astype(np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"{name} must be a number or an array of numbers, got {value!r}.") from None
