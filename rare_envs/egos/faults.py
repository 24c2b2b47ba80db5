"""Faults: scenarios on which an ego fails are found, repeated and recorded, and the others kept."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from rare_envs.egos.errors import EgoFault
from rare_envs.egos.isolation import attempt_in_parts

ON_FAULT = ("raise", "failure", "bound")
"""Ways with a scenario on which the ego fails twice: an error, or NaN that counts as a failure or bounds p."""


class Fault(NamedTuple):
    """A scenario on which the ego failed.

    Example:
        >>> Fault(np.array([20.0, 15.0, 30.0]), "RuntimeError: no road").reason
        'RuntimeError: no road'
    """

    x: NDArray[np.float64]
    """Its parameters, shape (d,)."""
    reason: str
    """The error, in one line."""


@runtime_checkable
class RowwiseProblem(Protocol):
    """A problem that goes on with the other rows when the ego fails on some."""

    def attempt(self, x: NDArray[np.float64]) -> tuple[NDArray[np.float64], dict[int, str]]:
        """Return f of x (n, d), shape (n,), NaN in rows that failed, and the reasons by row."""


@runtime_checkable
class ConditionalProblem(Protocol):
    """A problem whose probability is conditional on something."""

    @property
    def given(self) -> str:
        """Condition of p, in words; empty without one."""


class WrappedProblem:
    """A problem around another one: its parameters and its condition; what it evaluates is for a class to say.

    Example:
        >>> import rare_envs
        >>> WrappedProblem(rare_envs.DrivingProblem("rare_envs/CarFollowing-v0")).dim
        3
    """

    def __init__(self, problem: Any) -> None:
        """Wrap a problem that has `dim` and `base`."""
        self.problem = problem

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
        """Condition of p, as the problem states it."""
        return self.problem.given if isinstance(self.problem, ConditionalProblem) else ""


class FaultTolerant(WrappedProblem):
    """A problem around one whose ego may raise, hang (if remote), die, or give NaN or actions of a wrong shape.

    Rows on which it fails are found: at the tick at which they do if it has no memory, else by splitting the batch
    (see `rare_envs.egos.isolation.part_size`) until they stand alone. They are simulated once more. If the ego fails
    on them again f is NaN, which `samplers.estimate(..., on_error="failure" or "bound")` counts, and what happened is
    recorded. The simulations that this costs are not in `n_sim`; they are counted here.

    Attributes:
        problem: The problem that is evaluated.
        faults: Scenarios that failed twice, in the order they were met.
        n_retried: Rows simulated again.

    Example:
        >>> import rare_envs
        >>> problem = FaultTolerant(rare_envs.DrivingProblem("rare_envs/CarFollowing-v0"))
        >>> problem.evaluate([[20.0, 15.0, 30.0]]).shape, problem.faults
        ((1,), [])
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
        if on_error not in ON_FAULT:
            raise ValueError(f"Expected on_error {', '.join(map(repr, ON_FAULT))}, got {on_error!r}.")
        super().__init__(problem)
        self.faults: list[Fault] = []
        self.n_retried = 0
        self._on_error = on_error

    def evaluate(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Simulate.

        Args:
            x: Scenario parameters, shape (n, d).

        Returns:
            Safety measures, shape (n,); NaN where the ego failed twice.

        Raises:
            EgoFault: If it failed twice and on_error is "raise".
            EgoGone: If the ego cannot be queried any more.
        """
        x = np.atleast_2d(np.asarray(x, dtype=np.float64))
        f, reasons = self._evaluate_isolated(x)
        if not reasons:
            return f
        rows = sorted(reasons)
        self.n_retried += len(rows)
        f[rows], again = self._evaluate_isolated(x[rows])
        for number, reason in sorted(again.items()):
            fault = Fault(x[rows[number]].copy(), reason)
            if self._on_error == "raise":
                raise EgoFault(f"The ego failed twice on x = {_format_x(fault.x)}: {fault.reason}")
            self.faults.append(fault)
        return f

    def _evaluate_isolated(self, x: NDArray[np.float64]) -> tuple[NDArray[np.float64], dict[int, str]]:
        """Return f of x (n, d), shape (n,), NaN where a row failed, and the reasons by row."""

        def attempt(rows: range) -> tuple[NDArray[np.float64], dict[int, str]]:
            if len(rows) < len(x):
                self.n_retried += len(rows)
            f, reasons = self._attempt(x[rows.start : rows.stop].copy())
            return f, {rows.start + row: reason for row, reason in reasons.items()}

        attempted = attempt_in_parts(attempt, lambda row: np.full(1, np.nan), range(len(x)))
        assert attempted is not None
        return np.concatenate(attempted[0]), attempted[1]

    def _attempt(self, x: NDArray[np.float64]) -> tuple[NDArray[np.float64], dict[int, str]]:
        """Return f of a batch, and reasons where rows alone have failed, by the problem's `attempt` if it has one."""
        f, reasons = (
            self.problem.attempt(x) if isinstance(self.problem, RowwiseProblem) else (self.problem.evaluate(x), {})
        )
        f = np.array(f, dtype=np.float64)
        return f, dict.fromkeys(np.flatnonzero(np.isnan(f)).tolist(), "f is NaN") | reasons


def _format_x(x: NDArray[np.float64]) -> str:
    return np.array2string(x, precision=6, threshold=8, separator=", ", max_line_width=10**6)
