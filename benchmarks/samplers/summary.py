"""Runs into figures: per method and problem, faults beyond chance, and whether warnings come with the wrong runs."""

import math
import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats
from scipy.special import ndtr, stdtrit

from benchmarks.samplers.limit_states import LimitState
from benchmarks.samplers.problems import limit_state
from benchmarks.samplers.runs import MethodRun
from samplers.problem import FloatArray

LONGEST_EXAMPLE = 100
"""Letters of an error in a table."""
BIAS_ERRORS = 4.0
"""Standard errors that a mean of many runs may be off: by chance 1 of 16,000 unbiased means is further off."""
LEAST_RUNS = 5
"""With fewer bias is not judged: they may agree by chance, as plain draws with equal numbers of hits do."""
NOTICED_BIAS = 0.02
"""Bias below which nobody would mind, over p."""
NOMINAL_COVERAGE = 0.95
CHANCE = 1e-3
"""Probability that a method of nominal coverage is called one that covers too little."""
READ_DIGITS = 1e-10
"""Relative error that no draws reach in every run."""
BUDGET_EXCESS = 0.01
"""Share of the budget by which it may be exceeded."""


@dataclass(frozen=True)
class Cell:
    """One method on one problem. NaN where a figure has no meaning, as ratios where p = 0."""

    method: str
    problem: str
    dim: int
    p: float
    runs: int
    raised: int
    """Runs that ended in an exception; they count as not covering and nowhere else."""
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
    coverage: float
    """Share of the intervals that hold p."""
    low: int
    """Intervals wholly below p: the unsafe side."""
    high: int
    """Intervals wholly above p."""
    upper_over_lower: float
    """Of the ends of the interval, the median."""
    warned: float
    worst: float
    """Largest |estimate / p - 1|."""
    n_sim: float
    calls: float
    seconds: float
    """Processor time of one run without f."""
    max_sim: int | None = None
    """The budget; None for no limit."""
    hidden: float = 0.0
    """Share of the runs that state fewer simulations than were made."""
    reference_error: float = 0.0
    """Standard error of p itself, over p."""
    overstated: float = 0.0
    """Share of the runs that state more simulations than the problem was asked for."""
    without_f: float = 0.0
    """Share of the runs that answer without a single simulation."""
    impossible: float = 0.0
    """Share of the runs with a p or c.o.v. that cannot be, or an interval around another p; none of them covers."""
    example: str = ""
    """What the first run raised or, if none did, the first impossible answer."""
    same_points: bool = False
    """Whether all runs simulated the same points, whatever their seed."""

    @property
    def coverage_interval(self) -> tuple[float, float]:
        """Return the 95 % interval of the coverage, of so many runs (Clopper and Pearson 1934)."""
        held = round(self.coverage * self.runs)
        found = stats.binomtest(held, self.runs).proportion_ci(0.95, method="exact")
        return float(found.low), float(found.high)


def cells_of(runs: Iterable[MethodRun]) -> list[Cell]:
    """Return one cell for each method, problem and budget, in the order of their first runs."""
    groups: dict[tuple[str, str, int | None], list[MethodRun]] = defaultdict(list)
    for run in runs:
        groups[run.method, run.problem, run.max_sim].append(run)
    return [cell_of(group, limit_state(group[0].problem)) for group in groups.values()]


