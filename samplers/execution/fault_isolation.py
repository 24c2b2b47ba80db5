"""Guarded: calls an f that may raise, so that every row has an outcome or the culprit a name."""

from collections.abc import Callable
from typing import NoReturn

import numpy as np
from numpy.typing import ArrayLike

from samplers.errors import EvaluationError, OnError, one_per_row, where
from samplers.problem import FloatArray


class Guarded:
    """f with a rule for rows on which it raises.

    With on_error "failure" or "bound" a batch on which f raised is handed to f again in halves
    until the raising rows stand alone; they get NaN. Rows handed over again are in `n_retried`.

    Args:
        evaluate: Maps points of shape (n, d) to values of shape (n,).
        on_error: "raise" names the first row that raises.
    """

    def __init__(self, evaluate: Callable[[FloatArray], ArrayLike], on_error: OnError = "raise") -> None:
        self.n_retried = 0
        self._evaluate = evaluate
        self._on_error = on_error

    def evaluate(self, x: FloatArray) -> FloatArray:
        """Simulate the rows of x (n, d); return f, shape (n,), NaN for rows on which it raised.

        Raises:
            EvaluationError: If f raises (on_error "raise") or has the wrong shape. An error with a true attribute
                `final` is passed on as it is.
        """
        try:
            return self._call(x)
        except EvaluationError:
            raise
        except Exception as error:
            if _is_final(error):
                raise
            if self._on_error == "raise":
                self._raise_named(x, error)
            return self._by_halves(x)

    def _call(self, x: FloatArray) -> FloatArray:
        return one_per_row(self._evaluate(x.copy()), len(x))  # a copy: f may write on what it is given

    def _by_halves(self, x: FloatArray) -> FloatArray:
        """Outcomes of a batch on which f has raised: split until the raising rows are alone."""
        if len(x) == 1:
            return np.array([np.nan])
        parts = []
        for half in np.array_split(x, 2):
            self.n_retried += len(half)
            try:
                parts.append(self._call(half))
            except EvaluationError:
                raise
            except Exception as error:
                if _is_final(error):
                    raise
                parts.append(self._by_halves(half))
        return np.concatenate(parts)

    def _raise_named(self, x: FloatArray, error: Exception) -> NoReturn:
        """Raise with the first row that raises again, and what f says of that row alone."""
        start, stop = 0, len(x)
        while stop - start > 1:
            middle = (start + stop) // 2
            start, stop = (start, middle) if self._raised(x[start:middle]) else (middle, stop)
        alone = self._raised(x[start:stop])  # the batch may have raised for another row
        if alone is None:
            raise EvaluationError(f"f raised on a batch of {len(x)} rows, not repeatably; {_kind(error)}") from error
        raise EvaluationError(f"f raised for {where(x, start)}; {_kind(alone)}") from alone

    def _raised(self, x: FloatArray) -> Exception | None:
        """Return what f raises for the rows of x, None if nothing."""
        try:
            self._evaluate(x.copy())
        except Exception as error:
            return error
        return None


def _is_final(error: Exception) -> bool:
    """Return whether f says that asking again is of no use: it has done so, or there is nobody to ask."""
    return bool(getattr(error, "final", False))


def _kind(error: Exception) -> str:
    return f"{type(error).__name__}: {error}"
