"""FaultIsolation: calls an f that may raise, and finds the rows of a batch on which it does."""

from collections.abc import Callable
from typing import NoReturn, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from samplers.errors import EvaluationError, FinalError, OnError, describe_row, one_per_row
from samplers.problem import FloatArray

_T = TypeVar("_T")
Evaluate = Callable[[FloatArray], ArrayLike]
RowNumbers = NDArray[np.int64]
"""Numbers of rows of a batch."""
RowwiseCall = Callable[[RowNumbers], _T]
"""A function of some rows of a batch."""


class FaultIsolation:
    """f with a rule for rows on which it raises.

    With on_error "failure" or "bound" such rows get NaN, see `isolate_failing_rows`; with "raise" the error names the
    first of them. f always gets a copy of x, so that it may write on it.

    Args:
        evaluate: Maps points of shape (n, d) to values of shape (n,).
        on_error: What to do where f raises.

    Attributes:
        n_retried: RowNumbers that were simulated again to find those that raise.

    Example:
        >>> def f(x):
        ...     if (x > 1).any():
        ...         raise ArithmeticError("off the map")
        ...     return x[:, 0]
        >>> isolation = FaultIsolation(f, on_error="failure")
        >>> isolation.evaluate(np.array([[0.0], [2.0], [1.0], [0.5]]))
        array([0. , nan, 1. , 0.5])
        >>> isolation.n_retried
        6
    """

    def __init__(self, evaluate: Evaluate, on_error: OnError = "raise") -> None:
        self.n_retried = 0
        self._evaluate = _keep_error_settings(evaluate)
        self._on_error = on_error

    def evaluate(self, x: FloatArray) -> FloatArray:
        """Simulate the rows of x (n, d); return what f returned, with NaN for rows on which it raised.

        Raises:
            EvaluationError: If f does not return one number per row, or raises and on_error is "raise". A `FinalError`
                whose `final` is True is passed on unchanged, whatever on_error is.
        """
        return _join(self.attempt(lambda rows: one_per_row(self._evaluate(x[rows]), len(rows)), x, "f"))

    def attempt(self, call: RowwiseCall[_T], x: FloatArray, what: str) -> list[tuple[RowNumbers, _T | None]]:
        """Call a function of some rows of x (n, d) on all of them and, where it raises, on parts of them.

        Args:
            call: Gets numbers of rows; x[rows] is a copy.
            x: Points, for messages.
            what: Name of what raises, for messages.

        Returns:
            Its results with their rows; None for a row on which it raises alone.

        Raises:
            EvaluationError: See `evaluate`.
        """
        rows = np.arange(len(x))
        try:
            return [(rows, call(rows))]
        except Exception as error:
            if _is_final(error):
                raise
            if self._on_error == "raise":
                _raise_for_first_row(call, x, what, error)
        parts, n_retried = call_on_parts(call, rows)
        self.n_retried += n_retried
        return parts


def _keep_error_settings(evaluate: Evaluate) -> Evaluate:
    """Return f whose settings of NumPy's errors (`np.seterr`) are its own."""

    def call(x: FloatArray) -> ArrayLike:
        with np.errstate():
            return evaluate(x)

    return call


def isolate_failing_rows(evaluate: Evaluate, x: FloatArray) -> tuple[FloatArray, int]:
    """Return f (n,) of a batch x (n, d) on which `evaluate` raises, NaN for the rows that raise alone.

    Returns:
        f, and how many rows were simulated again, see `call_on_parts`.

    Raises:
        EvaluationError: If `evaluate` does not return one number per row.
    """
    parts, n_retried = call_on_parts(lambda rows: one_per_row(evaluate(x[rows]), len(rows)), np.arange(len(x)))
    return _join(parts), n_retried


def call_on_parts(call: RowwiseCall[_T], rows: RowNumbers) -> tuple[list[tuple[RowNumbers, _T | None]], int]:
    """Return the results of a function of rows that raises on all of them together.

    The batch is split in halves, and those that raise are split again, until the raising rows stand alone: at most
    2 k ceil(log2(n)) calls for k of them.

    Returns:
        Results with their rows, in order, None for a row on which it raises alone; and how many rows it was called
        with again.
    """
    if len(rows) == 1:
        return [(rows, None)], 0
    parts, n_retried = list[tuple[RowNumbers, _T | None]](), len(rows)
    for half in np.array_split(rows, 2):
        try:
            parts.append((half, call(half)))
        except Exception as error:
            if _is_final(error):
                raise
            found, again = call_on_parts(call, half)
            parts += found
            n_retried += again
    return parts, n_retried


def _join(parts: list[tuple[RowNumbers, FloatArray | None]]) -> FloatArray:
    """Return f (n,) of all rows, NaN where there is none."""
    return np.concatenate([np.array([np.nan]) if f is None else f for _, f in parts])


def _raise_for_first_row(call: RowwiseCall[_T], x: FloatArray, what: str, error: Exception) -> NoReturn:
    """Raise an EvaluationError for the first row that raises again, with the error of that row alone.

    One row is enough here: bisection finds it with log2(n) calls, half of those with which `call_on_parts` finds a row
    and the results of all others.
    """
    start, stop = 0, len(x)
    while stop - start > 1:
        middle = (start + stop) // 2
        start, stop = (start, middle) if _exception_of(call, np.arange(start, middle)) else (middle, stop)
    alone = _exception_of(call, np.arange(start, stop))  # the batch may have raised for another row
    if alone is None:
        raise EvaluationError(
            f"{what} raised on a batch of {len(x)} rows, not repeatably; {_describe(error)}"
        ) from error
    raise EvaluationError(f"{what} raised for {describe_row(x, start)}; {_describe(alone)}") from alone


def _exception_of(call: RowwiseCall[_T], rows: RowNumbers) -> Exception | None:
    """Return what a call with some rows raises, None if nothing."""
    try:
        call(rows)
    except Exception as error:
        return error
    return None


def _is_final(error: Exception) -> bool:
    """Return whether the error says that calling f again cannot help."""
    return isinstance(error, FinalError) and bool(error.final)


def _describe(error: Exception) -> str:
    """Return the type and the text of an error."""
    return f"{type(error).__name__}: {error}"
