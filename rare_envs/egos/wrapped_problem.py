"""WrappedProblem: a problem around another one, as those that find faults, keep simulations or count them are."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

from numpy.typing import NDArray


@runtime_checkable
class ConditionalProblem(Protocol):
    """A problem whose probability is conditional on something."""

    @property
    def given(self) -> str:
        """Condition of p, in words; empty without one."""


class WrappedProblem:
    """A problem around another one: its parameters, its condition, and its terms and gradients if it has them.

    What it evaluates is for a class to say, and what it does with terms and gradients on the way (`_terms`,
    `_gradient`).

    Example:
        >>> import rare_envs
        >>> wrapped = WrappedProblem(rare_envs.DrivingProblem("rare_envs/CarFollowing-v0"))
        >>> wrapped.dim, callable(wrapped.terms), callable(wrapped.gradient), wrapped.gradient_cost
        (3, True, True, 6.5)
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

    @property
    def column_names(self) -> tuple[str, ...]:
        """Names of the columns of x; empty where the problem has none."""
        return tuple(getattr(self.problem, "column_names", ()))  # anybody's problem

    @property
    def terms(self) -> Callable[..., Any] | None:
        """Terms as of `rare_envs.DrivingProblem.terms`; None where the problem has none."""
        return self._terms if callable(getattr(self.problem, "terms", None)) else None  # anybody's problem

    @property
    def terms_with_f(self) -> bool:
        """Whether methods may ask for terms wherever they ask for f."""
        return bool(getattr(self.problem, "terms_with_f", True))  # anybody's problem

    @property
    def gradient(self) -> Callable[..., Any] | None:
        """Gradients of the terms as of `rare_envs.DrivingProblem.gradient`; None where the problem has none."""
        return self._gradient if callable(getattr(self.problem, "gradient", None)) else None  # likewise

    @property
    def gradient_cost(self) -> float:
        """Simulations that a row of `gradient` takes at most."""
        return float(self.problem.gradient_cost)

    def _terms(self, x: NDArray[Any], gamma: float = 0.0) -> Any:
        """Return the terms of scenarios x (n, d)."""
        return self.problem.terms(x, gamma)

    def _gradient(self, x: NDArray[Any], term: NDArray[Any], ticks: NDArray[Any], gamma: float = 0.0) -> Any:
        """Return the gradients of one term of each of the scenarios x (n, d)."""
        return self.problem.gradient(x, term, ticks, gamma)
