"""Scenario spaces: parameters with names, units and ranges, and their distribution; `env.unwrapped.space` is one.

A distribution may have parameters of its own, in interpretable units: what sensitivities of p are stated for. A
mixture has weights, and for each component means, standard deviations and correlations of its coordinates; the box is
no parameter. Such a distribution offers them by two methods: `parameters(names)` lists them, and
`with_parameters(values)` returns the same distribution with other values of them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from html import escape
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import linear_sum_assignment

from rare_envs.distributions.coordinates import ClosingSpeed, CoordinateKind, Coordinates, FloatArray
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


RELATIVE_CHANGE = 0.1
"""Change of a positive parameter for which sensitivities are stated, as a share of its value."""
CORRELATION_CHANGE = 0.1
"""The same of a correlation."""


class DistributionParameter(NamedTuple):
    """One parameter of a distribution.

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


@runtime_checkable
class HasParameters(Protocol):
    """A distribution with parameters.

    Example:
        >>> from rare_envs.distributions import BetaDistribution, NoiseDistribution
        >>> isinstance(BetaDistribution([2.0], [2.0], [0.0], [1.0]), HasParameters)
        True
        >>> isinstance(NoiseDistribution(3), HasParameters)
        False
    """

    def parameters(self, names: Sequence[str] = (), like: object = None) -> tuple[DistributionParameter, ...]:
        """Return the parameters.

        Args:
            names: Of the columns of x, d of them; x1, x2, ... by default.
            like: Distribution of the same family whose numbering of components is followed.
        """

    def with_parameters(self, values: ArrayLike) -> Distribution:
        """Return the same distribution with other values of the parameters, in the order of `parameters()`."""


class MixtureArrays(NamedTuple):
    """Weights (K,), means (K, d) and covariances (K, d, d) of a mixture."""

    weights: FloatArray
    means: FloatArray
    covariances: FloatArray


def number_columns(dim: int) -> tuple[str, ...]:
    """Return names of columns: x1, x2, ..."""
    return tuple(f"x{j + 1}" for j in range(dim))


def list_mixture_parameters(
    mixture: MixtureArrays, coordinates: Coordinates, names: Sequence[str] = (), like: MixtureArrays | None = None
) -> tuple[DistributionParameter, ...]:
    """Return weights (of several components), means, standard deviations and correlations, component by component.

    The components are numbered as those of `like`, if it has as many.
    """
    if like is not None and len(like.weights) == len(mixture.weights):
        mixture = MixtureArrays(*(values[match_components(mixture, like)] for values in mixture))
    columns = tuple(names) or coordinates.names or number_columns(coordinates.dim)
    labels = [_name_coordinate(coordinates.kinds[j], columns[j]) for j in coordinates.columns]
    k = len(mixture.weights)
    found: list[DistributionParameter] = []
    if k > 1:
        found += [
            DistributionParameter(f"weight of component {c + 1}", float(w), RELATIVE_CHANGE * float(w), "10 %")
            for c, w in enumerate(mixture.weights)
        ]
    for c, (mean, covariance) in enumerate(zip(mixture.means, mixture.covariances, strict=True)):
        end = f" (component {c + 1})" if k > 1 else ""
        found += _list_component(mean, covariance, labels, coordinates.columns, end)
    return tuple(found)


def _name_coordinate(kind: CoordinateKind, column: str) -> str:
    """Return a coordinate in words; "closing to" a column is its `ClosingSpeed`."""
    if isinstance(kind, ClosingSpeed):
        return f"closing to {column}"
    return f"log {column}" if kind == "log" else column


def _list_component(
    mean: FloatArray, covariance: FloatArray, labels: Sequence[str], columns: Sequence[int], end: str
) -> list[DistributionParameter]:
    """Return means, standard deviations and correlations of one component."""
    sd = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(sd, sd)
    found = []
    for label, value, deviation, column in zip(labels, mean.tolist(), sd.tolist(), columns, strict=True):
        found.append(DistributionParameter(f"mean of {label}{end}", value, deviation, "1 sd", (column,)))
    for label, deviation, column in zip(labels, sd.tolist(), columns, strict=True):
        change = RELATIVE_CHANGE * deviation
        found.append(DistributionParameter(f"sd of {label}{end}", deviation, change, "10 %", (column,)))
    for i, j in ((later, earlier) for later in range(len(sd)) for earlier in range(later)):
        name, pair = f"correlation of {labels[j]} and {labels[i]}{end}", (columns[j], columns[i])
        change = CORRELATION_CHANGE
        found.append(DistributionParameter(name, float(correlation[i, j]), change, f"{change:g}", pair))
    return found


def set_mixture_parameters(mixture: MixtureArrays, values: ArrayLike) -> MixtureArrays:
    """Return the arrays of a mixture with other values of its parameters; weights are scaled to sum to 1."""
    given = np.asarray(values, dtype=np.float64)
    k, d = mixture.means.shape
    own = d + d + d * (d - 1) // 2
    n_weights = k if k > 1 else 0
    check_values(given, n_weights + k * own)
    weights = given[:n_weights] / given[:n_weights].sum() if n_weights else mixture.weights
    parts = given[n_weights:].reshape(k, own)
    covariances = np.empty((k, d, d))
    for c, part in enumerate(parts):
        correlation = np.eye(d)
        below = np.tril_indices(d, -1)
        correlation[below] = correlation[below[::-1]] = part[2 * d :]
        covariances[c] = correlation * np.outer(part[d : 2 * d], part[d : 2 * d])
    return MixtureArrays(weights, parts[:, :d].copy(), covariances)


def check_values(values: FloatArray, n: int) -> None:
    """Raise a ValueError unless there are n values."""
    if values.shape != (n,):
        raise ValueError(f"Expected {n} values, one for each parameter, got shape {values.shape}.")


def match_components(mixture: MixtureArrays, like: MixtureArrays) -> list[int]:
    """Return the components of a mixture in the numbering of another with as many.

    The assignment has the least sum of squared distances of means, standard deviations and logarithms of weights, in
    standard deviations of the other's components.
    """
    sd, other_sd = (np.sqrt(np.diagonal(each.covariances, axis1=1, axis2=2)) for each in (mixture, like))
    means = ((mixture.means[:, None] - like.means) / other_sd) ** 2
    spreads = np.log(sd[:, None] / other_sd) ** 2
    weights = np.log(mixture.weights[:, None] / like.weights) ** 2
    _, places = linear_sum_assignment(means.sum(axis=2) + spreads.sum(axis=2) + weights)
    return [int(component) for component in np.argsort(places)]


def arrays_of(distribution: object) -> MixtureArrays | None:
    """Return the arrays of a distribution that is a mixture; None for any other."""
    arrays = tuple(getattr(distribution, name, None) for name in MixtureArrays._fields)
    return None if any(values is None for values in arrays) else MixtureArrays(*(np.asarray(v) for v in arrays))
