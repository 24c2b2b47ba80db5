"""Method: the base class of the methods, with `start` for simulations that the user makes."""

from typing import Protocol, runtime_checkable

from samplers.method import Stepping
from samplers.problem import Inputs
from samplers.run import Run, RunArguments
from samplers.validation import OnError


@runtime_checkable
class Method(Stepping, Protocol):
    """A method to subclass: write `steps`, and `start` comes with it.

    Example:
        >>> import numpy as np, samplers
        >>> class OneBatch(samplers.Method):
        ...     name, stops_at_target = "one-batch", False
        ...     def steps(self, inputs, goal, rng):
        ...         n = min(goal.budget, 4000)
        ...         f = yield inputs.base.sample(n, rng)
        ...         return samplers.Outcome.of_counts(int((f <= goal.gamma).sum()), n, goal.confidence, trace=())
        >>> problem = samplers.FunctionProblem(lambda x: 2.0 - x[:, 0], dim=1)
        >>> result = samplers.estimate(problem, OneBatch(), seed=0)
        >>> result.n_sim, result.p
        (4000, 0.01975)
    """

    def start(
        self,
        problem: Inputs,
        gamma: float = RunArguments.gamma,
        seed: int | None = RunArguments.seed,
        max_sim: int | None = RunArguments.max_sim,
        target_cov: float | None = RunArguments.target_cov,
        confidence: float = RunArguments.confidence,
        replicates: int = RunArguments.replicates,
        on_error: OnError = RunArguments.on_error,
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

        Example:
            >>> import samplers
            >>> problem = samplers.FunctionProblem(lambda x: 2.0 - x[:, 0], dim=2)
            >>> run = samplers.MonteCarlo(batch=1000).start(problem, seed=0, max_sim=2000)
            >>> while not run.done:
            ...     x = run.ask()
            ...     print(x.shape)
            ...     run.tell(2.0 - x[:, 0])
            (1000, 2)
            (1000, 2)
        """
        arguments = RunArguments(gamma, seed, max_sim, target_cov, confidence, replicates, on_error)
        return Run(problem, self, arguments)
