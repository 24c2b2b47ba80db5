"""Gate: whether a probability, or a rate that follows from it, is below a limit, at a one-sided confidence.

Each limit of an interval with nominal coverage c has the one-sided confidence (1 + c) / 2: the true p is above the
upper limit with probability (1 - c) / 2 at most, and the same is so of the lower limit. A test at confidence 0.95 takes
the limits of a 90 % interval. If nothing failed, the upper limit is the bound that the draws from the base give by
themselves, with any method.

A fixed number of simulations is one look, with the ends of the interval; a run that stopped on what it saw has those
of its confidence sequence, which hold at all looks. If the base distribution was fitted, they are the ends that the
events behind the base leave (`samplers.analysis.base_error`), moved out by as much, unless it is taken as given.

Warnings that p may be wrong leave it undecided. Those that p is coarse do not: of 53 runs with one on 67 limit states
with known p, no interval was without p.

Budget: simulations for a wished coefficient of variation, from a pilot.

A method that goes on drawing until it meets a target (two-stage, cross-entropy, importance sampling, Monte Carlo) has
made a search of S simulations and then n draws with the c.o.v. c0. The variance of these falls as 1 / n, so that

    N(c) = S + n (c0 / c)^2

is its cost with `target_cov=c`, if the pilot had the method's own budget and so the same search. A method of single
runs (subset simulation) is repeated: N(c) = N0 (c0 / c)^2, but at least 5 runs. Plain Monte Carlo needs
(1 - p) / (p c^2).

The pilot knows its own c.o.v. to a few ten per cent, and another seed finds another proposal.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

from samplers.analysis.base_error import BaseUncertainty
from samplers.analysis.weighted import Reported
from samplers.method import EstimateData
from samplers.output import format_alike, say
from samplers.problem import check_number
from samplers.sample import COARSE, Interval, Status

Decision = Literal["passes", "fails", "undecided"]


@dataclass(frozen=True, kw_only=True)
class Verdict(Reported):
    """Whether P[f(X) <= gamma], or a rate, is below a limit.

    It passes if the interval lies below the limit and fails if it lies above. It is undecided otherwise, or if a
    warning says that p may be wrong. It is true if it passes.

    Example:
        >>> import samplers
        >>> problem = samplers.FunctionProblem(lambda x: 3.5 - x.sum(axis=1) / 10**0.5, dim=10)
        >>> result = samplers.estimate(problem, seed=0, max_sim=6000, confidence=0.9)  # p = 2.3e-4
        >>> print(result.meets(1e-3))
        passes: p below 0.001 (95 % confidence, upper limit 0.00024)
        >>> bool(result.meets(1e-4)), result.meets(1e-4).decision
        (False, 'fails')
    """

    decision: Decision
    limit: float
    confidence: float
    """One-sided confidence of each end."""
    low: float
    """One-sided lower limit; 0 if it is not known."""
    high: float
    """One-sided upper limit; 1 if that of p is not known."""
    includes_base: bool
    """Whether the ends hold the uncertainty of the base distribution."""
    reason: str = ""
    """Why it is undecided, beside the ends."""
    quantity: str = "p"
    """What is below the limit or not."""
    if_exact: Decision | None = None
    """The decision if the base distribution were the true one; None if the ends do not hold its uncertainty."""

    def __bool__(self) -> bool:
        """Return whether it passes."""
        return self.decision == "passes"

    def __str__(self) -> str:
        """Return one sentence."""
        why = f"; {self.cause}" if self.cause else ""
        if self.cause and self.if_exact in ("passes", "fails"):
            why += f"; {say('if exact', decision=self.if_exact)}"
        return f"{self.decision}: {self.describe_ends()}{why}"

    def describe_ends(self) -> str:
        """Return the limits of p, or of the rate, in words."""
        low, high = format_alike(self.low, self.high)
        sure = f"{100 * self.confidence:.4g} %"
        return say(self.decision, what=self.quantity, limit=f"{self.limit:g}", sure=sure, low=low, high=high)

    @property
    def cause(self) -> str:
        """Why it is undecided, and what would decide it; empty if it is decided."""
        if self.decision != "undecided":
            return ""
        return self.reason or say("more events" if self.if_exact in ("passes", "fails") else "more simulations")

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {**super().to_dict(), "text": str(self)}


def widen_ends(estimate: EstimateData, ends: Interval) -> Interval:
    """Return ends of p under an uncertain base moved out by as much as the sequence is wider than the interval."""
    if estimate.sequence is None:
        return ends
    (low, high), (seq_low, seq_high) = estimate.interval, estimate.sequence
    return ends[0] * (seq_low / low if low > 0 else 1.0), min(1.0, ends[1] * seq_high / high)


def find_ends(estimate: EstimateData, base: BaseUncertainty | None) -> Interval:
    """Return the widest ends of p: with the error of a fitted base where it is known, at all looks at the run."""
    if base is None or (base.interval is None and base.bound is None):
        return estimate.sequence or estimate.interval
    return widen_ends(estimate, base.interval or (0.0, 1.0 if base.bound is None else base.bound))


def find_doubt(warnings: Sequence[str]) -> str:
    """Return the first warning that says that p may be wrong, as a reason; empty if there is none."""
    doubts = [text.rstrip(".") for text in warnings if COARSE not in text]
    return f"a warning says that p may be wrong: {doubts[0]}" if doubts else ""


def judge_ends(limit: float, ends: Interval, confidence: float, reason: str, **about: Any) -> Verdict:
    """Return whether what has these two-sided ends is below a limit; undecided for a reason, if there is one."""
    low, high = ends
    decision: Decision = "undecided"
    if not reason and not math.isnan(low + high):
        decision = "passes" if high < limit else "fails" if low > limit else "undecided"
    sure = round(0.5 + confidence / 2, 12)
    about = {"includes_base": False} | about
    return Verdict(decision=decision, limit=float(limit), confidence=sure, low=low, high=high, reason=reason, **about)


def judge_estimate(estimate: EstimateData, max_p: float, base: BaseUncertainty | None) -> Verdict:
    """Return whether p is below a limit, under the uncertainty of a fitted base where it is given."""
    if not (isinstance(max_p, int | float) and 0.0 < max_p < 1.0):
        raise ValueError(f"Expected max_p above 0 and below 1, got {max_p!r}.")
    none_failed, reason = estimate.status is Status.NO_HITS, ""
    ends = (0.0, estimate.bound_missed(0.5 + estimate.confidence / 2)) if none_failed else estimate.interval
    if base is not None:
        ends = base.interval or (0.0, 1.0 if base.bound is None else base.bound)
        if base.interval is None and base.bound is None:
            why = f": {base.reason.rstrip('.')}" if base.value else " before a failure is found"
            reason = f"the error of the base distribution is not known{why}"
    doubts = (*(() if none_failed else estimate.warnings), *(() if base is None else base.warnings))
    ends, reason = widen_ends(estimate, ends), find_doubt(doubts) or reason
    if_exact = None if base is None else judge_estimate(estimate, max_p, None).decision
    about = {"includes_base": base is not None, "if_exact": if_exact}
    return judge_ends(max_p, ends, estimate.confidence, reason, **about)


MAX_PILOT_COV = 0.5
"""C.o.v. of a pilot from which it tells too little: its own error is then of the order of a factor of 2."""


@dataclass(frozen=True, kw_only=True)
class Pilot:
    """A run from which others are planned.

    Raises:
        ValueError: It found no failure, or knows p too badly.

    Example:
        >>> import samplers
        >>> samplers.analysis.Pilot(method="mc", p=1e-3, cov=0.9, n_sim=1200, final_draws=1200)
        Traceback (most recent call last):
            ...
        ValueError: The pilot of 1,200 simulations has a relative error of 0.9, above 0.5: simulate more for a plan.
    """

    method: str
    """Name of its method."""
    p: float
    """Estimated probability."""
    cov: float
    """Its coefficient of variation."""
    n_sim: int
    """Simulations, search included."""
    final_draws: int | None
    """Draws behind p, if the method goes on with them until a target is met; None if it makes further runs."""
    seconds: float | None = None
    """Wall time [s], where it is known."""
    strata: tuple[tuple[float, float], ...] = ()
    """Share and p of each stratum of a sum."""

    def __post_init__(self) -> None:
        """Check that there is something to plan from."""
        if not self.p > 0.0:
            raise ValueError(f"The pilot of {self.n_sim:,} simulations found no failure: simulate more for a plan.")
        if not 0.0 < self.cov <= MAX_PILOT_COV:
            raise ValueError(
                f"The pilot of {self.n_sim:,} simulations has a relative error of {self.cov:.2g}, above "
                f"{MAX_PILOT_COV}: simulate more for a plan."
            )


@dataclass(frozen=True, kw_only=True)
class PlannedRun(Reported):
    """Simulations that a method needs for a coefficient of variation.

    Example:
        >>> from samplers.analysis import PlannedRun
        >>> PlannedRun(method="mc", target_cov=0.1, n_sim=99_900).to_dict()
        {'method': 'mc', 'target_cov': 0.1, 'n_sim': 99900, 'seconds': None}
    """

    method: str
    """Name of the method."""
    target_cov: float
    """Target coefficient of variation: `target_cov` of `estimate`."""
    n_sim: int
    """Simulations, those of a search included."""
    seconds: float | None = None
    """Wall time [s], if the pilot's is known."""


