"""Trace: how a run ended (`Status`) and what each of its levels found (`Level`)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum


class Status(str, Enum):
    """End of a run; prints as its value.

    Example:
        >>> import samplers
        >>> problem = samplers.FunctionProblem(lambda x: 9.0 - x[:, 0], dim=1)
        >>> print(samplers.estimate(problem, "mc", seed=0, max_sim=100).status)
        no_hits
        >>> samplers.Status.NO_HITS == "no_hits"
        True
    """

    CONVERGED = "converged"
    """The method came to its own end (and met target_cov, if one was given); whether p can be trusted then is told by
    the warnings."""
    NO_HITS = "no_hits"
    """It came to its end without seeing a failure: p = 0, one-sided interval."""
    BUDGET = "budget"
    """max_sim (or the limit of runs, see `estimate`) was used up before the end or before target_cov was met."""
    STOPPED = "stopped"
    """Someone stopped it: the time limit or a callback."""
    STALLED = "stalled"
    """It could not get closer to the failures: ties in f, or too many levels."""

    def __str__(self) -> str:
        return str(self.value)


def describe_outcome(status: Status | str, warnings: Sequence[str]) -> str:
    """Return how a run ended, in words: "converged" stands alone only where there is no warning."""
    if status != Status.CONVERGED or not warnings:
        return str(status)
    return f"came to its end with {len(warnings)} warning{'s' * (len(warnings) != 1)}"


@dataclass(frozen=True, kw_only=True)
class Level:
    """One level of subset simulation, one iteration of cross-entropy, one batch of Monte Carlo.

    Example:
        >>> import samplers
        >>> problem = samplers.FunctionProblem(lambda x: 3.0 - x[:, 0], dim=1)
        >>> result = samplers.estimate(problem, samplers.AdaptiveSubsetSimulation(n=1000), seed=0)
        >>> for level in result.trace:
        ...     print(f"P[f <= {level.gamma:.1f}] = {level.estimate:.4f} after {level.n_sim} more simulations")
        P[f <= 1.8] = 0.1000 after 1000 more simulations
        P[f <= 0.7] = 0.0101 after 900 more simulations
        P[f <= 0.0] = 0.0010 after 899 more simulations
    """

    gamma: float
    """Threshold of this level."""
    p: float
    """Share of this level's points with f <= gamma."""
    estimate: float
    """P[f(X) <= gamma of this level] as estimated so far."""
    n_sim: int
    """Simulations made for this level."""
    n_points: int
    """Points behind `p`: those simulated and, in subset simulation, the seeds."""
    cov: float
    """Coefficient of variation of this level's own share in the estimate."""
    acceptance: float | None = None
    """Share of accepted moves (Markov chains)."""
    ess: float | None = None
    """Effective number of points behind `p` (chains) or of failing points (weights)."""
    run: int = 0
    """Number of the replicate that the level belongs to."""
