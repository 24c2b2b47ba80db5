"""FaultIsolation: calls an f that may raise, and finds the rows of a batch on which it does."""

from collections.abc import Callable
from typing import NoReturn

import numpy as np
from numpy.typing import ArrayLike

from samplers.errors import EvaluationError, FinalError, OnError, describe_row, one_per_row
from samplers.problem import FloatArray

Evaluate = Callable[[FloatArray], ArrayLike]


class FaultIsolation:
    """f with a rule for rows on which it raises.

    With on_error "failure" or "bound" such rows get NaN, see `isolate_failing_rows`; with "raise" the error names the
    first of them. f always gets a copy of x, so that it may write on it.

    Args:
        evaluate: Maps points of shape (n, d) to values of shape (n,).
        on_error: What to do where f raises.

    Attributes:
        n_retried: Rows that were simulated again to find those that raise.

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

    def evaluate(self, x: FloatArray) -> ArrayLike:
        """Simulate the rows of x (n, d); return what f returned, with NaN for rows on which it raised.

        Raises:
            EvaluationError: If f raises and on_error is "raise". A `FinalError` whose `final` is True is passed on
                unchanged, whatever on_error is.
        """
        try:
            return self._evaluate(x.copy())
        except Exception as error:
            if _is_final(error):
                raise
            if self._on_error == "raise":
                _raise_for_first_row(self._evaluate, x, error)
        f, n_retried = isolate_failing_rows(self._evaluate, x)
        self.n_retried += n_retried
        return f


def _keep_error_settings(evaluate: Evaluate) -> Evaluate:
    """Return f whose settings of NumPy's errors (`np.seterr`) are its own."""

    def call(x: FloatArray) -> ArrayLike:
        with np.errstate():
            return evaluate(x)

    return call


def isolate_failing_rows(evaluate: Evaluate, x: FloatArray) -> tuple[FloatArray, int]:
    """Return f (n,) of a batch x (n, d) on which `evaluate` raises, NaN for the rows that raise alone.

    The batch is split in halves, and those that raise are split again, until the raising rows stand alone: at most
    2 k ceil(log2(n)) calls for k of them.

    Returns:
        f, and how many rows were simulated again.

    Raises:
        EvaluationError: If `evaluate` does not return one number per row.
    """
    if len(x) == 1:
        return np.array([np.nan]), 0
    parts, n_retried = [], len(x)
    for half in np.array_split(x, 2):
        try:
            f, again = one_per_row(evaluate(half.copy()), len(half)), 0
        except Exception as error:
            if _is_final(error):
                raise
            f, again = isolate_failing_rows(evaluate, half)
        parts.append(f)
        n_retried += again
    return np.concatenate(parts), n_retried


def _raise_for_first_row(evaluate: Evaluate, x: FloatArray, error: Exception) -> NoReturn:
    """Raise an EvaluationError for the first row that raises again, with the error of that row alone.

    One row is enough here: bisection finds it with log2(n) calls, half of those with which `isolate_failing_rows`
    finds a row and the outcomes of all others.
    """
    start, stop = 0, len(x)
    while stop - start > 1:
        middle = (start + stop) // 2
        start, stop = (start, middle) if _exception_of(evaluate, x[start:middle]) else (middle, stop)
    alone = _exception_of(evaluate, x[start:stop])  # the batch may have raised for another row
    if alone is None:
        raise EvaluationError(f"f raised on a batch of {len(x)} rows, not repeatably; {_describe(error)}") from error
    raise EvaluationError(f"f raised for {describe_row(x, start)}; {_describe(alone)}") from alone


def _exception_of(evaluate: Evaluate, x: FloatArray) -> Exception | None:
    """Return what f raises for the rows of x, None if nothing."""
    try:
        evaluate(x.copy())
    except Exception as error:
        return error
    return None


def _is_final(error: Exception) -> bool:
    """Return whether the error says that calling f again cannot help."""
    return isinstance(error, FinalError) and bool(error.final)


def _describe(error: Exception) -> str:
    """Return the type and the text of an error."""
    return f"{type(error).__name__}: {error}"
