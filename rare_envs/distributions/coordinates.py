"""Coordinates in which the parameters of a scenario are normal: plain, logarithmic, or a closing speed over a gap."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from numbers import Real
from typing import Any, Literal, NamedTuple, TypeAlias

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
LEAST_RANGE = 0.01
"""Least range that a difference leaves a column, over its widest."""
CoordinateKind: TypeAlias = Literal["plain", "log"] | ClosingSpeed
"""Kind of the coordinate of a column of x: x itself, log x, or a closing speed."""


class Difference(NamedTuple):
    """A range of the difference of two columns, which cuts the range of the later one in the order.

    Example:
        >>> Difference("speed", "loss", 1.0, 45.0).least  # a lead that brakes keeps 1 m/s or more
        1.0
    """

    column: str
    """The later one, plain or in logarithms."""
    earlier: str
    least: float
    most: float
    """column - earlier is from least to most."""

    def range_in(self, column: Callable[[str], Any]) -> tuple[Any, Any]:
        """Return the ends of the later column, of what returns the values of another, (n,)."""
        other = column(self.earlier)
        return other + self.least, other + self.most


class RoomToBrake(NamedTuple):
    """Room behind a vehicle ahead for who follows it: its hardest braking avoids a contact if the other keeps speed.

    column + beside >= least + max(behind - ahead, 0)^2 / (2 braking) cuts the range of a gap, plain or in logarithms.

    Example:
        >>> room = RoomToBrake("lead_gap", "cut_in_gap", "ego_speed", "lead_speed", least=-4.0, braking=8.0)
        >>> start = {"cut_in_gap": -8.0, "ego_speed": 20.0, "lead_speed": 12.0}  # a cutter of 5 m beside the ego
        >>> float(room.range_in(start.get)[0])  # to its lead, which is 1 + 4 m ahead of the ego
        8.0
    """

    column: str
    beside: str
    behind: str
    ahead: str
    least: float
    braking: float

    def range_in(self, column: Callable[[str], Any]) -> tuple[Any, Any]:
        """Return the ends of the gap, of what returns the values of another column, (n,)."""
        closing = np.maximum(column(self.behind) - column(self.ahead), 0.0)
        return self.least - column(self.beside) + closing * closing / (2.0 * self.braking), np.inf


def _read_cut(cut: Any) -> Difference | RoomToBrake:
    """Return a cut from its names of columns and two numbers, as files hold it."""
    names, ends = (list(cut[:-2]), list(cut[-2:])) if isinstance(cut, list | tuple) else ([], [])
    kind: Any = {2: Difference, 4: RoomToBrake}.get(len(names))
    numbers = not any(isinstance(end, bool) or not isinstance(end, Real) or math.isnan(end) for end in ends)
    if kind is None or not (numbers and all(isinstance(name, str) for name in names)):
        wanted = " or ".join(f"({', '.join(each._fields)})" for each in (Difference, RoomToBrake))
        raise ValueError(f"Expected each cut of within as {wanted}, names and numbers, got {cut!r}.")
    if kind is RoomToBrake and ends[1] <= 0.0:
        raise ValueError(f"Expected braking > 0 in within, got {ends[1]!r}.")
    found: Difference | RoomToBrake = kind(*cut)
    return found


@dataclass(frozen=True, eq=False)
class Coordinates:
    """Coordinates y of points x in a box: one for each column of x, computed in an order of their own.

    Each coordinate depends on its own column and on columns that come earlier in the order, so the map is triangular:
    the determinant of its Jacobian is a product, and the range of a coordinate follows from the earlier columns.

    Args:
        low: Lower bounds of the box of x, shape (d,), finite.
        high: Upper bounds, shape (d,).
        kinds: Kind of the coordinate of each column of x, d of them; plain ones by default.
        names: Names of the columns of x; needed where a coordinate or the order names one.
        order: Names of the columns in the order of the coordinates; the order of x by default.
        within: What cuts ranges by earlier columns, see `Difference` and `RoomToBrake`; nothing by default.
        origins: What is subtracted from each column whose logarithm is its coordinate, d of them; 0 by default.

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
    kinds: tuple[CoordinateKind, ...] = ()
    names: tuple[str, ...] = ()
    order: tuple[str, ...] = ()
    within: tuple[Difference | RoomToBrake, ...] = ()
    origins: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        freeze_arrays(self, "low", "high")
        object.__setattr__(self, "kinds", tuple(self.kinds) or ("plain",) * self.low.size)
        object.__setattr__(self, "origins", tuple(self.origins) or (0.0,) * self.low.size)
        for name in ("names", "order"):
            texts = getattr(self, name)  # a field by its name
            if not isinstance(texts, list | tuple) or not all(isinstance(text, str) for text in texts):
                raise ValueError(f"Expected {name} as a list of names of columns, got {texts!r}.")
            object.__setattr__(self, name, tuple(texts))
        self._check_columns()
        for j, kind in enumerate(self.kinds):
            self._check_kind(self.names[j] if self.names else f"column {j}", j, kind)
        if not isinstance(self.within, list | tuple):
            raise ValueError(f"Expected within as a list of cuts, got {self.within!r}.")
        object.__setattr__(self, "within", tuple(map(_read_cut, self.within)))
        self._check_within()

    @property
    def dim(self) -> int:
        """Number of columns d."""
        return len(self.kinds)

    @cached_property
    def columns(self) -> tuple[int, ...]:
        """Columns of x in the order of the coordinates."""
        return tuple(map(self.names.index, self.order)) if self.order else tuple(range(self.dim))

    @cached_property
    def ends(self) -> tuple[FloatArray, FloatArray]:
        """Ends of the columns, (d,) each: of the box, less where a difference leaves a later column hardly any range.

        All probability of a range that vanishes is at a point, where the density would have no bound.
        """
        low, high = self.low.copy(), self.high.copy()
        for each in (cut for cut in self.within if isinstance(cut, Difference)):
            later, earlier = self.names.index(each.column), self.names.index(each.earlier)
            least = LEAST_RANGE * min(self.high[later] - self.low[later], each.most - each.least)
            high[earlier] = min(high[earlier], self.high[later] - each.least - least)
            low[earlier] = max(low[earlier], self.low[later] - each.most + least)
        return low, high

    def line(self, j: int, x: FloatArray) -> tuple[Any, Any]:
        """Return shift and slope, numbers or (n,), of column j (or of its logarithm) as shift + slope y in rows x."""
        kind = self.kinds[j]
        if not isinstance(kind, ClosingSpeed):
            return 0.0, 1.0
        behind, gap = (np.ascontiguousarray(x[:, self.names.index(name)]) for name in (kind.behind, kind.gap))
        return behind, -np.sqrt(gap)

    def rises(self, j: int) -> bool:
        """Return whether the coordinate of column j rises with it; a closing speed falls."""
        return not isinstance(self.kinds[j], ClosingSpeed)

    def is_log(self, j: int) -> bool:
        """Return whether the coordinate of column j is its logarithm; any other is linear in the column."""
        return self.kinds[j] == "log"

    def range_of(self, j: int, x: FloatArray) -> tuple[Any, Any]:
        """Return the ends, numbers or (n,), of column j itself in rows x whose earlier columns are set."""
        ends = self.ends[0][j], self.ends[1][j]
        for each in self.within:
            if self.names[j] == each.column:
                low, high = each.range_in(lambda name: np.ascontiguousarray(x[:, self.names.index(name)]))
                ends = np.maximum(ends[0], low), np.minimum(ends[1], high)
        return ends

    def bounds(self, j: int, x: FloatArray) -> tuple[Any, Any]:
        """Return the ends, numbers or (n,), of the coordinate of column j in rows x whose earlier columns are set."""
        ends = self.range_of(j, x)
        if self.rises(j):
            origin = self.origins[j]
            return (np.log(ends[0] - origin), np.log(ends[1] - origin)) if self.is_log(j) else ends
        shift, slope = self.line(j, x)
        return (ends[1] - shift) / slope, (ends[0] - shift) / slope

    def contains(self, x: FloatArray) -> NDArray[np.bool_]:
        """Return which columns of points are in their ranges, (n, d) -> (n, d)."""
        inside = (x >= self.ends[0]) & (x <= self.ends[1])
        for j in {self.names.index(each.column) for each in self.within}:
            low, high = self.range_of(j, x)
            inside[:, j] = (x[:, j] >= low) & (x[:, j] <= high)
        return inside

    def coordinate(self, j: int, x: FloatArray) -> FloatArray:
        """Return the coordinate of column j of rows x in the box, (n, d) -> (n,), up to rounding in its bounds."""
        column = np.ascontiguousarray(x[:, j])
        if self.rises(j):
            return np.log(column - self.origins[j]) if self.is_log(j) else column
        shift, slope = self.line(j, x)
        return np.asarray((column - shift) / slope)

    def value(self, j: int, y: FloatArray, x: FloatArray) -> FloatArray:
        """Return column j of x, inside the box or not, from y (n,) and rows x whose earlier columns are set."""
        if self.rises(j):
            return np.exp(y) + self.origins[j] if self.is_log(j) else y
        shift, slope = self.line(j, x)
        return np.asarray(shift + slope * y)

    def log_slope(self, j: int, x: FloatArray) -> FloatArray | float:
        """Return log |dy/dx| of the coordinate of column j alone, (n,) or 0; the other columns are held."""
        if self.rises(j):
            return -np.log(np.ascontiguousarray(x[:, j]) - self.origins[j]) if self.is_log(j) else 0.0
        return np.asarray(-np.log(-self.line(j, x)[1]))

    def log_jacobian(self, x: FloatArray) -> FloatArray:
        """Return log |det dy/dx| at rows x in the box, (n, d) -> (n,): what log p(x) exceeds log p(y) by."""
        return np.asarray(sum((self.log_slope(j, x) for j in range(self.dim)), np.zeros(len(x))))

    def to_coordinates(self, x: ArrayLike) -> FloatArray:
        """Return the coordinates of points in the box, (n, d) -> (n, d), in their order."""
        inner = self.interior(np.asarray(x, dtype=np.float64))
        return np.stack([np.clip(self.coordinate(j, inner), *self.bounds(j, inner)) for j in self.columns], axis=1)

    def interior(self, x: FloatArray) -> FloatArray:
        """Return points with those on a face moved off it, by one float."""
        return move_inside(x, *self.ends)

    def to_dict(self) -> dict[str, Any]:
        """Return the entries of a base file: `low` and `high`, and what is not as by default."""
        kinds: list[Any] = [
            {"closing_behind": kind.behind, "gap": kind.gap} if isinstance(kind, ClosingSpeed) else kind
            for kind in self.kinds
        ]
        within = [list(each) for each in self.within]
        origins = list(self.origins) if any(self.origins) else []
        other: dict[str, list[Any]] = {
            "names": list(self.names),
            "order": list(self.order),
            "within": within,
            "origins": origins,
        }
        found: dict[str, Any] = {key: value for key, value in other.items() if value}
        if found or kinds != ["plain"] * self.dim:
            found = {"coordinates": kinds, **found}
        return {"low": self.low.tolist(), "high": self.high.tolist(), **found}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Coordinates:
        """Return the coordinates that `to_dict` describes.

        `coordinates` lists "plain", "log" or {"closing_behind": column, "gap": column}, in the order of x; plain ones
        may be left out.

        Raises:
            ValueError: An entry is not valid.
        """
        low, high = pick_fields(data, ("low", "high"))
        kinds, order = data.get("coordinates") or (), data.get("order") or ()
        if not isinstance(kinds, list | tuple):
            raise ValueError(f"Expected coordinates as a list, one for each column, got {kinds!r}.")
        read = tuple(
            ClosingSpeed(kind["closing_behind"], kind["gap"])
            if isinstance(kind, Mapping) and set(kind) == {"closing_behind", "gap"}
            else kind
            for kind in kinds
        )
        # A scenario may give one name to several columns; names matter only where something refers to a column.
        within = data.get("within") or ()
        named = order or within or any(isinstance(kind, ClosingSpeed) for kind in read)
        return cls(low, high, read, data.get("names") or () if named else (), order, within, data.get("origins") or ())

    def _check_columns(self) -> None:
        """Raise a ValueError unless box, names and order fit d columns."""
        d = self.dim
        for name, bound in (("low", self.low), ("high", self.high)):
            if bound.shape != (d,):
                raise ValueError(f"Expected {name} of shape {(d,)}, one for each column, got {bound.shape}.")
        if (self.low >= self.high).any():
            j = int(np.argmax(self.low >= self.high))
            raise ValueError(f"low must be below high, got [{self.low[j]:g}, {self.high[j]:g}] at coordinate {j}.")
        if len(self.origins) != d:
            raise ValueError(f"Expected origins of {d} columns, got {self.origins}.")
        if self.names and len(set(self.names)) != d:
            raise ValueError(f"Expected {d} different names, one for each column, got {', '.join(self.names)}.")
        if self.order and sorted(self.order) != sorted(self.names):
            raise ValueError(
                f"order must have each of the columns {', '.join(self.names) or '(names are missing)'} once, "
                f"got {', '.join(self.order)}."
            )

    def _check_within(self) -> None:
        """Raise a ValueError unless ranges are cut by columns earlier in the order, and leave each column a range."""
        order = [self.names[j] for j in self.columns] if self.names else []
        for each in self.within:
            last: tuple[str, ...] = each[1:2] if isinstance(each, Difference) else each[1:4]
            known = order[: order.index(each.column)] if each.column in order else []
            if not {*last} <= {*known} or isinstance(self.kinds[self.names.index(each.column)], ClosingSpeed):
                raise ValueError(f"Expected within of a column after {', '.join(last)} in order, got {each.column!r}.")
            if isinstance(each, Difference) and not each.least < each.most:
                raise ValueError(f"Expected a range of {each.column} - {each.earlier}, got {each.least}, {each.most}.")
        low, high = self.ends[0].copy(), self.ends[1]
        for each in (cut for cut in self.within if isinstance(cut, RoomToBrake)):
            ends = {name: (high if name == each.behind else low)[self.names.index(name)] for name in each[1:4]}
            j = self.names.index(each.column)
            low[j] = max(low[j], each.range_in(ends.__getitem__)[0])
        if (low >= high).any():
            j = int(np.argmax(low >= high))
            raise ValueError(f"within leaves {self.names[j]} no range: from {low[j]:g} to {high[j]:g}.")

    def _check_kind(self, what: str, j: int, kind: object) -> None:
        """Raise a ValueError unless the kind of column j, `what` in messages, is known and fits the others."""
        positive = j
        if isinstance(kind, ClosingSpeed):
            before = [self.names[column] for column in self.columns[: self.columns.index(j)]] if self.names else []
            for source in (kind.behind, kind.gap):
                if source not in self.names:
                    known = ", ".join(self.names) or "none, as names are missing"
                    raise ValueError(f"The closing speed of {what} names no column {source!r}; columns are {known}.")
                if source not in before:
                    raise ValueError(
                        f"The closing speed of {what} depends on {source}, which must come earlier in order; "
                        f"order is {', '.join(self.names[column] for column in self.columns)}."
                    )
            positive = self.names.index(kind.gap)
        elif kind not in ("plain", "log"):
            raise ValueError(
                f'Unknown coordinate {kind!r} of {what}; known are "plain", "log" and '
                '{"closing_behind": column, "gap": column}.'
            )
        origin = 0.0 if isinstance(kind, ClosingSpeed) else self.origins[j]
        if kind != "plain" and not self.low[positive] > origin:
            column = self.names[positive] if self.names else "its column"
            raise ValueError(f"The coordinate of {what} needs a positive low of {column}, got {self.low[positive]:g}.")


def as_finite(name: str, values: ArrayLike) -> FloatArray:
    """Return a copy as finite float64."""
    try:
        array = np.array(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} must be an array of numbers: {error}.") from None
    if not np.isfinite(array).all():
        raise ValueError(f"{name} must be finite.")
    return array


def read_rows(name: str, points: ArrayLike, dim: int) -> FloatArray:
    """Return points as float64 (n, d), if they have that shape."""
    array = np.asarray(points, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != dim:
        hint = "; add a batch axis" if array.shape == (dim,) else ""
        raise ValueError(f"Expected {name} of shape (n, {dim}), got {array.shape}{hint}.")
    return array


def freeze_arrays(owner: object, *names: str) -> None:
    """Make fields of a frozen dataclass finite float64 arrays that cannot be written."""
    for name in names:
        array = as_finite(name, getattr(owner, name))  # a field by its name
        array.setflags(write=False)
        object.__setattr__(owner, name, array)


def pick_fields(data: Mapping[str, Any], names: tuple[str, ...]) -> list[Any]:
    """Return the entries of a file with these names."""
    missing = [name for name in names if name not in data]
    if missing:
        raise ValueError(f"Missing {', '.join(missing)}; needed are {', '.join(names)}.")
    return [data[name] for name in names]


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
