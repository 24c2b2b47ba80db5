"""Method: the base class of the methods, with `start` for simulations that the user makes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol, runtime_checkable

from samplers.execution.arguments import checked
from samplers.execution.run import Run
from samplers.method import Stepping
from samplers.problem import Inputs

if TYPE_CHECKING:
    from samplers.errors import OnError


@runtime_checkable
class Method(Stepping, Protocol):
    """A method to subclass: write `steps`, and `start` comes with it."""

    def start(
        self,
        problem: Inputs,
        gamma: float = 0.0,
        seed: int | None = None,
        max_sim: int | None = None,
        target_cov: float | None = None,
        confidence: float = 0.95,
        replicates: int = 1,
        on_error: OnError = "raise",
    ) -> Run:
        """Start a run whose simulations you make yourself: `ask` for points, `tell` their outcomes.

        Args:
            problem: Has `dim` and `base`; `evaluate` is not needed.
            gamma: Threshold of failure.
            seed: Same seed, same answer.
            max_sim: Simulations that are never asked for more of.
            target_cov: Coefficient of variation to stop at.
            confidence: Nominal coverage of the interval.
            replicates: Independent runs, side by side in every batch.
            on_error: What NaN among the outcomes means.

        Returns:
            The run; it gives what `estimate` with the same arguments gives.

        Raises:
            ValueError: If an argument is not as described in `estimate`.
        """
        return Run(checked(problem, self, gamma, seed, max_sim, target_cov, confidence, replicates, on_error))
