"""Method: the base class of the methods; their way to f, and the coordinates that are searched, noise drawn afresh.

The randomness of learned drivers is hundreds of coordinates of x that are standard normal and matter little one by one.
No proposal describes failures in so many dimensions; drawn from their own distribution they cost nothing: with
Z ~ N(0, I) for the noise, p = E[P(f(X, Z) <= gamma | X)], and weights are those of X alone.
"""

import math
from collections.abc import Generator
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, TypeVar, cast, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from samplers.bases import DrawnByItsMap
from samplers.method import Goal, Stepping
from samplers.problem import FloatArray, Inputs, OnError
from samplers.proposals import MixtureComponent
from samplers.run import Run, RunArguments
from samplers.sample import Level


@runtime_checkable
class Method(Stepping, Protocol):
    """A method to subclass: write `steps`, and `start` comes with it.

    Example:
        >>> import numpy as np, samplers
        >>> class OneBatch(samplers.methods.Method):
        ...     name, stops_at_target = "one-batch", False
        ...     def steps(self, inputs, goal, rng):
        ...         n = min(goal.budget, 4000)
        ...         f = yield inputs.base.sample(n, rng)
        ...         hits = int((f <= goal.gamma).sum())
        ...         return samplers.methods.Outcome.of_counts(hits, n, goal.confidence, trace=())
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
            gamma: As the others, see `samplers.estimate`, which gives the same result.
            seed: Same seed, same answer.
            max_sim: Simulations that are never asked for more of.
            target_cov: Coefficient of variation to stop at.
            confidence: Nominal coverage of the interval.
            replicates: Independent runs, side by side in every batch.
            on_error: What NaN among the outcomes means.

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


def noise_mask(inputs: Inputs) -> NDArray[np.bool_]:
    """Return which coordinates of x are noise, shape (d,): none if the base distribution does not say."""
    noise = getattr(inputs.base, "noise", None)  # a user's distribution need not have it
    return np.zeros(inputs.dim, dtype=bool) if noise is None else np.asarray(noise, dtype=bool)


def marginalise_noise(inputs: Inputs, rng: np.random.Generator) -> Inputs:
    """Return the inputs to search: these themselves if none of them is noise, or all are."""
    noise = noise_mask(inputs)
    return inputs if not noise.any() or noise.all() else cast(Inputs, NoiseMarginalisedInputs(inputs, noise, rng))


class NoiseMarginalisedInputs(DrawnByItsMap):
    """The coordinates that are not noise, as inputs; u (n, k) becomes x (n, d), equal u with equal noise."""

    def __init__(self, inputs: Inputs, noise: NDArray[np.bool_], rng: np.random.Generator) -> None:
        self.dim = int(np.count_nonzero(~noise))
        self._base, self._noise = inputs.base, noise
        self._seed = int(rng.integers(2**63))
        self._numbers: dict[bytes, int] = {}

    @property
    def base(self) -> Any:
        """Their distribution, which a search only draws from."""
        return self

    def from_standard_normal(self, u: FloatArray) -> FloatArray:
        """Map u (n, k) to x (n, d), with noise."""
        whole = np.empty((len(u), len(self._noise)))
        whole[:, ~self._noise] = u
        count = len(self._noise) - self.dim
        for row, key in enumerate(map(bytes, np.ascontiguousarray(u))):
            number = self._numbers.setdefault(key, len(self._numbers))
            whole[row, self._noise] = np.random.default_rng((self._seed, number)).standard_normal(count)
        return self._base.from_standard_normal(whole)


_T = TypeVar("_T")
SimulationSteps = Generator[FloatArray, FloatArray, _T]
"""A computation that needs simulations: yields points x (n, d), is sent their outcomes f (n,), returns a result."""


class Simulator:
    """The way to f from standard normal space, its count and trace, which stand also where a step is interrupted."""

    def __init__(self, inputs: Inputs, goal: Goal | None = None) -> None:
        self.inputs, self.goal = inputs, goal
        self.n_sim = 0
        self.trace = list[Level]()

    def record(self, p: float, estimate: float, n_points: int, cov: float, ess: float | None = None) -> None:
        """Add a level to the trace, which has all simulations that no earlier one has."""
        assert self.goal is not None
        made = self.n_sim - sum(level.n_sim for level in self.trace)
        found: dict[str, Any] = {"p": p, "estimate": estimate, "n_points": n_points, "cov": cov, "ess": ess}
        self.trace.append(Level(gamma=self.goal.gamma, n_sim=made, **found))
        self.goal.on_level(self.trace[-1])

    def close_trace(self) -> tuple[Level, ...]:
        """Return the trace; the simulations of an interrupted step, if there are any, are a level of their own."""
        loose = self.n_sim - sum(level.n_sim for level in self.trace)
        if loose:
            self.record(math.nan, math.nan, loose, math.inf)
        return tuple(self.trace)

    def evaluate(self, u: FloatArray) -> SimulationSteps[FloatArray]:
        """Return f at u (n, d), shape (n,); no batch is yielded where n = 0."""
        if len(u) == 0:
            return np.empty(0)
        return (yield from self.simulate(self.inputs.base.from_standard_normal(u)))

    def simulate(self, x: FloatArray) -> SimulationSteps[FloatArray]:
        """Return f at x (n, d), shape (n,), in physical space; n > 0."""
        f = yield x
        self.n_sim += len(x)
        return f


@dataclass(eq=False)
class SearchRun:
    """What is fixed for a run, and the simulator that counts; the runs of a method have their draws beside it."""

    inputs: Inputs  # all of x
    simulator: Simulator  # of the coordinates that are searched
    goal: Goal
    budget: int  # simulations that the exploration and the rounds are planned for
    end: int  # simulations that are never exceeded; more than `budget` where only a target c.o.v. is given
    rng: np.random.Generator

    @property
    def left(self) -> int:
        """Simulations left of the budget."""
        return self.budget - self.simulator.n_sim

    @property
    def left_at_all(self) -> int:
        """Simulations left before the end."""
        return self.end - self.simulator.n_sim

    def meets_target(self, cov: float) -> bool:
        """Return whether there is a target c.o.v. and this one meets it."""
        return self.goal.target_cov is not None and cov <= self.goal.target_cov


class ComponentDraws(NamedTuple):
    """Draws from known components, one component after the other, and their outcomes."""

    components: list[MixtureComponent]
    counts: NDArray[np.int64]  # draws of each component, (k,); they add up to n
    u: FloatArray  # (n, d)
    f: FloatArray  # (n,)
    first: int = 0  # simulations that the run had spent before the first of them
    x: FloatArray | None = None  # in physical space, (n, d), if they are kept: a fitted base is slow to map them again
