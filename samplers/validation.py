"""Validation: checks of arguments, settings and what foreign code returns; errors say what was expected and given."""

from __future__ import annotations

import difflib
import math
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal, TypeGuard, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray


def is_number(value: object) -> TypeGuard[float]:
    """Return whether value is a real number (a bool is none) that a float can hold."""
    if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
        return False
    return not isinstance(value, int) or abs(value) <= sys.float_info.max


def is_whole(value: object, least: int) -> TypeGuard[int]:
    """Return whether value is a whole number (a bool is none) of at least `least`."""
    return not isinstance(value, bool) and isinstance(value, int | np.integer) and bool(value >= least)


def check_number(name: str, value: object, low: float, high: float) -> None:
    """Raise a ValueError unless value is a number between low and high, both excluded."""
    if not is_number(value) or not low < value < high:
        between = f"a number above {low:g}" if high == math.inf else f"a number between {low:g} and {high:g}"
        wanted = "a finite number" if low == -math.inf else between
        raise ValueError(f"Expected {name} to be {wanted}, got {value!r}.")


def check_whole(name: str, value: object, least: int) -> None:
    """Raise a ValueError unless value is a whole number of at least `least`."""
    if not is_whole(value, least):
        raise ValueError(f"Expected {name} to be a whole number of at least {least}, got {value!r}.")


def check_name(kind: str, name: object, valid: list[str]) -> None:
    """Raise a ValueError that suggests the nearest valid name unless `name` is one."""
    if isinstance(name, str) and name in valid:
        return
    near = difflib.get_close_matches(str(name), valid, n=1)
    hint = f" Did you mean {near[0]!r}?" if near else ""
    raise ValueError(f"Unknown {kind} {name!r}.{hint} Valid: {', '.join(valid)}.")


def check_setting(
    method: str, name: str, value: object, low: float, high: float, *, or_equal_high: bool = False
) -> None:
    """Raise a ValueError unless value is a number with low < value < high (or value = high, if that is allowed)."""
    if is_number(value) and (low < value < high or (or_equal_high and value == high)):
        return
    sign = "<=" if or_equal_high else "<"
    raise ValueError(f"{method}: expected a number {low:g} < {name} {sign} {high:g}, got {value!r}.")


def check_choice(method: str, name: str, value: object, choices: tuple[str, ...]) -> None:
    """Raise a ValueError unless value is one of the choices."""
    if not isinstance(value, str) or value not in choices:
        wanted = " or ".join(f'"{choice}"' for choice in choices)
        raise ValueError(f"{method}: expected {name} {wanted}, got {value!r}.")


def check_count(method: str, name: str, value: object, least: int) -> None:
    """Raise a ValueError unless value is a whole number of at least `least`."""
    if not is_whole(value, least):
        raise ValueError(f"{method}: expected {name} to be a whole number of at least {least}, got {value!r}.")


OnError = Literal["raise", "failure", "bound"]
"""Rows on which f raises or gives NaN: stop, count the row as failing, or count it so in p and the upper end only."""
ON_ERROR: tuple[str, ...] = get_args(OnError)


class EvaluationError(ValueError):
    """f raised, returned NaN or returned something that is not one number per row.

    Example:
        >>> import samplers
        >>> problem = samplers.FunctionProblem(lambda x: x, dim=2)
        >>> samplers.estimate(problem, "mc", seed=0, max_sim=100)
        Traceback (most recent call last):
            ...
        samplers.validation.EvaluationError: Expected f to return shape (100,), one value per row of x, got (100, 2). f gets a batch of points of shape (n, 2); pass vectorized=False for an f of one point.
    """  # noqa: E501 (the example shows a whole message)

    final = True


def one_per_row(outcomes: ArrayLike, n: int) -> NDArray[np.float64]:
    """Return the outcomes of foreign code as float64, shape (n,); an EvaluationError unless they are n real numbers."""
    if outcomes is None:
        raise EvaluationError(
            f"Expected f to return shape ({n},), one value per row of x, got None: f has no `return`."
        )
    try:
        if np.iscomplexobj(outcomes):
            raise TypeError("complex numbers have no order")
        f = np.asarray(outcomes, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise EvaluationError(
            f"Expected f to return shape ({n},), one number per row of x: {str(error).rstrip('.')}."
        ) from error
    if f.shape != (n,):
        raise EvaluationError(f"Expected f to return shape ({n},), one value per row of x, got {f.shape}.")
    return f


def describe_point(x: NDArray[np.float64]) -> str:
    """Return a point x (d,) in one line."""
    return np.array2string(x, precision=6, threshold=8, separator=", ", max_line_width=10**6)


@contextmanager
def needs_library(library: str, purpose: str) -> Iterator[None]:
    """Raise an ImportError that says what to install if an import in the block fails because a library is missing."""
    try:
        yield
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] != library:
            raise
        raise ImportError(f"{purpose} needs {library}: pip install {library}.", name=library) from None