def cell_of(runs: Sequence[MethodRun], state: LimitState) -> Cell:
    """Summarise the runs of one method on one problem."""
    p = state.p
    ended = [run for run in runs if not run.error]
    estimates = np.array([run.p for run in ended])
    ratio = estimates / p if p > 0 else np.full(len(ended), math.nan)
    cov = _spread(ratio) / _mean(ratio) if _mean(ratio) > 0 else math.nan
    error = (ratio - 1.0) ** 2
    n_sim = _mean([run.n_sim for run in runs])
    off = np.array([own_errors_off(run, p) for run in ended])
    return Cell(
        method=runs[0].method,
        problem=runs[0].problem,
        dim=state.dim,
        p=p,
        runs=len(runs),
        raised=len(runs) - len(ended),
        mean=_mean(ratio),
        mean_se=_spread(ratio) / math.sqrt(max(len(ended), 1)),
        cov=cov,
        own_cov=_median([run.cov for run in ended if math.isfinite(run.cov)]),
        error_over_own=math.sqrt(_mean(off[np.isfinite(off)] ** 2)),
        gain=(1.0 - p) / p / (n_sim * _mean(error)) if p > 0 and n_sim > 0 and _mean(error) > 0 else math.nan,
        coverage=sum(covers(run, p) and is_possible(run) for run in ended) / len(runs),
        low=sum(run.high < p for run in ended),
        high=sum(run.low > p for run in ended),
        upper_over_lower=_median([run.high / run.low if run.low > 0 else math.inf for run in ended]),
        warned=_mean([bool(run.warnings) for run in ended]),
        worst=float(np.max(np.abs(ratio - 1.0))) if len(ended) else math.nan,
        n_sim=n_sim,
        calls=_mean([run.calls for run in runs]),
        seconds=_mean([run.seconds for run in runs]),
        max_sim=runs[0].max_sim,
        hidden=sum(hides_simulations(run) for run in runs) / len(runs),
        reference_error=state.standard_error / p if p > 0 else 0.0,
        overstated=sum(run.stated is not None and run.stated > run.n_sim for run in runs) / len(runs),
        without_f=sum(run.n_sim == 0 for run in ended) / len(runs),
        impossible=sum(not is_possible(run) for run in ended) / len(runs),
        example=_find_example(runs),
        same_points=_simulate_the_same(ended),
    )


def is_possible(run: MethodRun) -> bool:
    """Return whether p is a probability within its interval, and the c.o.v., if there is one, not negative."""
    return 0.0 <= run.p <= 1.0 and run.low <= run.p <= run.high and not run.cov < 0.0


def _find_example(runs: Sequence[MethodRun]) -> str:
    """Return what the first run raised or, if none did, the first impossible answer, in a line."""
    errors = [run.error for run in runs if run.error]
    answers = [
        f"p {run.p:.3g}, {run.low:.3g} to {run.high:.3g}, c.o.v. {run.cov:.3g}" for run in runs if not is_possible(run)
    ]
    text = " ".join([*errors, *answers, ""][0].split())
    return text if len(text) <= LONGEST_EXAMPLE else f"{text[: LONGEST_EXAMPLE - 3]}..."


def _simulate_the_same(runs: Sequence[MethodRun]) -> bool:
    """Return whether runs of several seeds all simulated the same points."""
    made = {run.points for run in runs}
    return len({run.seed for run in runs}) > 1 and len(made) == 1 and "" not in made and runs[0].n_sim > 0


def hides_simulations(run: MethodRun) -> bool:
    """Return whether a run states fewer simulations than it made."""
    return run.stated is not None and run.stated < run.n_sim


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


@dataclass(frozen=True)
class Power:
    """Do warnings come with the runs that are wrong, and only with those?"""

    wrong: int
    """Runs off by more than 4 of their own standard errors."""
    wrong_warned: int
    right: int
    """Runs within 2."""
    right_warned: int
    texts: dict[str, tuple[int, int, int]]
    """Runs with each warning (numbers as #): wrong, right, neither."""


def power_of(runs: Iterable[MethodRun]) -> Power:
    """Return the power of the warnings over runs of one method."""
    counts: Counter[str] = Counter()
    texts: dict[str, Counter[str]] = defaultdict(Counter)
    for run in runs:
        off = own_errors_off(run, limit_state(run.problem).p)
        kind = "wrong" if off > 4 else "right" if off <= 2 else "neither"
        counts[kind] += 1
        counts[f"{kind} warned"] += bool(run.warnings)
        for text in {without_numbers(warning) for warning in run.warnings}:
            texts[text][kind] += 1
    return Power(
        wrong=counts["wrong"],
        wrong_warned=counts["wrong warned"],
        right=counts["right"],
        right_warned=counts["right warned"],
        texts={
            text: (count["wrong"], count["right"], count["neither"])
            for text, count in sorted(texts.items(), key=lambda item: -item[1].total())
        },
    )


def without_numbers(text: str) -> str:
    """Replace the numbers in a text by #."""
    return re.sub(r"[-+]?\d(?:[\d,]*\d)?(?:\.\d+)?(?:e[-+]?\d+)?", "#", text)


