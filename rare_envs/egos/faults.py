"""Faults: scenarios on which an ego fails are found, repeated and recorded, and the others kept."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from rare_envs.egos.errors import EgoFault
from rare_envs.egos.isolation import Attempt, attempt_in_parts
from rare_envs.egos.term_rows import (
    GradientRows,
    Table,
    TermRows,
    join_tables,
    overwrite_rows,
    read_terms,
    tabulate_terms,
    widen_rows,
)
from rare_envs.egos.wrapped_problem import WrappedProblem

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
class RowwiseTerms(Protocol):
    """A problem with terms that does the same for them."""

    def attempt_terms(self, x: NDArray[np.float64], gamma: float = 0.0) -> tuple[Any, dict[int, str]]:
        """Return the terms of x (n, d), NaN in rows that failed, and the reasons by row."""


Attempted = Attempt[Table]
"""A row of numbers for each scenario, shape (n, k), NaN in those that failed, and the reasons by row."""
AttemptRows = Callable[[NDArray[np.int64]], Attempted]
"""From rows of a batch to what they give; it may raise."""


class FaultTolerant(WrappedProblem):
    """A problem around one whose ego may raise, hang (if remote), die, or give NaN or actions of a wrong shape.

    Rows on which it fails are found: at the tick at which they do if it has no memory, else by splitting the batch
    (see `rare_envs.egos.isolation.part_size`) until they stand alone. They are simulated once more. If the ego fails
    on them again f is NaN, which `samplers.estimate(..., on_error="failure" or "bound")` counts, and what happened is
    recorded. The simulations that this costs are not in `n_sim`; they are counted here. Terms are simulated in the same
    way. A scenario whose gradient fails twice has an outcome and no gradient: NaN, and no fault is recorded.

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
        table, reasons = self._attempt_twice(lambda part: self._attempt(x[part]), x)
        self._record(x, reasons)
        return table[:, 0].copy()

    def _terms(self, x: NDArray[np.float64], gamma: float = 0.0) -> TermRows:
        """Simulate, with the terms of the problem.

        Args:
            x: Scenario parameters, shape (n, d).
            gamma: Threshold of f.

        Returns:
            f and terms, NaN where the ego failed twice.

        Raises:
            EgoFault: As `evaluate`.
            EgoGone: As `evaluate`.
        """
        x, seen = np.asarray(x, dtype=np.float64), list[Any]()

        def attempt(part: NDArray[np.int64]) -> Attempted:
            rows = x[part]
            terms, reasons = (
                self.problem.attempt_terms(rows, gamma)
                if isinstance(self.problem, RowwiseTerms)
                else (self.problem.terms(rows, gamma), {})
            )
            seen.append(terms)
            return tabulate_terms(terms), _reasons_of_nan(terms.f) | reasons

        table, reasons = self._attempt_twice(attempt, x)
        self._record(x, reasons)
        return read_terms(table, float(seen[0].threshold), seen[0].names) if seen else read_terms(table, gamma, ("f",))

    def _gradient(
        self, x: NDArray[np.float64], term: NDArray[np.int64], ticks: NDArray[np.int64], gamma: float = 0.0
    ) -> GradientRows:
        """Differentiate, as `rare_envs.DrivingProblem.gradient`; a row on which the ego fails costs the most there is.

        Raises:
            EgoFault: If it failed twice and on_error is "raise".
            EgoGone: If the ego cannot be queried any more.
        """
        costs = np.full(len(x), self.gradient_cost)

        def attempt(part: NDArray[np.int64]) -> Attempted:
            found = self.problem.gradient(x[part], term[part], ticks[part], gamma)
            costs[part] = found.cost / len(costs[part])
            return np.asarray(found.values, dtype=np.float64), {}

        table, reasons = self._attempt_twice(attempt, x)
        if reasons and self._on_error == "raise":
            self._record(x, reasons)
        return GradientRows(widen_rows(table, x.shape[1]), float(costs.sum()))

    def _attempt_twice(self, attempt: AttemptRows, x: NDArray[np.float64]) -> Attempted:
        """Return what the rows of x (n, d) give at the second attempt at the latest, and reasons where both failed.

        Args:
            attempt: Gives a table and reasons of some rows.
            x: Scenarios.
        """
        table, reasons = self._isolate(attempt, np.arange(len(x)))
        if not reasons:
            return table, {}
        rows = np.array(sorted(reasons))
        self.n_retried += len(rows)
        other, again = self._isolate(attempt, rows)
        return overwrite_rows(table, rows, other), {int(rows[number]): reason for number, reason in again.items()}

    def _isolate(self, attempt: AttemptRows, rows: NDArray[np.int64]) -> Attempted:
        """Return what some rows give, in parts that become smaller until those that raise stand alone."""

        def attempt_part(part: range) -> Attempted:
            if len(part) < len(rows):
                self.n_retried += len(part)
            table, reasons = attempt(rows[part.start : part.stop])
            return table, {part.start + row: reason for row, reason in reasons.items()}

        attempted = attempt_in_parts(attempt_part, lambda row: np.full((1, 1), np.nan), range(len(rows)))
        assert attempted is not None
        return join_tables(attempted[0]), attempted[1]

    def _attempt(self, x: NDArray[np.float64]) -> Attempted:
        """Return f of a batch, and reasons where rows alone have failed, by the problem's `attempt` if it has one."""
        f, reasons = (
            self.problem.attempt(x) if isinstance(self.problem, RowwiseProblem) else (self.problem.evaluate(x), {})
        )
        f = np.array(f, dtype=np.float64)
        return f[:, None], _reasons_of_nan(f) | reasons

    def _record(self, x: NDArray[np.float64], reasons: dict[int, str]) -> None:
        """Record the scenarios that failed twice.

        Raises:
            EgoFault: If on_error is "raise".
        """
        for row, reason in sorted(reasons.items()):
            fault = Fault(x[row].copy(), reason)
            if self._on_error == "raise":
                raise EgoFault(f"The ego failed twice on x = {format_x(fault.x)}: {fault.reason}")
            self.faults.append(fault)


def _reasons_of_nan(f: NDArray[np.float64]) -> dict[int, str]:
    return dict.fromkeys(np.flatnonzero(np.isnan(f)).tolist(), "f is NaN")


def format_x(x: NDArray[np.float64]) -> str:
    """Return scenario parameters x (d,) in one line.

    Example:
        >>> format_x(np.array([20.0, 15.0]))
        '[20., 15.]'
    """
    return np.array2string(x, precision=6, threshold=8, separator=", ", max_line_width=10**6)
