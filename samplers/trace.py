"""Trace: how a run ended (`Status`) and what each of its levels found (`Level`)."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    pass


class Status(str, Enum):
    """How a run ended; prints as its value."""

    CONVERGED = "converged"
    """The method came to its own end (and met target_cov, if one was given)."""
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


@dataclass(frozen=True, kw_only=True)
class Level:
    """One level of subset simulation, one iteration of cross-entropy, one batch of Monte Carlo."""

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
    """Which replicate the level belongs to."""
