"""Runs of a method: one between its requests and answers, another for a target, several as one, sums over strata."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
from scipy.special import chdtrc, stdtrit

from samplers.method import (
    Answer,
    Choice,
    Goal,
    Interrupted,
    Outcome,
    Part,
    Request,
    Stepping,
    Steps,
    TermsOffer,
    whole_simulations,
)
from samplers.problem import Distribution, FloatArray, TermGradients, Terms
from samplers.sample import (
    DrawWeights,
    Interval,
    Level,
    Sample,
    Status,
    binomial_cov,
    clopper_pearson,
    effective_number,
)

MIN_REPLICATES = 5
"""Runs made at least where those asked for miss target_cov: fewer give a useless t interval."""
NO_OUTCOME = -np.inf
"""f as methods see it for a row without an outcome (counted as failing, on_error not "raise")."""
NOT_KNOWN = Outcome(
    p=0.0,
    interval=(0.0, 1.0),
    cov=math.inf,
    status=Status.STOPPED,
    warnings=("The run was stopped before its method had an estimate: p = 0 means not known.",),
)
"""Outcome of a run that was stopped before its first values of f, or whose method does not handle `Interrupted`."""


@dataclass(frozen=True)
class InputsOnly:
    """dim, base and offer of a problem: all that a method is shown, so that it cannot call f itself."""

    dim: int
    base: Distribution
    offer: TermsOffer | None = None


def meets_target(outcomes: Sequence[Outcome], target_cov: float | None, replicates: int) -> bool:
    """Return whether these runs together meet target_cov (as they do if there is none).

    With more of them than `replicates`, at least MIN_REPLICATES are made unless their counts pool.
    """
    if target_cov is None:
        return True
    few = replicates < len(outcomes) < MIN_REPLICATES and pool_counts(outcomes) is None
    return not few and combined_cov(outcomes) <= target_cov


def needs_another(runs: Sequence[Replicate], method: Stepping, goal: Goal, replicates: int) -> bool:
    """Return whether finished runs miss the target and one more may be made.

    It may not where as many runs as `replicates` have come to the limit of their method, 200 are
    made, or too little of max_sim is left: less than the longest run took, except for runs that
    pool, which can be cut short (beside longer ones, a short run would spoil a mean).
    """
    outcomes = [run.outcome for run in runs if run.outcome is not None]
    if meets_target(outcomes, goal.target_cov, replicates) or len(runs) >= 200:  # each is too small
        return False
    targets = [run.goal.target_cov for run in runs]
    missed = [t is not None and outcome.cov > t for t, outcome in zip(targets, outcomes, strict=True)]
    if method.stops_at_target and sum(missed) >= replicates:
        return False
    left = goal.budget - sum(run.n_sim for run in runs)
    return left >= (1 if pool_counts(outcomes) is not None else max(run.n_sim for run in runs))


class Replicate:
    """The steps of one run of a method: the points it requests next and, at the end, its outcome.

    Attributes:
        goal: The goal it was given; more than goal.max_sim points are refused.
        requested: What the method waits for; no points once it has its outcome.
        n_sim: Simulations made for it so far.
        outcome: Its outcome; None while it runs.
    """

    def __init__(self, steps: Steps, goal: Goal, inputs: InputsOnly) -> None:
        self.goal, self._inputs, self._steps = goal, inputs, steps
        self.n_sim = 0
        self.outcome: Outcome | None = None
        self.requested = Request("f", (np.empty((0, inputs.dim)),))
        self._advance(lambda: next(steps))

    def tell(self, answer: Answer) -> None:
        """Give the method what it requested, without NaN, and let it run to its next request or its end.

        Points without an outcome fail, in every term too.
        """
        f, seen = outcomes_of(answer), answer
        if f is not None:
            shown = np.where(np.isnan(f), NO_OUTCOME, np.maximum(f, np.finfo(np.float64).min))  # -inf keeps its meaning
            seen = shown
            if isinstance(answer, Terms):
                values = np.where(np.isneginf(shown)[:, None], -np.inf, answer.values)
                seen = replace(answer, f=shown, values=values)
        self.resume(seen)

    def resume(self, seen: Answer) -> None:
        """Give the method what it requested, as methods see it, and let it run to its next request or its end."""
        self.n_sim += count_simulations(seen)
        self._advance(lambda: self._steps.send(cast(FloatArray, seen)))  # see `samplers.method.request_terms`

    def interrupt(self) -> None:
        """End the run: its outcome is what the method concludes from the values of f so far."""
        self.outcome = NOT_KNOWN
        if self.n_sim:
            try:
                self._steps.throw(Interrupted())
            except StopIteration as end:
                self.outcome = _check_outcome(end.value)
            except Interrupted:
                pass
        self._steps.close()

    def _advance(self, resume: Callable[[], FloatArray | Request]) -> None:
        """Resume the method until it requests at least one point or returns its outcome."""
        try:
            self.requested = self._check_request(resume())
            while len(self.requested) == 0:
                self.requested = self._check_request(self._steps.send(np.empty(0)))
        except StopIteration as end:
            self.outcome = _check_outcome(end.value)

    def _check_request(self, given: FloatArray | Request) -> Request:
        """Return a request, or points as one; raise unless it is offered, of a right shape and within the budget."""
        request = given if isinstance(given, Request) else Request("f", (np.asarray(given, dtype=np.float64),))
        offer, n = self._inputs.offer, len(request.x) if request.x.ndim else 0
        no_gradients = request.kind == "gradient" and (offer is None or offer.gradient_cost is None)
        if request.kind != "f" and (offer is None or n == 0 or no_gradients):
            raise RuntimeError(f"The method asked for {request.kind} that the run cannot give.")
        if request.x.ndim != 2 or request.x.shape[1] != self._inputs.dim:
            raise ValueError(f"Expected x of shape (n, {self._inputs.dim}), got {request.x.shape}.")
        if request.kind == "gradient" and offer is not None:
            n = offer.count_gradients(n)
        if self.n_sim + n > self.goal.budget:
            raise RuntimeError(
                f"The method asked for {n} simulations with {self.goal.budget - self.n_sim} of "
                f"max_sim={self.goal.max_sim} left; a method must keep to goal.max_sim."
            )
        return request


def outcomes_of(answer: Answer) -> FloatArray | None:
    """Return the outcomes f (n,) of an answer; None for gradients, which have none."""
    if isinstance(answer, TermGradients):
        return None
    return answer.f if isinstance(answer, Terms) else answer


def count_simulations(answer: Answer) -> int:
    """Return the simulations behind an answer: its rows or, for gradients, what they cost, as a whole number."""
    f = outcomes_of(answer)
    return whole_simulations(cast(TermGradients, answer).cost) if f is None else len(f)


def _check_outcome(value: object) -> Outcome:
    """Return the value; raise a TypeError unless it is an Outcome."""
    if not isinstance(value, Outcome):
        raise TypeError(f"Expected the steps of the method to return an Outcome, got {value!r}.")
    return value


# Several as one

UNINFORMATIVE_COV = 1.0
"""From this c.o.v. on the p of a run adds nothing to its interval."""
DISAGREEMENT_LEVEL = 1e-4
"""Probability that runs whose errors are right are said to disagree."""
STATUS_PRIORITY = (Status.STOPPED, Status.STALLED, Status.BUDGET, Status.CONVERGED)
"""The status of the combined runs is the first of these that one of them has."""


def combine(outcomes: Sequence[Outcome], confidence: float) -> Outcome:
    """Return R independent runs as one: pooled counts, or their mean with a t interval.

    If every run is a share k_i / n_i of independent draws, the draws are those of one longer run, with the
    Clopper-Pearson interval: a t interval would ignore that the spread of counts is known. Otherwise p is the mean of
    p-hat (unbiased; its logarithm is not). Runs that were stopped before their end are left out of the mean if any run
    came to its end: one that has not reached the failures has p-hat = 0. Their levels stay in the trace. Of sums over
    strata each part is combined so, and the parts are added.
    """
    if len(outcomes) == 1:
        return outcomes[0]
    trace = tuple(replace(level, run=i) for i, outcome in enumerate(outcomes) for level in outcome.trace)
    if outcomes[0].parts:
        same = [list(parts) for parts in zip(*(outcome.parts for outcome in outcomes), strict=True)]
        wholes = [replace(combine(_list_known(parts), confidence), trace=()) for parts in same]
        counts_of = [sum(part.n_sim for part in parts) for parts in same]
        added = zip(outcomes[0].parts, wholes, counts_of, strict=True)
        return sum_strata([replace(part, outcome=whole, n_sim=n) for part, whole, n in added], confidence, trace)
    ended = [each for each in outcomes if each.status is not Status.STOPPED] or outcomes
    used = outcomes if pool_counts(outcomes) else ended
    counts = pool_counts(used)
    shares = [each.counts[1] / counts[1] if counts and each.counts else 1 / len(used) for each in used]
    remarks, weights = _collect_texts([each.remarks for each in used]), _share_weights(outcomes, used, shares)
    if counts:
        hits, n = counts
        no_outcome = sum(each.no_outcome_share * each.counts[0] for each in used if each.counts)
        whole = Outcome.of_counts(hits, n, confidence, trace, no_outcome / hits if hits else 0.0)
        sample, chosen = _merge_samples(used, shares), _merge_choices(used)
        return replace(whole, sample=sample, draw_weights=weights, remarks=remarks, chosen=chosen)
    left_out = len(outcomes) - len(used)
    about = (f"{left_out} of {len(outcomes)} runs were stopped before their end and left out.",) if left_out else ()
    if len(used) == 1:
        return replace(used[0], trace=trace, warnings=(*used[0].warnings, *about), draw_weights=weights)
    p = np.array([outcome.p for outcome in used])
    mean = float(p.mean())
    present = {outcome.status for outcome in used}
    status = next((each for each in STATUS_PRIORITY if each in present), Status.BUDGET)
    return Outcome(
        p=mean,
        interval=_mean_interval(used, p, confidence),
        cov=combined_cov(used),
        status=status if mean > 0 else Status.NO_HITS,
        warnings=(*_collect_texts([outcome.warnings for outcome in used]), *about, *_warn_of_disagreement(used, p)),
        remarks=remarks,
        trace=trace,
        no_outcome_share=(float(np.average([o.no_outcome_share for o in used], weights=p)) if mean else 0.0),
        sample=_merge_samples(used, shares),
        base_draws=sum(outcome.base_draws for outcome in used),
        draw_weights=weights,
        chosen=_merge_choices(used),
    )


def _merge_choices(outcomes: Sequence[Outcome]) -> Choice | None:
    """Return the choice of the first run, with the words of those that chose otherwise."""
    choices = [outcome.chosen for outcome in outcomes if outcome.chosen is not None]
    why = "; ".join(dict.fromkeys(choice.why for choice in choices))
    return replace(choices[0], why=why, unusual=any(choice.unusual for choice in choices)) if choices else None


def _list_known(parts: Sequence[Part]) -> list[Outcome]:
    """Return the outcomes of a stratum in several runs; one that has not simulated it beside others is as stopped."""
    some = any(part.n_sim for part in parts)
    return [replace(part.outcome, status=Status.STOPPED) if some and not part.n_sim else part.outcome for part in parts]


def pool_counts(outcomes: Sequence[Outcome]) -> tuple[int, int] | None:
    """Return failing and all draws of the runs together; None if a run is no share of plain draws."""
    counts = [outcome.counts for outcome in outcomes if outcome.counts is not None]
    if len(counts) < len(outcomes):
        return None
    return sum(hits for hits, _ in counts), sum(n for _, n in counts)


def combined_cov(outcomes: Sequence[Outcome]) -> float:
    """Return the c.o.v. of the combined runs: of pooled counts or, for a mean, the larger of the own and that seen."""
    counts = pool_counts(outcomes)
    if counts is not None:
        hits, n = counts
        return binomial_cov(hits / n, n)
    if outcomes[0].parts:
        return combine(outcomes, Goal.confidence).cov
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


def _mean_interval(outcomes: Sequence[Outcome], p: FloatArray, confidence: float) -> Interval:
    """Return the interval p_bar exp(-+ t s / sqrt(R)) of the mean of p (R,), t with R - 1 degrees of freedom.

    s is the standard deviation of log p-hat (of p-hat / p_bar, where a run has p-hat = 0), but at least a third of the
    runs' own c.o.v. Where no run has a c.o.v. under 1 their spread is not known either: the interval then covers the
    intervals of all runs.
    """
    mean, runs = float(p.mean()), len(p)
    if np.ptp(p) == 0 or min(outcome.cov for outcome in outcomes) >= UNINFORMATIVE_COV:
        return min(o.interval[0] for o in outcomes), max(o.interval[1] for o in outcomes)
    spread = float(np.log(p).std(ddof=1)) if p.all() else float((p / mean).std(ddof=1))
    spread = max(spread, 1 / 3 * _own_error(outcomes))  # runs are closer together by chance, such as counts that tie
    half = float(stdtrit(runs - 1, 0.5 + confidence / 2)) * spread / math.sqrt(runs)
    return mean * math.exp(-half), min(1.0, mean * math.exp(half))


def _warn_of_disagreement(outcomes: Sequence[Outcome], p: FloatArray) -> list[str]:
    """Return a warning if runs with p (R,) lie further apart than their errors allow: some of them missed a region."""
    # runs may understate their own errors
    error = 1.5 * np.array([outcome.p * outcome.cov if outcome.p > 0 else 0.0 for outcome in outcomes])
    if len(p) < 3 or not (error > 0).all():
        return []
    with np.errstate(over="ignore"):  # inf is far enough apart
        apart = float((((p - p.mean()) / error) ** 2).sum())
    if chdtrc(len(p) - 1, apart) > DISAGREEMENT_LEVEL:
        return []
    return [f"The runs disagree ({p.min():.2e} to {p.max():.2e}): some of them may have missed a failure region."]


def _merge_samples(outcomes: Sequence[Outcome], shares: Sequence[float]) -> Sample | None:
    """Return the points behind a mean of R runs with these shares, or None if a run does not give its own."""
    samples = [outcome.sample for outcome in outcomes if outcome.sample is not None]
    if len(samples) < len(outcomes):
        return None
    first_units = np.cumsum([0, *(sample.n_units for sample in samples)])
    parts = list(zip(first_units, shares, samples, strict=False))
    layers = tuple(
        replace(layer, weights=share * layer.weights, units=first + layer.units)
        for first, share, sample in parts
        for layer in sample.all_layers
    )
    return Sample(
        f=np.concatenate([sample.f for sample in samples]),
        weights=np.concatenate([share * sample.weights for _, share, sample in parts]),
        units=np.concatenate([first + sample.units for first, _, sample in parts]),
        n_units=int(first_units[-1]),
        x=np.concatenate([sample.x for sample in samples]),
        layers=layers if any(sample.layers for sample in samples) else (),
        lineages=sum(sample.lineages for sample in samples),
    )


def _share_weights(
    outcomes: Sequence[Outcome], used: Sequence[Outcome], shares: Sequence[float]
) -> tuple[DrawWeights, ...]:
    """Return the weights of single simulations in a mean of the runs used, by share; none where a run gives none."""
    if not all(outcome.draw_weights for outcome in used):
        return ()
    number = {id(outcome): run for run, outcome in enumerate(outcomes)}
    return tuple(
        replace(weights, run=number[id(outcome)], log_share=weights.log_share + math.log(share))
        for outcome, share in zip(used, shares, strict=True)
        for weights in outcome.draw_weights
    )


def _collect_texts(of_runs: Sequence[tuple[str, ...]]) -> tuple[str, ...]:
    """Return the warnings or remarks of runs, each once, with the number of runs that have it."""
    texts = Counter(text for run in of_runs for text in run)
    return tuple(f"In {count} of {len(of_runs)} runs: {text}" for text, count in texts.items())


# Strata

UNRESOLVED_SHARE = 0.1
"""Part of p from which what strata that are not resolved may add is worth a remark."""
SETTLED = 1.8
"""Upper limit of a sum over its p up to which its run has converged: that of a c.o.v. of 0.3."""
WIDEST = 1000.0
"""Upper limit of an interval over its lower limit from which on it says no more than its upper limit; assumed."""
FEW_SEARCHES = 10
"""Fewer independent searches reached failure, and ..."""
POOR_RATE = 0.02
"""... each draw of the proposal is worth less than this part of a failure: then the regions found are badly described
and others likely. If f misleads searches, such runs gave 1e-11 with a c.o.v. of 0.1 for a p above 1e-8. Of 188
searches of 4,000 simulations on the problems of the benchmark 7 were such, all with a c.o.v. above 0.15."""


def is_resolved(outcome: Outcome) -> bool:
    """Return whether failures were met often enough to say how likely they are, not only how likely at most.

    They were where plain draws met one; of a search the c.o.v. is to be below 1, the ends of the interval less than
    three decades apart, and what few searches found well described.
    """
    (low, high), sample = outcome.interval, outcome.sample
    if outcome.p == 0 or outcome.counts is not None:
        return outcome.p > 0
    if outcome.cov >= UNINFORMATIVE_COV or high >= WIDEST * low:
        return False
    if sample is None or sample.lineages >= FEW_SEARCHES:
        return True
    failing = sample.weights[np.argsort(sample.f, kind="stable")[: len(sample.x)]]
    return effective_number(failing) >= POOR_RATE * sample.n_units


def _settle(part: Part, confidence: float) -> Part:
    """Return a part that says whether it is resolved; if not, p_k lies between 0 and what its base draws allow."""
    found, resolved = part.outcome, is_resolved(part.outcome)
    if found.p > 0 and not resolved:
        high = max(found.interval[1], clopper_pearson(0, found.base_draws, confidence)[1])
        found = replace(found, interval=(0.0, high))
    n_units = 0 if found.sample is None else found.sample.n_units
    return replace(part, outcome=found, resolved=resolved, n_units=n_units)


def may_add(parts: Sequence[Part], p: float) -> float:
    """Return what parts that are not resolved may add to p > 0; 0 if that is less than a tenth of p."""
    most = math.hypot(*(part.share * part.interval[1] for part in parts if not part.resolved))
    return most if most > UNRESOLVED_SHARE * p > 0 else 0.0


def find_low_end(parts: Sequence[Part]) -> float:
    """Return the lower limit of the sum, which is that of the parts that are resolved."""
    known = [part for part in parts if part.resolved]
    below = math.hypot(*(part.share * (part.p - part.interval[0]) for part in known))
    return max(0.0, math.fsum(part.share * part.p for part in known) - below)


def sum_strata(parts: Sequence[Part], confidence: float, trace: tuple[Level, ...]) -> Outcome:
    """Return p = sum_k w_k p_k over independent estimates of all strata.

    Its ends come from those of the parts, l_k and h_k (method of variance estimates recovery, Zou and Donner, 2008):

        p - sqrt(sum_k (w_k (p_k - l_k))^2),    p + sqrt(sum_k (w_k (h_k - p_k))^2),

    so that a part without a failure raises the upper limit alone. What is said of such a part is a remark where other
    parts failed: its upper limit rests on the draws from its base. So does that of a part whose search found failures,
    but too few to say how likely they are (`is_resolved`), and the lower limit leaves its p_k out. A sum has converged
    where all parts have and its own upper limit is below 1.8 p.

    References:
        Zou and Donner, "Construction of confidence limits about effect measures: a general approach", Statistics in
        Medicine 27, 2008.
    """
    p = sum(part.share * part.p for part in parts)
    of_sum = [part.share * part.p / p if p > 0 else math.nan for part in parts]
    parts = tuple(replace(_settle(part, confidence), of_sum=of) for part, of in zip(parts, of_sum, strict=True))
    found, present = [part for part in parts if part.p > 0], {part.outcome.status for part in parts}
    low = find_low_end(parts)
    above = math.hypot(*(part.share * (part.interval[1] - part.p) for part in parts))
    status = next((each for each in STATUS_PRIORITY if each in present), Status.NO_HITS)
    if status is Status.CONVERGED and p + above > SETTLED * p:
        status = Status.BUDGET
    warnings, remarks = list[str](), list[str]()
    for part in parts:
        resolved = p == 0 or part.outcome.status is not Status.NO_HITS
        (warnings if resolved else remarks).extend(f"{part.name}: {text}" for text in part.outcome.warnings)
        remarks += [f"{part.name}: {text}" for text in part.outcome.remarks]
    if most := may_add(parts, p):
        names = " and ".join(part.name for part in parts if not part.resolved)
        remarks.append(f"{names} may add up to {most:.1e}; the relative error is that of the failures found.")
    simulated = [part for part in parts if part.n_sim]
    known = all(part.outcome.draw_weights for part in simulated)
    return Outcome(
        p=min(p, 1.0),
        interval=(low, min(p + above, 1.0)),
        cov=math.hypot(*(part.of_sum * part.cov for part in found)) if found else math.inf,
        status=status if p > 0 or status is Status.STOPPED else Status.NO_HITS,
        warnings=tuple(warnings),
        remarks=tuple(remarks),
        trace=trace,
        sample=_add_samples(parts),
        base_draws=sum(part.outcome.base_draws for part in parts),
        no_outcome_share=min(sum(part.of_sum * part.outcome.no_outcome_share for part in found), 1.0),
        draw_weights=tuple(
            replace(weights, log_share=weights.log_share + math.log(part.share))
            for part in simulated
            for weights in part.outcome.draw_weights
            if known
        ),
        parts=parts,
    )


def dilute(found: Outcome, nothing: Outcome, share: float) -> Outcome:
    """Return the mean of a run with this share and of one that met no failure."""
    low, high = found.interval
    return replace(
        found,
        p=share * found.p,
        interval=(share * low, max(share * high, nothing.interval[1])),
        sample=_merge_samples([found, nothing], [share, 1 - share]),
        base_draws=found.base_draws + nothing.base_draws,
        draw_weights=tuple(replace(each, log_share=each.log_share + math.log(share)) for each in found.draw_weights),
    )


def _add_samples(parts: Sequence[Part]) -> Sample | None:
    """Return the points of all strata, weighted under the whole base; None if a stratum has none to give.

    The share that searches may have missed is that of each stratum, weighted by its share of the sum: about 0.1 / nu.
    """
    whole = _merge_samples([part.outcome for part in parts], [part.share for part in parts])
    if whole is None:
        return None
    missed = sum(part.of_sum / s.lineages for part in parts if part.p > 0 and (s := part.outcome.sample) is not None)
    return replace(whole, lineages=1 / missed if missed > 0 else math.inf)
