"""Faults of a method on a problem, each beyond what the number of runs can explain."""

from __future__ import annotations

import math

from scipy import stats
from scipy.special import ndtr, stdtrit

from samplers.benchmark.summary import Cell

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


def find_faults(cell: Cell, knowable: bool = True) -> tuple[str, ...]:
    """Return the faults of a method on a problem in words; none where it does what it claims.

    Args:
        cell: Its runs.
        knowable: False where no method can know of a region of failure: bias and coverage are not judged there.

    Example:
        An unbiased method with intervals that hold p in 14 of 20 runs:

        >>> cell = Cell(
        ...     method="own", problem="lin_d2", p=2.3e-4, runs=20, raised=0, mean_over_p=1.01, mean_se=0.01, cov=0.05,
        ...     own_cov=0.02, own_over_cov=0.4, gain=290.0, gain_se=90.0, coverage=0.7, below=0.15, warned=0.0,
        ...     worst=0.1, n_sim=6000.0, calls=50.0, seconds=0.1)
        >>> find_faults(cell)
        ('intervals hold p in 70 % of 20 runs (46 to 88 %)',)
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
    bias = cell.mean_over_p - 1.0
    error = math.hypot(cell.mean_se, cell.reference_error)
    if ended >= LEAST_RUNS and abs(bias) > max(errors_allowed(ended) * error, NOTICED_BIAS) and not _is_bad_luck(cell):
        found.append(f"biased: mean / p {cell.mean_over_p:.3g} +- {error:.2g}")
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
    ratio = f", p over the true one {cell.mean_over_p:.3g}" if cell.p > 0 else ""
    return f"the same points at every seed: {cell.runs} runs are one, whose interval {held} p{ratio}"


def errors_allowed(runs: int) -> float:
    """Return the standard errors that a mean of so many runs may be off, by Student's distribution.

    Example:
        >>> [round(errors_allowed(runs), 1) for runs in (5, 10, 20, 100)]
        [17.4, 7.0, 5.1, 4.2]
    """
    return float(stdtrit(runs - 1, ndtr(BIAS_ERRORS)))


def _is_bad_luck(cell: Cell) -> bool:
    """Return whether a mean below p may come from few hits or none, which show too small a spread.

    The variance of a mean of hits is as its expectation, so that around p it is what was seen, over mean / p. Where
    no run saw a failure, plain Monte Carlo of all simulations sees none with probability exp(-n p).
    """
    if cell.mean_over_p == 0:
        return math.exp(-cell.p * cell.n_sim * cell.runs) > 2 * float(ndtr(-BIAS_ERRORS))
    if not 0 < cell.mean_over_p < 1:
        return False
    error = math.hypot(cell.mean_se / math.sqrt(cell.mean_over_p), cell.reference_error)
    return 1 - cell.mean_over_p <= BIAS_ERRORS * error


def _is_too_low(cell: Cell) -> bool:
    """Return whether a method that covers as it claims would hardly ever cover so little."""
    held = round(cell.coverage * cell.runs)
    return float(stats.binom.cdf(held, cell.runs, NOMINAL_COVERAGE)) < CHANCE
