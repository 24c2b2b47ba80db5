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
        failures: The most likely failing points.
    """

    def __init__(
        self, dim: int, base: Distribution, gamma: float, on_error: OnError = "raise", keep: int = KEEP_FAILURES
    ) -> None:
        self.n_sim = 0
        self.n_errors = 0
        self.failures = Failures.empty(dim)
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

    def add_cost(self, n: int) -> None:
        """Count n simulations that gave gradients and no outcomes."""
        self.n_sim += n

    def _keep_failures(self, x: FloatArray, f: FloatArray, failing: NDArray[np.bool_]) -> None:
        """Merge the failing ones of the rows of x (n, d) into the failures kept."""
        if failing.any():
            failing_x = x[failing]
            log_p0 = np.asarray(self._base.log_prob(failing_x), dtype=np.float64)
            self.failures = self.failures.merge(failing_x, f[failing], log_p0, keep=self._keep)
