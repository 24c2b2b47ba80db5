"""Counted: the wrapper through which `estimate` lets a method call the simulator.

It counts every row, checks what goes in and comes out, keeps the budget and
collects the failing points. No sampler knows of it.
"""

from collections.abc import Callable
from typing import Literal, NoReturn, get_args

import numpy as np

from samplers.problem import Distribution, FloatArray, Problem
from samplers.result import Failures

OnError = Literal["raise", "failure", "bound"]
ON_ERROR: tuple[str, ...] = get_args(OnError)

NO_OUTCOME = -np.inf
"""What a method sees for a row without an outcome (counted as failing, on_error not "raise")."""
LOWEST = float(np.finfo(np.float64).min)
"""What a method sees for an f of -inf, so that NO_OUTCOME keeps its meaning."""
KEEP_FAILURES = 1000


class EvaluationError(ValueError):
    """f raised, returned NaN or returned something that is not one number per row."""


class Counted:
    """A Problem that counts, checks and remembers.

    Every row that got an outcome counts once in `n_sim`. A batch on which f raised got none, so
    with on_error "failure" or "bound" it is handed to f again in halves until the raising rows
    stand alone; those attempts are in `n_retried`, not in `n_sim`.

    Args:
        problem: The problem to wrap.
        gamma: Threshold of failure, f <= gamma.
        max_sim: Rows that may be simulated in all; None for no limit.
        on_error: "raise" stops at the first row that raises or gives NaN; "failure" and "bound"
            hand it on as NO_OUTCOME.
        keep: How many failing points are kept, the most likely ones.
        on_batch: Called with `n_sim` after every batch.
    """

    def __init__(
        self,
        problem: Problem,
        gamma: float,
        *,
        max_sim: int | None = None,
        on_error: OnError = "raise",
        keep: int = KEEP_FAILURES,
        on_batch: Callable[[int], None] | None = None,
    ) -> None:
        self.n_sim = 0
        self.n_errors = 0
        self.n_retried = 0
        self._problem = problem
        self._gamma = gamma
        self._max_sim = max_sim
        self._on_error = on_error
        self._keep = keep
        self._on_batch = on_batch
        self._failures = Failures.empty(problem.dim)

    @property
    def dim(self) -> int:
        """Number of dimensions of x."""
        return self._problem.dim

    @property
    def base(self) -> Distribution:
        """The law of X."""
        return self._problem.base

    @property
    def failures(self) -> Failures:
        """The failing points seen so far, most likely first."""
        return self._failures

    def evaluate(self, x: FloatArray) -> FloatArray:
        """Simulate the rows of x (n, d); return f, shape (n,), never NaN.

        Raises:
            EvaluationError: If f raises or gives NaN (on_error "raise") or has the wrong shape.
            RuntimeError: If the method asks for more rows than `max_sim` leaves.
        """
        x = self._checked(x)
        if len(x) == 0:
            return np.empty(0)
        f = self._outcomes(x)
        self.n_sim += len(x)
        missing = np.isnan(f)
        if missing.any() and self._on_error == "raise":
            row = int(np.argmax(missing))
            raise EvaluationError(
                f'f returned NaN for {_where(x, row)}; on_error="failure" or "bound" would count it instead.'
            )
        self.n_errors += int(missing.sum())
        self._remember(x, f, missing | (f <= self._gamma))
        if self._on_batch is not None:
            self._on_batch(self.n_sim)
        return np.where(missing, NO_OUTCOME, np.maximum(f, LOWEST))

    def _checked(self, x: FloatArray) -> FloatArray:
        """Return a copy of x (so that f cannot change the caller's), its shape and size checked."""
        x = np.array(x, dtype=np.float64)
        if x.ndim != 2 or x.shape[1] != self.dim:
            raise ValueError(f"Expected x of shape (n, {self.dim}), got {x.shape}.")
        if self._max_sim is not None and self.n_sim + len(x) > self._max_sim:
            raise RuntimeError(
                f"The method asked for {len(x)} simulations with {self._max_sim - self.n_sim} of "
                f"max_sim={self._max_sim} left; a method must keep to goal.max_sim."
            )
        return x

    def _outcomes(self, x: FloatArray) -> FloatArray:
        """Return f of the rows of x, NaN for rows on which f raised."""
        try:
            return self._call(x)
        except EvaluationError:
            raise
        except Exception as error:
            if self._on_error == "raise":
                self._raise_named(x, error)
            return self._by_halves(x)

    def _call(self, x: FloatArray) -> FloatArray:
        f = np.asarray(self._problem.evaluate(x), dtype=np.float64)
        if f.shape != (len(x),):
            raise EvaluationError(f"Expected f to return shape ({len(x)},), one value per row of x, got {f.shape}.")
        return f

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
            except Exception:
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
        raise EvaluationError(f"f raised for {_where(x, start)}; {_kind(alone)}") from alone

    def _raised(self, x: FloatArray) -> Exception | None:
        """Return what f raises for the rows of x, None if nothing."""
        try:
            self._problem.evaluate(x.copy())
        except Exception as error:
            return error
        return None

    def _remember(self, x: FloatArray, f: FloatArray, failing: np.ndarray) -> None:
        if failing.any():
            found = x[failing]
            log_p0 = np.asarray(self.base.log_prob(found), dtype=np.float64)
            self._failures = self._failures.merged(found, f[failing], log_p0, keep=self._keep)


def _kind(error: Exception) -> str:
    return f"{type(error).__name__}: {error}"


def _where(x: FloatArray, row: int) -> str:
    shown = np.array2string(x[row], precision=6, threshold=8, separator=", ", max_line_width=10**6)
    return f"row {row} of a batch of {len(x)}, x = {shown}"
