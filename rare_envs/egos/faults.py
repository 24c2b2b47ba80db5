"""What becomes of scenarios on which an ego fails: found, tried again, written down, and the others kept."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
ON_ERROR = ("raise", "failure", "bound")


class EgoGone(BaseException):
    """The ego cannot be asked any more, whatever the scenario.

    Like KeyboardInterrupt it is no `Exception`: nobody who makes the best of failing scenarios may take it for one.
    """


class NoAnswer(RuntimeError):
    """The ego has not answered in time, or has died: perhaps because of one of the rows that it was asked about."""


class EgoFault(ValueError):
    """The ego has failed on a scenario, twice."""

    final = True
    """It has been asked again."""


class Fault(NamedTuple):
    """A scenario on which the ego failed."""

    x: FloatArray
    """Its parameters, shape (d,)."""
    reason: str
    """What went wrong, in one line."""


class FaultTolerant:
    """A problem around one whose ego may raise, hang (if remote), die, or give NaN or actions of a wrong shape.

    Rows on which it fails are found: at the tick at which they do if it has no memory, else by handing the batch over
    in parts (see `part_size`) until they stand alone. They are simulated once more. If the ego fails on them again f
    is NaN, which `samplers.estimate(..., on_error="failure" or "bound")` counts, and what happened is kept. The
    simulations that this costs are not in `n_sim`; they are counted here.

    Attributes:
        problem: What is asked.
        faults: Scenarios that failed twice, in the order they were met.
        n_retried: Rows handed over again.
    """

    def __init__(self, problem: Any, on_error: str = "failure") -> None:
        """Wrap a problem.

        Args:
            problem: Has `dim`, `base` and `evaluate`, such as a `DrivingProblem`.
            on_error: "raise" ends with an error that names the scenario and the reason; "failure" and "bound" give
                NaN.

        Raises:
            ValueError: If on_error is none of these.
        """
        if on_error not in ON_ERROR:
            raise ValueError(f"Expected on_error {', '.join(map(repr, ON_ERROR))}, got {on_error!r}.")
        self.problem = problem
        self.faults: list[Fault] = []
        self.n_retried = 0
        self._on_error = on_error

    @property
    def dim(self) -> int:
        """Number of scenario parameters."""
        return int(self.problem.dim)

    @property
    def base(self) -> Any:
        """Distribution of x in ordinary traffic."""
        return self.problem.base

    @property
    def given(self) -> str:
        """What p is conditional on, as the problem says."""
        return str(getattr(self.problem, "given", ""))

    def evaluate(self, x: FloatArray) -> FloatArray:
        """Simulate.

        Args:
            x: Scenario parameters, shape (n, d).

        Returns:
            Safety measures, shape (n,); NaN where the ego failed twice.

        Raises:
            EgoFault: If it failed twice and on_error is "raise".
            EgoGone: If there is nobody to ask any more.
        """
        x = np.atleast_2d(np.asarray(x, dtype=np.float64))
        f, reasons = self._in_parts(x, len(x))
        if not reasons:
            return f
        rows = sorted(reasons)
        self.n_retried += len(rows)
        f[rows], again = self._in_parts(x[rows], len(rows))
        for number, reason in sorted(again.items()):
            fault = Fault(x[rows[number]].copy(), reason)
            if self._on_error == "raise":
                raise EgoFault(f"The ego failed twice on x = {_shown(fault.x)}: {fault.reason}")
            self.faults.append(fault)
        return f

    def _in_parts(self, x: FloatArray, whole: int) -> tuple[FloatArray, dict[int, str]]:
        """f, NaN where a row failed, and the reasons by row; x is part of a batch of so many."""
        try:
            return self._attempt(x.copy())
        except EgoGone:
            raise
        except (Exception, SystemExit) as error:  # the ego is the user's: anything may happen in it
            if len(x) == 1:
                return np.full(1, np.nan), {0: reason_of(error)}
            size = part_size(len(x), error, whole)
        self.n_retried += len(x)
        parts, reasons = [], dict[int, str]()
        for first in range(0, len(x), size):
            f, found = self._in_parts(x[first : first + size], whole)
            parts.append(f)
            reasons |= {first + row: reason for row, reason in found.items()}
        return np.concatenate(parts), reasons

    def _attempt(self, x: FloatArray) -> tuple[FloatArray, dict[int, str]]:
        """F of a batch, and reasons where rows alone have failed, by the problem's `attempt` if it has one."""
        attempt = getattr(self.problem, "attempt", None)
        f, reasons = (self.problem.evaluate(x), {}) if attempt is None else attempt(x)
        f = np.array(f, dtype=np.float64)
        return f, dict.fromkeys(np.flatnonzero(np.isnan(f)).tolist(), "f is NaN") | reasons


def part_size(n: int, error: BaseException, whole: int) -> int:
    """How many rows to ask about at a time after an error on n of them, to find those on which it happens.

    Half of them, which takes the fewest questions. Where the error is that no answer came, questions are cheap, but
    waiting for one that does not come, or for a process that starts again, is not: then the square root of the whole
    batch, and after that each row alone. So a row is found by two more waits, not by one for each halving, in about
    twice that root of questions.

    Args:
        n: Rows, 2 or more.
        error: What happened.
        whole: Rows of the batch that they are part of.
    """
    if not isinstance(error, NoAnswer):
        return (n + 1) // 2
    root = math.isqrt(whole)
    return root if 1 < root < n else 1


def reason_of(error: BaseException) -> str:
    """What went wrong, in one line."""
    words = " ".join(str(error).split())
    if isinstance(error, ValueError) and words:  # ours say what is wrong by themselves
        return words
    return f"{type(error).__name__}: {words}" if words and not isinstance(error, SystemExit) else repr(error)


def _shown(x: FloatArray) -> str:
    return np.array2string(x, precision=6, threshold=8, separator=", ", max_line_width=10**6)
