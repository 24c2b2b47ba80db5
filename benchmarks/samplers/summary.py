"""Runs into figures: per method and problem, and per method over all problems, with the binomial intervals."""

import math
import statistics
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy import stats

from benchmarks.samplers.limit_states import LimitState, StrataState
from benchmarks.samplers.problems import find_problem, limit_state
from benchmarks.samplers.runs import MethodRun
from samplers.problem import FloatArray
from samplers.sample import clopper_pearson

LONGEST_EXAMPLE = 100
"""Letters of an error in a table."""
FAR = 4.0
"""Own standard errors off, beyond which a run is wrong whatever its interval says."""
CHANCE = 1e-3
"""Probability that a method of nominal coverage is called one that covers too little."""
BUDGET_EXCESS = 0.01
"""Share of the budget by which it may be exceeded."""


@dataclass(frozen=True)
class Share:
    """So many of so many."""

    count: int
    of: int
    interval: tuple[float, float] = field(init=False)
    """The 95 % interval of the probability (Clopper and Pearson 1934)."""

    def __post_init__(self) -> None:
        """Find the interval."""
        interval = clopper_pearson(self.count, self.of, 0.95) if self.of else (0.0, 1.0)
        object.__setattr__(self, "interval", interval)

    def __add__(self, other: "Share") -> "Share":
        """Pool two."""
        return Share(self.count + other.count, self.of + other.of)

    def __str__(self) -> str:
        """Return the percentage with its interval."""
        if not self.of:
            return "0 of 0"
        low, high = self.interval
        return f"{100 * self.count / self.of:.1f} % of {self.of} ({100 * low:.1f} to {100 * high:.1f})"


@dataclass(frozen=True)
class Cell:
    """One method on one problem. NaN where a figure has no meaning, as ratios where p = 0."""

    method: str
    problem: str
    dim: int
    p: float
    max_sim: int | None
    """The budget; None for no limit."""
    runs: int
    mean: float
    """Of the estimates, over p."""
    mean_se: float
    """Standard error of that."""
    cov: float
    """Spread of the estimates / their mean."""
    own_cov: float
    """Median of what the runs state."""
    error_over_own: float
    """Root mean square of the errors over the run's own standard errors: 1 where these are right."""
    gain: float
    """(1 - p) / p / (n_sim x relative mean square error)."""
    upper_over_lower: float
    """Of the ends of the interval, the median."""
    n_sim: float
    calls: float
    seconds: float
    """Processor time of one run without f."""
    covered: Share
    """Of all runs those whose interval holds p; a run that raised, or whose answer cannot be, does not."""
    low: int
    """Intervals wholly below p: the unsafe side."""
    high: int
    """Intervals wholly above p."""
    far_warned: Share
    """Of the runs off by more than `FAR` of their own standard errors."""
    wrong_warned: Share
    """Of the runs off by as much, or whose interval misses p."""
    right_warned: Share
    """Of the others; runs that raised are neither."""
    faults: tuple[str, ...] = field(default=())
    """What chance does not explain, in words."""


@dataclass(frozen=True)
class Summary:
    """One method at one budget, over all problems of which a method can know."""

    method: str
    max_sim: int | None
    problems: int
    covered: Share
    low: int
    high: int
    gain: float
    """Geometric mean over the problems on which runs ended."""
    gains: int
    """Number of these."""
    far_warned: Share
    wrong_warned: Share
    right_warned: Share
    seconds: float


def cells_of(runs: Iterable[MethodRun]) -> list[Cell]:
    """Return one cell for each method, problem and budget, in the order of their first runs."""
    groups: dict[tuple[str, str, int | None], list[MethodRun]] = defaultdict(list)
    for run in runs:
        groups[run.method, run.problem, run.max_sim].append(run)
    return [
        cell_of(group, limit_state(group[0].problem), find_problem(group[0].problem).knowable)
        for group in groups.values()
    ]


def cell_of(runs: Sequence[MethodRun], state: LimitState | StrataState, knowable: bool = True) -> Cell:
    """Summarise the runs of one method on one problem; coverage is no fault where a region is not `knowable`."""
    p = state.p
    ended = [run for run in runs if not run.error]
    ratio = np.array([run.p for run in ended]) / p if p > 0 else np.full(len(ended), math.nan)
    error, n_sim = _mean((ratio - 1.0) ** 2), _mean([run.n_sim for run in runs])
    off = np.array([own_errors_off(run, p) for run in ended])
    is_wrong = [away > FAR or not covers(run, p) for run, away in zip(ended, off, strict=True)]
    warned = [bool(run.warnings) for run in ended]
    covered = Share(sum(covers(run, p) and is_possible(run) for run in ended), len(runs))
    return Cell(
        method=runs[0].method,
        problem=runs[0].problem,
        dim=state.dim,
        p=p,
        max_sim=runs[0].max_sim,
        runs=len(runs),
        mean=_mean(ratio),
        mean_se=_spread(ratio) / math.sqrt(max(len(ended), 1)),
        cov=_spread(ratio) / _mean(ratio) if _mean(ratio) > 0 else math.nan,
        own_cov=_median([run.cov for run in ended if math.isfinite(run.cov)]),
        error_over_own=math.sqrt(_mean(off[np.isfinite(off)] ** 2)),
        gain=(1.0 - p) / p / (n_sim * error) if p > 0 and n_sim > 0 and error > 0 else math.nan,
        upper_over_lower=_median([run.high / run.low if run.low > 0 else math.inf for run in ended]),
        n_sim=n_sim,
        calls=_mean([run.calls for run in runs]),
        seconds=_mean([run.seconds for run in runs]),
        covered=covered,
        low=sum(run.high < p for run in ended),
        high=sum(run.low > p for run in ended),
        far_warned=_share(warned, off > FAR),
        wrong_warned=_share(warned, is_wrong),
        right_warned=_share(warned, np.logical_not(is_wrong)),
        faults=tuple(_find_faults(runs, covered, knowable)),
    )


