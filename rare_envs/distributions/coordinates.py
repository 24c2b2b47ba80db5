"""Coordinates in which the parameters of a scenario are normal: plain, logarithmic, or a closing speed over a gap."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray: TypeAlias = NDArray[np.float64]
"""Double precision, in which statistics are computed."""
AnyArray: TypeAlias = NDArray[Any]
"""Observations and actions of any dtype."""


@dataclass(frozen=True)
class ClosingSpeed:
    """Coordinate of a speed ahead: y = (speed behind - speed ahead) / sqrt(gap between them) [sqrt(m)/s].

    y^2 / 2 is the deceleration that just avoids a collision with a vehicle that keeps its speed, for y > 0.

    Example:
        >>> ClosingSpeed(behind="ego_speed", gap="gap")
        ClosingSpeed(behind='ego_speed', gap='gap')
    """

    behind: str
    """Name of the column with the speed behind [m/s]."""
    gap: str
    """Name of the column with the gap from the one behind to the one ahead [m]."""


LEAST_DISTANCE = 1e-300
"""Of a point from an end at 0: one float, 5e-324, may vanish when divided by a standard deviation."""
CoordinateKind: TypeAlias = Literal["plain", "log"] | ClosingSpeed
"""Kind of the coordinate of a column of x: x itself, log x, or a closing speed."""


@dataclass(frozen=True, eq=False)
class Coordinates:
    """Coordinates y of points x in a box: one for each column of x, computed in an order of their own.

    Each coordinate depends on its own column and on columns that come earlier in the order, so the map is triangular:
    the determinant of its Jacobian is a product, and the range of a coordinate follows from the earlier columns.

    Args:
        low: Lower ends of the box of x, shape (d,), finite.
        high: Upper ends, shape (d,).
        kinds: Kind of the coordinate of each column of x, d of them.
        names: Names of the columns of x; needed where a coordinate or the order names one.
        order: Names of the columns in the order of the coordinates; the order of x by default.

    Raises:
        ValueError: The box is empty, a kind is unknown or names no column, a column in a logarithm or under a root is
            not positive, or a coordinate depends on a column that does not come earlier.

    Example:
        >>> closing = Coordinates(
        ...     low=[0.0, 0.0, 1.0],
        ...     high=[45.0, 45.0, 150.0],
        ...     kinds=("plain", ClosingSpeed("speed", "gap"), "log"),
        ...     names=("speed", "lead_speed", "gap"),
        ...     order=("speed", "gap", "lead_speed"),
        ... )
        >>> closing.to_coordinates([[20.0, 14.0, 9.0]]).round(4).tolist()  # speed, log 9, 6 / 3
        [[20.0, 2.1972, 2.0]]
    """

    low: FloatArray
    high: FloatArray
    kinds: tuple[CoordinateKind, ...]
    names: tuple[str, ...] = ()
    order: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name in ("low", "high"):
            object.__setattr__(self, name, as_finite(name, getattr(self, name)))  # a field by its name
            getattr(self, name).setflags(write=False)  # likewise
        for name in ("kinds", "names", "order"):
            object.__setattr__(self, name, tuple(getattr(self, name)))  # likewise
        _check_ends(self.low, self.high, len(self.kinds))
        _check_names(self.names, self.order, len(self.kinds))
        for j, kind in enumerate(self.kinds):
            self._check_kind(j, kind)

    @property
    def dim(self) -> int:
        """Number of columns d."""
        return len(self.kinds)

    @cached_property
    def columns(self) -> tuple[int, ...]:
        """Columns of x in the order of the coordinates."""
        return tuple(map(self.names.index, self.order)) if self.order else tuple(range(self.dim))

    @cached_property
    def key(self) -> tuple[object, ...]:
        """What tells coordinates apart: two of the same key are equal."""
        return (self.low.tobytes(), self.high.tobytes(), self.kinds, self.names, self.order)

    @cached_property
    def _sources(self) -> dict[int, tuple[int, int]]:
        """Columns of the speed behind and the gap, of each column that is a speed ahead."""
        closing = {j: kind for j, kind in enumerate(self.kinds) if isinstance(kind, ClosingSpeed)}
        return {j: (self.names.index(kind.behind), self.names.index(kind.gap)) for j, kind in closing.items()}

    def sign(self, j: int) -> float:
        """Return 1 where the coordinate of column j rises with x_j, -1 where it falls: for a closing speed."""
        return -1.0 if j in self._sources else 1.0

    def bounds(self, j: int, x: FloatArray) -> tuple[Any, Any]:
        """Return the ends of the coordinate of column j in rows x (n, d), of which the earlier columns are set.

        They are numbers, or (n,) for a closing speed.
        """
        if j in self._sources:
            behind, root = self._behind_and_root(j, x)
            return (behind - self.high[j]) / root, (behind - self.low[j]) / root
        if self.kinds[j] == "log":
            return np.log(self.low[j]), np.log(self.high[j])
        return self.low[j], self.high[j]

    def coordinate(self, j: int, x: FloatArray) -> FloatArray:
        """Return the coordinate of column j of rows x in the box, (n, d) -> (n,), within its range."""
        column = np.ascontiguousarray(x[:, j])
        if self.kinds[j] == "plain":
            return column
        if j in self._sources:
            behind, root = self._behind_and_root(j, x)
            return np.clip((behind - column) / root, *self.bounds(j, x))
        return np.clip(np.log(column), *self.bounds(j, x))

    def value(self, j: int, y: FloatArray, x: FloatArray) -> FloatArray:
        """Return column j of x from its coordinate y (n,) and rows x (n, d) of which the earlier columns are set.

        Strictly inside the box, which rounding may leave by a float.
        """
        return move_inside(self.unbounded_value(j, y, x), self.low[j], self.high[j])

    def unbounded_value(self, j: int, y: FloatArray, x: FloatArray) -> FloatArray:
        """Return the same wherever it is, inside the box or not."""
        if j in self._sources:
            behind, root = self._behind_and_root(j, x)
            return behind - y * root
        return np.exp(y) if self.kinds[j] == "log" else y

    def is_log(self, j: int) -> bool:
        """Return whether the coordinate of column j is its logarithm; any other is linear in the column."""
        return self.kinds[j] == "log"

    def linear(self, j: int, mean: FloatArray, scale: FloatArray, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return mean and scale of column j, or of its logarithm, (K, n) each, from those of its coordinate.

        The scale may be (K, 1); of rows x (n, d) the earlier columns are set.
        """
        if j in self._sources:
            behind, root = self._behind_and_root(j, x)
            return behind - mean * root, scale * root
        return mean, np.broadcast_to(scale, mean.shape)

    def log_jacobian(self, x: FloatArray) -> FloatArray:
        """Return log |det dy/dx| at rows x in the box, (n, d) -> (n,): -log x of a logarithm, -log(gap) / 2 of a speed.

        A density of x is that of y plus this, in logarithms.
        """
        return np.asarray(sum((self.log_slope(j, x) for j in range(self.dim)), np.zeros(len(x))))

    def log_slope(self, j: int, x: FloatArray) -> FloatArray:
        """Return log |dy/dx| of the coordinate of column j alone, (n, d) -> (n,); the other columns are held."""
        if self.kinds[j] == "log":
            return -self.coordinate(j, x)
        if j in self._sources:
            return np.asarray(-0.5 * np.log(np.ascontiguousarray(x[:, self._sources[j][1]])))
        return np.zeros(len(x))

    def to_coordinates(self, x: ArrayLike) -> FloatArray:
        """Return the coordinates of points in the box, (n, d) -> (n, d), in their order."""
        inner = self.interior(np.asarray(x, dtype=np.float64))
        return np.stack([self.coordinate(j, inner) for j in self.columns], axis=1)

    def interior(self, x: FloatArray) -> FloatArray:
        """Return points with those on a face moved off it, by one float."""
        return move_inside(x, self.low, self.high)

    def to_dict(self) -> dict[str, Any]:
        """Return the entries of a base file: `low`, `high` and `coordinates`, and `names` and `order` where given."""
        box = {"low": self.low.tolist(), "high": self.high.tolist()}
        # fields by name
        texts = {name: list(getattr(self, name)) for name in ("names", "order") if getattr(self, name)}
        kinds = [
            {"closing_behind": kind.behind, "gap": kind.gap} if isinstance(kind, ClosingSpeed) else kind
            for kind in self.kinds
        ]
        return {**box, "coordinates": kinds, **texts}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Coordinates:
        """Return the coordinates that `to_dict` describes.

        `coordinates` lists "plain", "log" or {"closing_behind": column, "gap": column}, in the order of x; plain ones
        may be left out.

        Raises:
            ValueError: An entry is not valid.
        """
        for name in ("low", "high"):
            if name not in data:
                raise ValueError(f"Missing {name}; needed are low and high.")
        kinds, order = _read_kinds(data), _read_names("order", data)
        # A scenario may give one name to several columns; names matter only where something refers to a column.
        named = order or any(isinstance(kind, ClosingSpeed) for kind in kinds)
        return cls(data["low"], data["high"], kinds, _read_names("names", data) if named else (), order)

    def _behind_and_root(self, j: int, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return speed behind and square root of the gap of a speed ahead, (n,) each."""
        behind, gap = self._sources[j]
        return np.ascontiguousarray(x[:, behind]), np.sqrt(np.ascontiguousarray(x[:, gap]))

    def _check_kind(self, j: int, kind: object) -> None:
        what = self.names[j] if self.names else f"column {j}"
        if isinstance(kind, ClosingSpeed):
            for source in (kind.behind, kind.gap):
                self._check_source(j, source)
            if kind.behind == kind.gap:
                raise ValueError(f"The closing speed of {what} needs two columns, got {kind.gap!r} twice.")
            if not self.low[self.names.index(kind.gap)] > 0.0:
                raise ValueError(f"The gap {kind.gap!r} of the closing speed of {what} needs a positive low.")
        elif kind == "log":
            if not self.low[j] > 0.0:
                raise ValueError(f"The logarithm of {what} needs a positive low, got {self.low[j]:g}.")
        elif kind != "plain":
            raise ValueError(f'Unknown coordinate {kind!r} of {what}; known are "plain", "log" and a closing speed.')

    def _check_source(self, j: int, source: str) -> None:
        """Check that a column which another's coordinate depends on exists and comes earlier."""
        if source not in self.names:
            known = ", ".join(self.names) or "none, as names are missing"
            raise ValueError(f"The closing speed of column {j} names no column {source!r}; columns are {known}.")
        order = [self.names[column] for column in self.columns]
        if order.index(source) >= order.index(self.names[j]):
            raise ValueError(
                f"The closing speed of {self.names[j]} depends on {source}, which must come earlier in order; "
                f"order is {', '.join(order)}."
            )


def as_finite(name: str, values: ArrayLike) -> FloatArray:
    """Return a copy as finite float64."""
    try:
        array = np.array(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} must be an array of numbers: {error}.") from None
    if not np.isfinite(array).all():
        raise ValueError(f"{name} must be finite.")
    return array


def move_inside(values: FloatArray, low: Any, high: Any) -> FloatArray:
    """Return values in [low, high] with those at an end moved off it, by one float, from 0 by `LEAST_DISTANCE`."""
    find = _inner_ends_of_box if isinstance(low, float) and isinstance(high, float) else _inner_ends
    inner_low, inner_high = find(low, high)
    return np.asarray(np.minimum(np.maximum(values, inner_low), inner_high))


def _inner_ends(low: Any, high: Any) -> tuple[Any, Any]:
    """Return the least and the largest value inside [low, high]."""
    inner_low = np.where(low == 0.0, LEAST_DISTANCE, np.nextafter(low, high))
    return inner_low, np.where(high == 0.0, -LEAST_DISTANCE, np.nextafter(high, low))


_inner_ends_of_box = lru_cache(maxsize=1024)(_inner_ends)
"""The same for two numbers, the ends of a column's box, which are asked for with every batch."""


def _check_ends(low: FloatArray, high: FloatArray, d: int) -> None:
    for name, bound in (("low", low), ("high", high)):
        if bound.shape != (d,):
            raise ValueError(f"Expected {name} of shape {(d,)}, one for each column, got {bound.shape}.")
    if (low >= high).any():
        j = int(np.argmax(low >= high))
        raise ValueError(f"low must be below high, got [{low[j]:g}, {high[j]:g}] at coordinate {j}.")


def _check_names(names: Sequence[str], order: Sequence[str], d: int) -> None:
    if names and (len(names) != d or len(set(names)) != d):
        raise ValueError(f"Expected {d} different names, one for each column, got {', '.join(names)}.")
    if order and sorted(order) != sorted(names):
        raise ValueError(
            f"order must have each of the columns {', '.join(names) or '(names are missing)'} once, "
            f"got {', '.join(order)}."
        )


def _read_kinds(data: Mapping[str, Any]) -> tuple[CoordinateKind, ...]:
    kinds = data.get("coordinates", ["plain"] * as_finite("low", data["low"]).size)
    if not isinstance(kinds, list | tuple):
        raise ValueError(f"Expected coordinates as a list, one for each column, got {kinds!r}.")
    return tuple(map(_read_kind, kinds))


def _read_kind(kind: Any) -> CoordinateKind:
    if isinstance(kind, Mapping):
        if set(kind) == {"closing_behind", "gap"} and all(isinstance(column, str) for column in kind.values()):
            return ClosingSpeed(kind["closing_behind"], kind["gap"])
    elif kind == "plain" or kind == "log":
        return "log" if kind == "log" else "plain"
    raise ValueError(
        f'Unknown coordinate {kind!r}; known are "plain", "log" and {{"closing_behind": column, "gap": column}}.'
    )


def _read_names(key: str, data: Mapping[str, Any]) -> tuple[str, ...]:
    names = data.get(key) or ()
    if not isinstance(names, list | tuple) or not all(isinstance(name, str) for name in names):
        raise ValueError(f"Expected {key} as a list of names of columns, got {names!r}.")
    return tuple(names)
