"""EvaluationLog: the number of simulations, the rows without an outcome, and the most likely failing points."""

import numpy as np
from numpy.typing import NDArray

from samplers.errors import EvaluationError, OnError, describe_row
from samplers.problem import Distribution, FloatArray
from samplers.sample import Failures

NO_OUTCOME = -np.inf
"""f as methods see it for a row without an outcome (counted as failing, on_error not "raise")."""
SMALLEST_F = float(np.finfo(np.float64).min)
"""f as methods see it where f is -inf, so that NO_OUTCOME keeps its meaning."""
KEEP_FAILURES = 1000
"""Failing points kept: enough for every listing, little memory in hundreds of dimensions."""


class EvaluationLog:
    """Counts every row, decides what NaN means and keeps the most likely failing points.

    Args:
        dim: Number of dimensions of x.
        base: Distribution of X.
        gamma: Threshold of failure, f <= gamma.
        on_error: "raise" refuses NaN; "failure" and "bound" pass it on as NO_OUTCOME.
        keep: How many failing points are kept, the most likely ones.

    Attributes:
        n_sim: Rows recorded, and what gradients cost.
        n_errors: Rows without an outcome.
    """

    def __init__(
        self, dim: int, base: Distribution, gamma: float, on_error: OnError = "raise", keep: int = KEEP_FAILURES
    ) -> None:
        self.n_sim = 0
        self.n_errors = 0
        self._failures = Failures.empty(dim)
        self._new: list[tuple[FloatArray, FloatArray]] = []
        self._base = base
        self._gamma = gamma
        self._on_error = on_error
        self._keep = keep

    def record(self, x: FloatArray, f: FloatArray) -> FloatArray:
        """Record f (n,) of the rows of x (n, d); return f as methods see it, shape (n,), never NaN.

        Raises:
            EvaluationError: If one is NaN and on_error is "raise"; nothing is recorded then.
        """
        missing = np.isnan(f)
        if missing.any() and self._on_error == "raise":
            row = describe_row(x, int(np.argmax(missing)))
            raise EvaluationError(f'f returned NaN for {row}; on_error="failure" or "bound" would count it instead.')
        self.n_sim += len(x)
        self.n_errors += int(missing.sum())
        self._keep_failures(x, f, missing | (f <= self._gamma))
        return np.where(missing, NO_OUTCOME, np.maximum(f, SMALLEST_F))

    @property
    def failures(self) -> Failures:
        """The most likely failing points."""
        self._merge_new()
        return self._failures

    def add_cost(self, n: int) -> None:
        """Count n simulations that gave gradients and no outcomes."""
        self.n_sim += n

    def _keep_failures(self, x: FloatArray, f: FloatArray, failing: NDArray[np.bool_]) -> None:
        """Keep the failing ones of the rows of x (n, d)."""
        if failing.any():
            self._new.append((x[failing], f[failing]))
            if sum(len(rows) for _, rows in self._new) >= self._keep:
                self._merge_new()

    def _merge_new(self) -> None:
        """Merge the new failing points into the most likely ones: the density of many costs little more than of one."""
        if self._new:
            x, f = (np.concatenate(parts) for parts in zip(*self._new, strict=True))
            log_p0 = np.asarray(self._base.log_prob(x), dtype=np.float64)
            self._failures, self._new = self._failures.merge(x, f, log_p0, keep=self._keep), []