def _mean(values: Sequence[float] | FloatArray) -> float:
    return float(np.mean(values)) if len(values) else math.nan


def _median(values: Sequence[float]) -> float:
    return float(np.median(values)) if values else math.nan


def _spread(values: FloatArray) -> float:
    with np.errstate(invalid="ignore"):  # an infinite answer has no spread
        return float(np.std(values, ddof=1)) if len(values) > 1 else math.nan


def find_faults(cell: Cell, knowable: bool = True) -> tuple[str, ...]:
    """Return the faults of a method on a problem in words; none where it does what it claims.

    Args:
        cell: Its runs.
        knowable: False where no method can know of a region of failure: bias and coverage are not judged there.
    """
    found = _find_broken_runs(cell)
    if cell.max_sim is not None and cell.n_sim > (1 + BUDGET_EXCESS) * cell.max_sim:
        found.append(f"makes {cell.n_sim / cell.max_sim:.2g} times the simulations of its budget")
    if cell.same_points:  # one run, so that nothing is known of its bias and coverage
        return (*found, _describe_one_run(cell))
    ended = cell.runs - cell.raised
    if not knowable or not ended:
        return tuple(found)
    if cell.p > 0 and cell.worst < READ_DIGITS:
        found.append(f"p to {-math.log10(READ_DIGITS):.0f} digits in every run, as no draws give it")
    bias = cell.mean - 1.0
    error = math.hypot(cell.mean_se, cell.reference_error)
    if ended >= LEAST_RUNS and abs(bias) > max(errors_allowed(ended) * error, NOTICED_BIAS) and not _is_bad_luck(cell):
        found.append(f"biased: mean / p {cell.mean:.3g} +- {error:.2g}")
    if _is_too_low(cell):
        low, high = cell.coverage_interval
        held = f"intervals hold p in {100 * cell.coverage:.0f} % of {cell.runs} runs"
        found.append(f"{held} ({100 * low:.0f} to {100 * high:.0f} %)")
    return tuple(found)


def _find_broken_runs(cell: Cell) -> list[str]:
    """Return faults of single runs, which need no chance to be called so."""
    found = []
    if cell.raised:
        found.append(f"raised in {cell.raised} of {cell.runs} runs ({cell.example})")
    if cell.impossible:
        example = "" if cell.raised else f" ({cell.example})"
        found.append(f"answers that cannot be in {100 * cell.impossible:.0f} % of the runs{example}")
    if cell.hidden:
        found.append(f"states fewer simulations than it made in {100 * cell.hidden:.0f} % of the runs")
    if cell.overstated:
        found.append(f"states more simulations than it made in {100 * cell.overstated:.0f} % of the runs")
    if cell.without_f:
        found.append(f"answers without a simulation in {100 * cell.without_f:.0f} % of the runs")
    return found


def _describe_one_run(cell: Cell) -> str:
    held = "holds" if cell.coverage > 0 else "does not hold"
    ratio = f", p over the true one {cell.mean:.3g}" if cell.p > 0 else ""
    return f"the same points at every seed: {cell.runs} runs are one, whose interval {held} p{ratio}"


def errors_allowed(runs: int) -> float:
    """Return the standard errors that a mean of so many runs may be off, by Student's distribution."""
    return float(stdtrit(runs - 1, ndtr(BIAS_ERRORS)))


def _is_bad_luck(cell: Cell) -> bool:
    """Return whether a mean below p may come from few hits or none, which show too small a spread.

    The variance of a mean of hits is as its expectation, so that around p it is what was seen, over mean / p. Where
    no run saw a failure, plain Monte Carlo of all simulations sees none with probability exp(-n p).
    """
    if cell.mean == 0:
        return math.exp(-cell.p * cell.n_sim * cell.runs) > 2 * float(ndtr(-BIAS_ERRORS))
    if not 0 < cell.mean < 1:
        return False
    error = math.hypot(cell.mean_se / math.sqrt(cell.mean), cell.reference_error)
    return 1 - cell.mean <= BIAS_ERRORS * error


def _is_too_low(cell: Cell) -> bool:
    """Return whether a method that covers as it claims would hardly ever cover so little."""
    held = round(cell.coverage * cell.runs)
    return float(stats.binom.cdf(held, cell.runs, NOMINAL_COVERAGE)) < CHANCE
