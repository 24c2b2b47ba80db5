"""What has been simulated: counted, checked, and the failing points remembered."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from samplers.errors import EvaluationError, OnError, one_per_row, where
from samplers.problem import Distribution, FloatArray
from samplers.result import Failures

NO_OUTCOME = -np.inf
"""What a method sees for a row without an outcome (counted as failing, on_error not "raise")."""
LEAST_FLOAT = float(np.finfo(np.float64).min)
"""What a method sees for an f of -inf, so that NO_OUTCOME keeps its meaning."""
KEEP_FAILURES = 1000


class Ledger:
    """Counts every row, settles what NaN means and keeps the most likely failing points.

    Args:
        dim: Number of dimensions of x.
        base: The law of X.
        gamma: Threshold of failure, f <= gamma.
        on_error: "raise" refuses NaN; "failure" and "bound" hand it on as NO_OUTCOME.
        keep: How many failing points are kept, the most likely ones.
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

    def enter(self, x: FloatArray, outcomes: ArrayLike) -> FloatArray:
        """Enter the outcomes of the rows of x (n, d); return f as methods see it, shape (n,), never NaN.

        Raises:
            EvaluationError: If there is not one number per row, or one is NaN (on_error "raise");
                nothing is entered then.
        """
        f = one_per_row(outcomes, len(x))
        missing = np.isnan(f)
        if missing.any() and self._on_error == "raise":
            row = where(x, int(np.argmax(missing)))
            raise EvaluationError(f'f returned NaN for {row}; on_error="failure" or "bound" would count it instead.')
        self.n_sim += len(x)
        self.n_errors += int(missing.sum())
        self._remember(x, f, missing | (f <= self._gamma))
        return np.where(missing, NO_OUTCOME, np.maximum(f, LEAST_FLOAT))

    def _remember(self, x: FloatArray, f: FloatArray, failing: NDArray[np.bool_]) -> None:
        if failing.any():
            found = x[failing]
            log_p0 = np.asarray(self._base.log_prob(found), dtype=np.float64)
            self.failures = self.failures.merged(found, f[failing], log_p0, keep=self._keep)
