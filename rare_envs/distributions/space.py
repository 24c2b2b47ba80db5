"""Scenario spaces: parameters with names, units and ranges, and their distribution; `env.unwrapped.space` is one."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from html import escape
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from rare_envs.arrays import FloatArray
from rare_envs.plugins import did_you_mean


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
    """Lower end of the range."""
    high: float
    """Upper end of the range."""
    meaning: str
    """In words."""
    size: int = 1
    """Columns of x that it takes: 1 for a scalar, more for a block of like values, one for each vehicle, say."""


MOST_SHOWN = 8
"""Parameters that `repr` names."""


@dataclass(frozen=True, eq=False, repr=False)
class ScenarioSpace:
    """The parameters of a scenario in the order of x, and their base distribution.

    Attributes:
        names: Parameter names.
        units: Their units.
        low: Lower ends of the allowed ranges, one for each column of x, shape (d,).
        high: Upper ends, shape (d,).
        base: Distribution of x; the methods of the same name go to it.
        sizes: Columns of x that each parameter takes; by default one each.

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

    names: tuple[str, ...]
    units: tuple[str, ...]
    low: FloatArray
    high: FloatArray
    base: Distribution
    sizes: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "names", tuple(self.names))
        object.__setattr__(self, "units", tuple(self.units))
        object.__setattr__(self, "sizes", tuple(self.sizes) or (1,) * len(self.names))
        for name in ("low", "high"):
            bound = np.array(getattr(self, name), dtype=np.float64)  # a field by its name
            bound.setflags(write=False)
            object.__setattr__(self, name, bound)
        fits = len(self.names) == len(self.units) == len(self.sizes)
        if not (fits and self.low.shape == self.high.shape == (sum(self.sizes),)):
            raise ValueError(
                f"Expected as many names, units and bounds, got {len(self.names)} names, {len(self.units)} units, "
                f"sizes {self.sizes}, low {self.low.shape} and high {self.high.shape}."
            )

    @classmethod
    def of(cls, parameters: Sequence[Parameter], base: Distribution) -> ScenarioSpace:
        """Return the space of some parameters, in the order of x, with their distribution."""
        sizes = tuple(p.size for p in parameters)
        return cls(
            names=tuple(p.name for p in parameters),
            units=tuple(p.unit for p in parameters),
            low=np.repeat([p.low for p in parameters], sizes),
            high=np.repeat([p.high for p in parameters], sizes),
            base=base,
            sizes=sizes,
        )

    @property
    def dim(self) -> int:
        """Number of columns of x, d."""
        return sum(self.sizes)

    @property
    def column_names(self) -> tuple[str, ...]:
        """Names of the columns of x; those of a block have their number in it, such as "speed[0]"."""
        return tuple(
            name if size == 1 else f"{name}[{k}]"
            for name, size in zip(self.names, self.sizes, strict=True)
            for k in range(size)
        )

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw independent scenarios from the base distribution, shape (n, d)."""
        return self.base.sample(n, rng)

    def log_prob(self, x: FloatArray) -> FloatArray:
        """Return the log density of the base distribution, (n, d) -> (n,)."""
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
        return {name: float(part[0]) if size == 1 else part for name, size, part in self._parts(row)}

    def columns(self, x: FloatArray) -> dict[str, FloatArray]:
        """Return scenarios (n, d) as a mapping from names to columns: (n,), or (n, size) for blocks."""
        return {name: part[:, 0] if size == 1 else part for name, size, part in self._parts(x)}

    def _parts(self, x: FloatArray) -> list[tuple[str, int, FloatArray]]:
        """Return name, size and columns of each parameter."""
        parts = zip(self.names, self.sizes, self._slices, strict=True)
        return [(name, size, x[..., at].copy()) for name, size, at in parts]

    @cached_property
    def _slices(self) -> tuple[slice, ...]:
        """Columns of x of each parameter."""
        ends = np.cumsum(self.sizes).tolist()
        return tuple(slice(end - size, end) for size, end in zip(self.sizes, ends, strict=True))

    def describe(self) -> str:
        """Return all valid names with their ranges, in the order of x."""
        return ", ".join(
            f"{name} {self._range(j)}" if size == 1 else f"{name} ({size} values) {self._range(j)}"
            for j, (name, size) in enumerate(zip(self.names, self.sizes, strict=True))
        )

    def __repr__(self) -> str:
        """Return one line; `describe` has the ranges."""
        n = len(self.names)
        names = ", ".join(self.names[:MOST_SHOWN]) + (", ..." if n > MOST_SHOWN else "")
        return f"<ScenarioSpace of {n} parameters in {self.dim} dimensions: {names}>"

    def _repr_html_(self) -> str:
        """Return a table of the parameters for notebooks."""
        first = [at.start for at in self._slices]
        rows = "".join(
            f"<tr><th>{escape(name)}</th><td>{low:g} to {high:g}</td><td>{escape(unit)}</td><td>{size}</td></tr>"
            for name, unit, size, low, high in zip(
                self.names, self.units, self.sizes, self.low[first], self.high[first], strict=True
            )
        )
        header = "<tr><th>parameter</th><th>range</th><th>unit</th><th>values</th></tr>"
        return f"<table>{header}{rows}</table>"

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
        for j in range(len(self.names)):
            self._check_range(j, points[:, self._slices[j]])
        return points

    def scenario_x(
        self,
        options: Mapping[str, Any] | None,
        n: int,
        rng: np.random.Generator,
        draw: Callable[[int, np.random.Generator], FloatArray] | None = None,
    ) -> FloatArray:
        """Return scenarios with some parameters given and the others drawn from the base distribution.

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
        columns = {self._index(name): self._column(name, value, n) for name, value in options.items()}
        points = np.array((draw or self.base.sample)(n, rng), dtype=np.float64)
        for j, column in columns.items():
            points[:, self._slices[j]] = column
        return self.validate(points)

    def _given_x(self, options: Mapping[str, Any], n: int) -> FloatArray:
        others = sorted(str(name) for name in options if name != "x")
        if others:
            raise ValueError(f"x gives every parameter, so {', '.join(others)} cannot be given beside it.")
        points = self.validate(options["x"])
        if len(points) not in (1, n):
            raise ValueError(f"Expected x with 1 or {n} rows, one per scenario, got {len(points)}.")
        return np.repeat(points, n, axis=0) if len(points) == 1 else points

    def _column(self, name: str, value: Any, n: int) -> FloatArray:
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

    def _check_range(self, j: int, values: FloatArray) -> None:
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


def _as_numbers(name: str, value: Any) -> FloatArray:
    """Return a float64 array of any shape; text, booleans and ragged lists are refused."""
    try:
        raw = np.asarray(value)
        if raw.dtype.kind not in "iuf":
            raise TypeError
        return raw.astype(np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"{name} must be a number or an array of numbers, got {value!r}.") from None
