"""Combination: independent runs of one method as one outcome."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.special import chdtrc, stdtrit

from samplers.method import Outcome
from samplers.sample import DrawWeights, Level, Sample, Status
from samplers.statistics import Interval, binomial_cov

OWN_ERROR_FACTOR = 1.5
"""Factor by which runs may understate their own errors before they are said to disagree."""
MIN_SPREAD = 1 / 3
"""Least spread of runs, as a share of their own errors: they are closer together by chance, such as counts that tie."""
UNINFORMATIVE_COV = 1.0
"""From this c.o.v. on the p of a run adds nothing to its interval."""
DISAGREEMENT_LEVEL = 1e-4
"""Probability that runs whose errors are right are said to disagree."""
STATUS_PRIORITY = (Status.STOPPED, Status.STALLED, Status.BUDGET, Status.CONVERGED)
"""The status of the combined runs is the first of these that one of them has."""


def combine(outcomes: Sequence[Outcome], confidence: float) -> Outcome:
    """Return R independent runs as one: pooled counts, or their mean with a t interval.

    Where every run is a share k_i / n_i of independent draws, the draws are those of one longer
    run: p = sum k_i / sum n_i with the Clopper-Pearson interval. (A t interval would ignore that the
    spread of binomial counts is known; with R = 2 its quantile is 12.7.)

    Otherwise p is the arithmetic mean p_bar (each run's p-hat is unbiased, its logarithm is not).
    Its c.o.v. is the larger of the runs' own and of that of their spread. The
    interval is p_bar exp(-+ t s / sqrt(R)) with s the standard deviation of log p-hat (of
    p-hat / p_bar, where a run has p-hat = 0), but at least a third of the runs' own c.o.v., and t the
    quantile with R - 1 degrees of freedom. Where no run has a c.o.v. under 1 their spread is not known
    either: the interval then covers the intervals of all runs.
    Runs that were stopped before their end are left out of the mean if any run came to its end: one
    that has not reached the failures has p-hat = 0, which is no estimate. Their levels stay
    in the trace.
    """
    if len(outcomes) == 1:
        return outcomes[0]
    trace = tuple(_number_levels(outcomes))
    counts = pool_counts(outcomes)
    if counts is not None:
        hits, n = counts
        no_outcome = sum(o.no_outcome_share * o.counts[0] for o in outcomes if o.counts)
        whole = Outcome.of_counts(hits, n, confidence, trace, no_outcome / hits if hits else 0.0)
        shares = [o.counts[1] / n for o in outcomes if o.counts]
        return replace(
            whole,
            sample=merge_samples(outcomes, shares),
            draw_weights=share_weights(outcomes, outcomes, shares),
            remarks=_collect_texts([outcome.remarks for outcome in outcomes]),
        )
    used = select_finished(outcomes)
    left_out = len(outcomes) - len(used)
    about = (f"{left_out} of {len(outcomes)} runs were stopped before their end and left out.",) if left_out else ()
    if len(used) == 1:
        weights = share_weights(outcomes, used, [1.0])
        return replace(used[0], trace=trace, warnings=(*used[0].warnings, *about), draw_weights=weights)
    p = np.array([outcome.p for outcome in used])
    mean = float(p.mean())
    return Outcome(
        p=mean,
        interval=_mean_interval(used, p, confidence),
        cov=combined_cov(used),
        status=_first_by_priority(used) if mean > 0 else Status.NO_HITS,
        warnings=(*_collect_texts([outcome.warnings for outcome in used]), *about, *_warn_of_disagreement(used)),
        remarks=_collect_texts([outcome.remarks for outcome in used]),
        trace=trace,
        no_outcome_share=(float(np.average([o.no_outcome_share for o in used], weights=p)) if mean else 0.0),
        sample=merge_samples(used, [1 / len(used)] * len(used)),
        base_draws=sum(outcome.base_draws for outcome in used),
        draw_weights=share_weights(outcomes, used, [1 / len(used)] * len(used)),
    )


def _warn_of_disagreement(outcomes: Sequence[Outcome]) -> list[str]:
    """Return a warning if runs lie further apart than their own errors allow: some of them missed a region."""
    p = np.array([outcome.p for outcome in outcomes])
    error = OWN_ERROR_FACTOR * np.array([outcome.p * outcome.cov if outcome.p > 0 else 0.0 for outcome in outcomes])
    if len(p) < 3 or not (error > 0).all():
        return []
    with np.errstate(over="ignore"):  # inf is far enough apart
        apart = float((((p - p.mean()) / error) ** 2).sum())
    if chdtrc(len(p) - 1, apart) > DISAGREEMENT_LEVEL:
        return []
    return [f"The runs disagree ({p.min():.2e} to {p.max():.2e}): some of them may have missed a region of failure."]


def select_finished(outcomes: Sequence[Outcome]) -> Sequence[Outcome]:
    """Return the runs that came to their end or, where there is none, all of them."""
    return [outcome for outcome in outcomes if outcome.status is not Status.STOPPED] or outcomes


def merge_samples(outcomes: Sequence[Outcome], shares: Sequence[float]) -> Sample | None:
    """Return the points behind a weighted mean of runs, or None if a run does not give its own.

    Args:
        outcomes: R runs.
        shares: The weight of each run in the mean, R numbers that add up to 1.
    """
    samples = [outcome.sample for outcome in outcomes if outcome.sample is not None]
    if len(samples) < len(outcomes):
        return None
    first_units = np.cumsum([0, *(sample.n_units for sample in samples)])
    return Sample(
        f=np.concatenate([sample.f for sample in samples]),
        weights=np.concatenate([share * sample.weights for share, sample in zip(shares, samples, strict=True)]),
        units=np.concatenate([first + sample.units for first, sample in zip(first_units, samples, strict=False)]),
        n_units=int(first_units[-1]),
        x=np.concatenate([sample.x for sample in samples]),
        layers=tuple(
            replace(layer, weights=share * layer.weights, units=first + layer.units)
            for first, share, sample in zip(first_units, shares, samples, strict=False)
            for layer in sample.all_layers
        )
        if any(sample.layers for sample in samples)
        else (),
        lineages=sum(sample.lineages for sample in samples),
    )


def share_weights(
    outcomes: Sequence[Outcome], used: Sequence[Outcome], shares: Sequence[float]
) -> tuple[DrawWeights, ...]:
    """Return the weights of single simulations in a weighted mean of runs; none where a run does not give its own.

    Args:
        outcomes: All runs, in their order.
        used: Those of them that are in the mean.
        shares: The weight of each of these in it.
    """
    if not all(outcome.draw_weights for outcome in used):
        return ()
    number = {id(outcome): run for run, outcome in enumerate(outcomes)}
    return tuple(
        replace(weights, run=number[id(outcome)], log_share=math.log(share))
        for outcome, share in zip(used, shares, strict=True)
        for weights in outcome.draw_weights
    )


def pool_counts(outcomes: Sequence[Outcome]) -> tuple[int, int] | None:
    """Return failing and all draws of the runs together; None if a run is no share of plain draws."""
    counts = [outcome.counts for outcome in outcomes if outcome.counts is not None]
    if len(counts) < len(outcomes):
        return None
    return sum(hits for hits, _ in counts), sum(n for _, n in counts)


def combined_cov(outcomes: Sequence[Outcome]) -> float:
    """Return the c.o.v. of the combined runs.

    That of the pooled counts or, for a mean, the own or empirical one, whichever is larger.
    """
    counts = pool_counts(outcomes)
    if counts is not None:
        hits, n = counts
        return binomial_cov(hits / n, n)
    p = np.array([outcome.p for outcome in outcomes])
    if not p.any():
        return math.inf
    seen = float((p / p.mean()).std(ddof=1)) if len(p) > 1 else 0.0
    return max(_own_error(outcomes), seen) / math.sqrt(len(p))


def _own_error(outcomes: Sequence[Outcome]) -> float:
    """Return the root mean square of the errors that the runs state, relative to the mean of their p."""
    mean = float(np.mean([outcome.p for outcome in outcomes]))
    errors = [outcome.p / mean * outcome.cov for outcome in outcomes if outcome.p > 0]  # p squared might underflow
    return math.hypot(*errors) / math.sqrt(len(outcomes))


def _mean_interval(outcomes: Sequence[Outcome], p: np.ndarray, confidence: float) -> Interval:
    """Return the t interval of the mean of p (R,), see `combine`."""
    mean, runs = float(p.mean()), len(p)
    if np.ptp(p) == 0 or min(outcome.cov for outcome in outcomes) >= UNINFORMATIVE_COV:
        # their spread is not known
        return min(o.interval[0] for o in outcomes), max(o.interval[1] for o in outcomes)
    spread = float(np.log(p).std(ddof=1)) if p.all() else float((p / mean).std(ddof=1))
    spread = max(spread, MIN_SPREAD * _own_error(outcomes))
    half = float(stdtrit(runs - 1, 0.5 + confidence / 2)) * spread / math.sqrt(runs)
    return mean * math.exp(-half), min(1.0, mean * math.exp(half))


def _first_by_priority(outcomes: Sequence[Outcome]) -> Status:
    """Return the status of the combined runs."""
    present = {outcome.status for outcome in outcomes}
    return next((status for status in STATUS_PRIORITY if status in present), Status.BUDGET)


def _collect_texts(of_runs: Sequence[tuple[str, ...]]) -> tuple[str, ...]:
    """Return the warnings or remarks of runs, each once, with the number of runs that have it."""
    texts = Counter(text for run in of_runs for text in run)
    return tuple(f"In {count} of {len(of_runs)} runs: {text}" for text, count in texts.items())


def _number_levels(outcomes: Sequence[Outcome]) -> list[Level]:
    """Return the levels of all runs, each with the number of its run."""
    return [replace(level, run=i) for i, o in enumerate(outcomes) for level in o.trace]