def summarise(cells: Sequence[Cell]) -> Summary:
    """Pool the cells of one method at one budget; regions that no method can know of, and p = 0, do not count."""
    counted = [cell for cell in cells if cell.p > 0 and find_problem(cell.problem).knowable]
    gains = [cell.gain for cell in counted if math.isfinite(cell.gain)]
    nothing = Share(0, 0)
    return Summary(
        method=cells[0].method,
        max_sim=cells[0].max_sim,
        problems=len(counted),
        covered=sum((cell.covered for cell in counted), nothing),
        low=sum(cell.low for cell in counted),
        high=sum(cell.high for cell in counted),
        gain=statistics.geometric_mean(gains) if gains else math.nan,
        gains=len(gains),
        far_warned=sum((cell.far_warned for cell in counted), nothing),
        wrong_warned=sum((cell.wrong_warned for cell in counted), nothing),
        right_warned=sum((cell.right_warned for cell in counted), nothing),
        seconds=_mean([cell.seconds for cell in counted]),
    )


def is_possible(run: MethodRun) -> bool:
    """Return whether p is a probability within its interval, and the c.o.v., if there is one, not negative."""
    return 0.0 <= run.p <= 1.0 and run.low <= run.p <= run.high and not run.cov < 0.0


def covers(run: MethodRun, p: float) -> bool:
    """Return whether the interval holds p."""
    return run.low <= p <= run.high


def own_errors_off(run: MethodRun, p: float) -> float:
    """Return by how many of its own standard errors the estimate is off.

    NaN where nothing can be said: p is 0, the run raised, states no finite c.o.v., or gave 0 with an interval that
    holds p. An estimate of 0 with one that does not is off by infinitely many.
    """
    if run.error or p == 0:
        return math.nan
    if run.p == 0:
        return math.nan if covers(run, p) else math.inf
    if not math.isfinite(run.cov):
        return math.nan
    return abs(run.p - p) / (run.cov * run.p) if run.cov > 0 else (0.0 if run.p == p else math.inf)


def _find_faults(runs: Sequence[MethodRun], covered: Share, knowable: bool) -> Iterable[str]:
    """Yield in words what a method that does what it claims would not do."""
    ended = [run for run in runs if not run.error]
    errors = [run.error for run in runs if run.error]
    if errors:
        text = " ".join(errors[0].split())
        yield f"raised in {len(errors)} of {len(runs)} runs ({text[:LONGEST_EXAMPLE]})"
    if impossible := [run for run in ended if not is_possible(run)]:
        run = impossible[0]
        answer = f"p {run.p:.3g}, {run.low:.3g} to {run.high:.3g}, c.o.v. {run.cov:.3g}"
        yield f"answers that cannot be in {len(impossible)} of {len(runs)} runs ({answer})"
    if any(run.stated not in (None, run.n_sim) for run in ended):
        yield "states another number of simulations than it made"
    budget, n_sim = runs[0].max_sim, _mean([run.n_sim for run in runs])
    if budget is not None and n_sim > (1 + BUDGET_EXCESS) * budget:
        yield f"makes {n_sim / budget:.2g} times the simulations of its budget"
    if len({run.seed for run in ended}) > 1 and len({run.points for run in ended}) == 1:
        yield "the same points at every seed"
    elif knowable and ended and stats.binom.cdf(covered.count, covered.of, 0.95) < CHANCE:
        yield f"intervals hold p in {covered}"


def _share(warned: Sequence[bool], among: Sequence[bool] | np.ndarray) -> Share:
    """Return how many of the runs in question warn."""
    return Share(int(np.sum(np.logical_and(warned, among))), int(np.sum(among)))


def _mean(values: Sequence[float] | FloatArray) -> float:
    return float(np.mean(values)) if len(values) else math.nan


def _median(values: Sequence[float]) -> float:
    return float(np.median(values)) if values else math.nan


def _spread(values: FloatArray) -> float:
    with np.errstate(invalid="ignore"):  # an infinite answer has no spread
        return float(np.std(values, ddof=1)) if len(values) > 1 else math.nan