def plan(pilot: Any, target_cov: float) -> tuple[PlannedRun, ...]:
    """Return how many simulations the method of a finished run needs for a precision, and plain Monte Carlo.

    Args:
        pilot: The `Estimate` of the run; or its `pilot(seconds)`, which knows the wall time.
        target_cov: Target coefficient of variation, above 0.

    Raises:
        ValueError: If the target is not above 0, nothing failed in the run, or its c.o.v. is above 0.5.

    Example:
        >>> import samplers
        >>> problem = samplers.FunctionProblem(lambda x: 3.0 - x[:, 0], dim=2)
        >>> result = samplers.estimate(problem, "mc", seed=0, max_sim=10_000)  # 16 hits
        >>> [(run.method, run.n_sim) for run in samplers.plan(result, target_cov=0.1)]
        [('mc', 62400)]
        >>> pilot = samplers.analysis.Pilot(
        ...     method="two-stage", p=1e-4, cov=0.02, n_sim=6000, final_draws=2000, seconds=12.0)
        >>> [(run.method, run.n_sim, run.seconds) for run in samplers.plan(pilot, target_cov=0.01)]
        [('two-stage', 12000, 24.0), ('mc', 99990000, 199980.0)]
    """
    if not isinstance(pilot, Pilot):
        if isinstance(pilot, type) or not callable(getattr(pilot, "pilot", None)):
            raise ValueError(f"Expected the result of samplers.estimate, or its pilot(), got {type(pilot).__name__}.")
        pilot = pilot.pilot()
    check_number("target_cov", target_cov, 0.0, math.inf)
    factor = (pilot.cov / target_cov) ** 2
    if pilot.final_draws is not None:
        own = pilot.n_sim - pilot.final_draws + pilot.final_draws * factor
    else:
        own = float(pilot.n_sim) * (1.0 if factor <= 1.0 else max(5, math.ceil(factor)))
    spread = math.sqrt(pilot.p * (1.0 - pilot.p))
    if pilot.strata:  # plain draws in proportion to w_k times the standard deviation (Neyman, 1934)
        spread = math.fsum(share * math.sqrt(p * (1.0 - p)) for share, p in pilot.strata)
    needed = {pilot.method: own, "mc": (spread / (pilot.p * target_cov)) ** 2}
    rate = None if pilot.seconds is None else pilot.seconds / pilot.n_sim
    counts = {name: max(1, math.ceil(n * (1.0 - 1e-12))) for name, n in needed.items()}  # rounding of the division
    return tuple(
        PlannedRun(method=name, target_cov=float(target_cov), n_sim=n, seconds=None if rate is None else rate * n)
        for name, n in counts.items()
    )
