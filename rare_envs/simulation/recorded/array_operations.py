"""Operations of torch as NumPy writes them, which starts one in a third of the time.

Sums, products, quotients, comparisons and choices are rounded by both as IEEE 754 says. Roots, sines and the like are
not, so these stay torch's.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

_ELEMENTWISE = {
    "abs": "absolute",
    "add": "add",
    "__and__": "bitwise_and",
    "bitwise_and": "bitwise_and",
    "bitwise_not": "invert",
    "__or__": "bitwise_or",
    "bitwise_or": "bitwise_or",
    "div": "divide",
    "eq": "equal",
    "ge": "greater_equal",
    "gt": "greater",
    "le": "less_equal",
    "lt": "less",
    "maximum": "maximum",
    "minimum": "minimum",
    "mul": "multiply",
    "ne": "not_equal",
    "neg": "negative",
    "round": "rint",
    "square": "square",
    "sub": "subtract",
    "where": "where",
}
"""Operations of torch to functions of NumPy with the same arguments."""
_CLAMPS = ("clamp", "clamp_max", "clamp_min")
_BY_TORCH = ("asin", "atan", "cos", "sin", "sqrt", "tan")
_END = 2**63 - 1
"""Of a slice that has none."""


def _by_torch(name: str) -> Callable[[NDArray[Any]], NDArray[Any]]:
    """Return a function of torch as one of arrays; of cars that go straight on it is known."""
    compute_in_place: Callable[[Tensor], Tensor] = getattr(torch, f"{name}_")
    at_zero = compute_in_place(torch.zeros(1)).item()

    def compute(values: NDArray[Any]) -> NDArray[Any]:
        if at_zero and not np.count_nonzero(values):
            return fill_like(values, at_zero)
        found = values.copy()
        if at_zero or np.count_nonzero(values):
            compute_in_place(torch.from_numpy(found))
        return found

    return compute


def fill_like(values: NDArray[Any], number: Any) -> NDArray[Any]:
    """Return an array of one number, sooner than `np.full_like`.

    Example:
        >>> fill_like(np.zeros(2), 3.0).tolist()
        [3.0, 3.0]
    """
    filled = np.empty_like(values)
    filled[...] = number
    return filled


FUNCTIONS: dict[str, Any] = {
    **{name: getattr(np, name) for name in _ELEMENTWISE.values()},
    **{name: _by_torch(name) for name in _BY_TORCH},
    "any_along": np.logical_or.reduce,
    "concatenate": np.concatenate,
    "count_nonzero": np.count_nonzero,
    "fill_like": fill_like,
    "nonzero": np.nonzero,
}
"""What the texts of `write_operation` name."""
MAKING = frozenset((*_ELEMENTWISE, *_BY_TORCH, *_CLAMPS, "rsub"))
"""Operations whose result is a new array: no other name stands for a part of it."""
COPYING = frozenset(("any", "index", "nonzero_numpy"))
"""Operations with other results that are new arrays."""
NUMERIC = frozenset((*_ELEMENTWISE, *_CLAMPS, "full_like", "rsub"))
"""Operations with numbers among their arguments."""


def write_operation(name: str, args: Sequence[Any]) -> str | None:
    """Return an operation of torch as a text of Python with `FUNCTIONS`; None of one that is not known.

    Args:
        name: The operation's, without its overload.
        args: Its arguments, for tensors the names of arrays.

    Example:
        >>> write_operation("clamp", ("speed", None, "most")), write_operation("slice", ("x", 1, 1, 3))
        ('minimum(most, speed)', 'x[:, 1:3]')
    """
    match name, *args:
        case known, *_ if known in _ELEMENTWISE:
            return f"{_ELEMENTWISE[name]}({', '.join(map(str, args))})"
        case known, values if known in _BY_TORCH:
            return f"{name}({values})"
        case "rsub", values, other:
            return f"subtract({other}, {values})"
        case "clamp_min" | "clamp_max" | "clamp", values, *bounds:
            least, most = (None, *bounds) if name == "clamp_max" else (*bounds, None)[:2]
            text = values if least is None else f"maximum({least}, {values})"
            return text if most is None else f"minimum({most}, {text})"  # of two zeros NumPy takes the second
        case "any", values, int(axis):
            return f"any_along({values}, {axis})"
        case "stack", list(parts):
            return f"concatenate(({', '.join(parts)},)).reshape({len(parts)}, -1)"
        case "unbind", values, *axis:
            return f"{values}.swapaxes(0, {axis[0]})" if axis and axis[0] else values
        case "slice", values, int(axis), first, last, *step if axis >= 0 and not step:
            return f"{values}[{':, ' * axis}{first or ''}:{'' if last in (None, _END) else last}]"
        case "select", values, int(axis), int(place) if axis >= 0:
            return f"{values}[{':, ' * axis}{place}]"
        case "index", values, list(places):
            return f"{values}[{_write_places(places)}]"
        case "index_put_", values, list(places), new:
            return f"{values}[{_write_places(places)}] = {new}"
        case "nonzero_numpy", values:
            return f"nonzero({values})"
        case "view", values, list(sizes):
            return f"{values}.reshape({', '.join(map(str, sizes))})"
        case ("mT", values):
            return f"{values}.swapaxes(-1, -2)"
        case ("numpy_T", values):
            return f"{values}.T"
        case "expand_as", values, other:
            return f"fill_like({other}, {values})"
        case "zeros_like", values:
            return f"fill_like({values}, 0)"
        case "full_like", values, number:
            return f"fill_like({values}, {number})"
        case _:
            return None


def _write_places(places: Sequence[str | None]) -> str:
    return ", ".join(":" if place is None else place for place in places)
