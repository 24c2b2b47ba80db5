"""Sums over strata: p = sum_k w_k p_k, the simulations where the error of the sum is.

Every stratum has runs of its own under its own base distribution. First come pilots, a quarter of the simulations in
equal parts. The rest goes to the strata by Neyman's rule, in proportion to w_k times the width of the interval of p_k
for one simulation: that is its standard deviation where failures were met, and what may be there if none was. One
whose part of the rest is no larger than its pilot keeps the pilot; any other has a new run, and p_k is
that of the new run alone, so that the pilot decides how large the run is and adds nothing to it. Only where the new run
meets no failure and the pilot did, both count, by their simulations: so p is a little too high where failures are few.
Counts of plain draws are pooled with those of the pilot, which makes p too low by about a tenth of its standard error
(`python -m benchmarks.samplers --set strata`); plain draws after a search that resolved nothing are worth it however
few they are.

With a target c.o.v. t the pilots stop at a c.o.v. of 0.3, and runs follow in strata whose own c.o.v. is above
t / sqrt(w_k p_k / p): if all keep to that, the sum has a c.o.v. of t. A stratum without a failure goes on, as far as
max_sim allows, while it may add more than is known: w_k h_k > p, with h_k the upper limit of its p_k.

If nothing fails in a stratum, or too little to be believed (`samplers.replicate.is_resolved`), simulations that are
left are plain draws, which bring its upper limit down: so are the `plain_draws` that a problem offers if there is no
max_sim, as it does where they take seconds.

If the method is `Auto`, pilots are plain draws, and a stratum in which 0.004 of them failed goes on with plain
draws: a search gains little there, and it may miss one of many regions. So do strata that cannot add a tenth of p, and
all if there are not 300 simulations for a search of each of the others. Without max_sim and target a sum has 7,000
simulations for each stratum, 1,000 of them in its pilot; 6,000 for each search, and the rest where the error is.

References:
    Neyman, "On the two different aspects of the representative method", Journal of the Royal Statistical Society 97,
    1934.
    Etore and Jourdain, "Adaptive optimal allocation in stratified sampling methods", Methodology and Computing in
    Applied Probability 12, 2010.
"""

import math
from collections.abc import Generator, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.special import bdtrc

from samplers.method import Goal, Interrupted, Outcome, Part, PlainDraws, Stepping, Steps, offer_of
from samplers.problem import FloatArray, Inputs
from samplers.replicate import (
    DISAGREEMENT_LEVEL,
    NOT_KNOWN,
    UNRESOLVED_SHARE,
    InputsOnly,
    Replicate,
    combine,
    dilute,
    is_resolved,
    needs_another,
    pool_counts,
    sum_strata,
)
from samplers.sample import Level, Status, clopper_pearson

PILOT_DRAWS = 1000
"""Draws of a pilot of plain draws if there is no max_sim."""
OFTEN = 0.004
"""Share of the draws of a pilot that fails from which its stratum needs no search: it would gain a factor of 2 ..."""
FEWEST_HITS = 2
"""... with at least this many failures. As these stay in the estimate, p would be too large by a quarter where one were
enough, by at most a tenth with two."""
LEAST_SEARCH = 300
"""Simulations of a search in each stratum that hardly failed, at least; else all have plain draws. A search of fewer
may meet nothing where plain draws do: as what met a failure counts, p would be too large on average, by a third with
100 simulations."""
PILOT_COV = 0.3
"""C.o.v. at which pilots stop if there is a target; a larger target takes its place."""
PLENTY = 6000
"""Simulations for the search of a stratum whose pilot resolved nothing; further ones are plain draws, which all count
in its upper limit."""


@dataclass(frozen=True)
class SumOfStrata:
    """A method for one density as one for sums over strata."""

    method: Stepping
    strata: tuple[Any, ...]
    plain_draws: int = 0
    """Plain draws that are made beyond the method's own simulations if nothing fails and there is no max_sim."""

    name: ClassVar[str] = "strata"
    stops_at_target: ClassVar[bool] = True

    def steps(self, inputs: Inputs, goal: Goal, rng: np.random.Generator) -> Steps:
        """Make pilots, then runs where the error is."""
        return _Sum(self, inputs, goal, rng).steps()


Task = tuple[int, int | None, float | None, Stepping | None]
"""A run to be made: the number of its stratum, its max_sim, its target_cov, and a method in place of the usual one."""


class _Sum:
    """The state of a run of `SumOfStrata`."""

    def __init__(self, method: SumOfStrata, inputs: Inputs, goal: Goal, rng: np.random.Generator) -> None:
        self.method, self.strata, self.inputs, self.goal, self.rng = method.method, method.strata, inputs, goal, rng
        self.plain_draws, self.chooses = method.plain_draws, getattr(method.method, "chooses", False)  # as `Auto`
        nothing = replace(
            NOT_KNOWN,
            status=Status.BUDGET,
            warnings=("It was not simulated, as max_sim was used up: p = 0 means not known.",),
        )
        self.parts = [Part(name=one.name, share=float(one.share), outcome=nothing) for one in self.strata]
        self.behind = np.zeros(len(self.strata))
        """Simulations of the runs behind the outcomes."""
        self.trace = list[Level]()
        self.n_sim, self.stopped, self.at_limit = 0, False, set[int]()
        self.most = goal.max_sim
        """Simulations that are planned; None if a target, a method or the time of plain draws says when to end."""
        if self.most is None and goal.target_cov is None and self.chooses and not self.plain_draws:
            self.most = len(self.strata) * (PILOT_DRAWS + PLENTY)
        self.searched = set[int]()
        """Strata that had a run of the method chosen, or are not to have one."""

    def steps(self) -> Steps:
        """Make rounds of runs until there is nothing to add."""
        tasks, rounds = self._plan_pilots(), 0
        while tasks:
            for task in tasks:
                if not self.stopped:
                    yield from self._run(*task)
            rounds += 1
            most = 1 + self.chooses if self.goal.target_cov is None else 6
            more = not self.stopped and rounds <= most
            tasks = (self._plan_searches() if self.chooses and rounds == 1 else self._plan_more()) if more else []
        n = self.plain_draws if self.most is None else self.most - self.n_sim
        empty = [i for i in range(len(self.parts)) if self._is_unresolved(i)]
        sizes = [int(n * self.parts[i].share / sum(self.parts[k].share for k in empty)) for i in empty]
        for i, size in zip(empty, sizes, strict=True):
            if not self.stopped and size > 0.1 * self.parts[i].n_sim:  # a tenth of the simulations made
                yield from self._run(i, size, None, PlainDraws())
        whole = sum_strata(self.parts, self.goal.confidence, tuple(self.trace))
        for last in self.trace[-1:]:  # levels of a run do not know the pilot
            self.goal.on_level(replace(last, estimate=whole.p))
        return whole

    def _plan_pilots(self) -> list[Task]:
        """Return a first run for every stratum, or for the largest ones if there are fewer simulations."""
        k, n, target = len(self.parts), self.goal.max_sim, self.goal.target_cov
        target = max(target, PILOT_COV) if target is not None and self.method.stops_at_target else None
        method = PlainDraws() if self.chooses else None
        if n is None:
            return [(i, PILOT_DRAWS if self.chooses else None, target, method) for i in range(k)]
        few = n < 20 * k  # no pilots: all are made at once, in equal parts
        sizes = np.full(k, n // k if few else int(0.25 * n) // k)
        if few:
            sizes[np.argsort([-part.share for part in self.parts], kind="stable")[: n % k]] += 1
        return [(i, int(size), target, method) for i, size in enumerate(sizes) if size]

    def _plan_more(self) -> list[Task]:
        """Return the runs to make beside those made."""
        target, whole, k = self.goal.target_cov, sum_strata(self.parts, self.goal.confidence, ()), len(self.parts)
        use, targets = np.full(k, True), [target] * k
        if target is not None and whole.p > 0:
            for i, part in enumerate(whole.parts):
                targets[i] = 0.9 * (limit := target / math.sqrt(part.of_sum or 1.0))  # the sum's own p is not yet known
                late = part.p > 0 and part.cov > limit and whole.cov > target
                may_add_most = not part.resolved and part.share * part.interval[1] > whole.p
                use[i] = i not in self.at_limit and (late or may_add_most)
        elif self.most is None:
            return []
        known = self.most is not None
        sizes: list[int | None] = [int(n) for n in self._allocate(use, whole.parts)] if known else [None] * k
        methods = [self._find_method(i) for i in range(k)]
        for i, size in enumerate(sizes):
            if size is not None and methods[i] is None and not whole.parts[i].resolved:
                sizes[i] = min(size, PLENTY) if self.behind[i] < PLENTY else 0
        return [(i, sizes[i], targets[i], methods[i]) for i in range(k) if use[i] and sizes[i] != 0]

    def _plan_searches(self) -> list[Task]:
        """Return the runs after pilots of plain draws, first those of the strata that hardly failed in them.

        Those that may add to the sum have half of what is left, to a target that of a pilot, or else the simulations
        that their method likes; the others then as many plain draws as cost seconds.
        """
        k, left, target = len(self.parts), self.most and self.most - self.n_sim, self.goal.target_cov
        limited, p = self.goal.max_sim is not None, sum(part.share * part.p for part in self.parts)
        seldom = {i for i in range(k) if not self._fails_often(i)}
        rare = [i for i in seldom if self.parts[i].share * self.parts[i].interval[1] > UNRESOLVED_SHARE * p]
        if limited and left is not None and left < 2 * LEAST_SEARCH * len(rare):
            rare = []
        self.searched |= seldom - {*rare}
        if left is None and target is None:
            draws = {i: (self.plain_draws, None, PlainDraws()) for i in range(k) if i not in rare}
            return [(i, *draws.get(i, (None, None, None))) for i in range(k)]
        if not rare:
            return self._plan_more()
        if left is None:
            return [(i, None, max(target or 0.0, PILOT_COV), None) for i in rare]
        return [(i, min(PLENTY, left // (1 + limited) // len(rare)), target, None) for i in rare]

    def _fails_often(self, stratum: int) -> bool:
        """Return whether so many plain draws of a stratum failed that a search would gain little."""
        hits, n = self.parts[stratum].outcome.counts or (0, 0)
        return hits >= max(FEWEST_HITS, OFTEN * n)

    def _find_method(self, stratum: int) -> Stepping | None:
        """Return plain draws for a stratum that often fails, or that was searched in vain; else None."""
        drawn = self.parts[stratum].outcome.counts is not None
        in_vain = stratum in self.searched and (drawn or self._is_unresolved(stratum))
        return PlainDraws() if self.chooses and (self._fails_often(stratum) or in_vain) else None

    def _is_unresolved(self, stratum: int) -> bool:
        """Return whether simulations of a stratum have met no failure, or too few to say how likely they are."""
        part = self.parts[stratum]
        return part.n_sim > 0 and not is_resolved(part.outcome)

    def _allocate(self, use: NDArray[np.bool_], parts: Sequence[Part]) -> FloatArray:
        """Return how many of the simulations left each stratum gets, (k,), of those in use."""
        widths = [part.share * (part.interval[1] - part.interval[0]) for part in parts]
        need = np.sqrt(np.maximum(self.behind, 1.0)) * widths
        # a new run takes the place of the one before, and a smaller one is worse; draws are added to those before
        draws_next = [self._is_unresolved(i) and self._find_method(i) is not None for i in range(len(parts))]
        adds = [part.outcome.counts is not None or draws for part, draws in zip(parts, draws_next, strict=True)]
        least = np.where(adds, 0.0, self.behind)
        sizes = np.zeros(len(parts))
        while use.any():
            sizes = np.floor(((self.most or 0) - self.n_sim) * need * use / (need * use).sum())
            gain = np.where(use, sizes - least, math.inf)
            if gain.min() > 0:
                break
            use, sizes = use & (np.arange(len(use)) != np.argmin(gain)), 0 * sizes
        return sizes

    def _run(
        self, stratum: int, max_sim: int | None, target_cov: float | None, method: Stepping | None
    ) -> Generator[FloatArray, FloatArray, None]:
        """Make a run in a stratum; where its method does not stop at a target, as many as that takes."""
        part, n_before = self.parts[stratum], self.n_sim
        inputs = InputsOnly(self.inputs.dim, self.strata[stratum].base, offer_of(self.inputs))
        others = sum(each.share * each.p for each in self.parts if each is not part)

        def tell_level(level: Level) -> None:
            estimate = others + part.share * level.estimate
            self.goal.on_level(replace(level, stratum=part.name, estimate=estimate))

        goal = replace(self.goal, max_sim=max_sim, target_cov=target_cov, on_level=tell_level)
        if method is None:
            self.searched.add(stratum)
            method = self.method
        runs, outcomes = list[Replicate](), list[Outcome]()
        while not self.stopped and (not runs or needs_another(runs, method, goal, 1)):
            first = self.n_sim
            left = None if max_sim is None else max_sim - (first - n_before)
            own = replace(goal, max_sim=left)
            run = Replicate(method.steps(inputs, own, self.rng.spawn(1)[0]), own, inputs)
            runs.append(run)
            while run.outcome is None:
                try:
                    answer = yield run.requested  # type: ignore[misc]  # a Request; see `Steps`
                except Interrupted:
                    self.stopped = True
                    run.interrupt()
                else:
                    run.resume(answer)
            self.n_sim += run.n_sim
            self.trace += [replace(level, stratum=part.name) for level in run.outcome.trace]
            weights = tuple(replace(each, first=first + each.first) for each in run.outcome.draw_weights)
            outcomes.append(replace(run.outcome, trace=(), draw_weights=weights))
        found, n = combine(outcomes, goal.confidence), self.n_sim - n_before
        if max_sim is None and target_cov is not None and not (found.cov <= target_cov and is_resolved(found)):
            self.at_limit.add(stratum)
        whole, self.behind[stratum] = self._join(part, self.behind[stratum], found, n)
        whole = replace(whole, draw_weights=tuple(replace(each, run=0) for each in whole.draw_weights))
        used = method if found.chosen is None else found.chosen.method
        methods = ", ".join(dict.fromkeys([*filter(None, part.method.split(", ")), used.name]))
        self.parts[stratum] = replace(part, outcome=whole, n_sim=part.n_sim + n, method=methods)

    def _join(self, part: Part, n_old: float, found: Outcome, n: float) -> tuple[Outcome, float]:
        """Return the outcome of a stratum after a further run, and the simulations behind it."""
        old = part.outcome
        if n_old == 0:
            return found, n
        drawn = old.base_draws + found.base_draws
        if pool_counts([old, found]) is not None:
            pooled = replace(combine([old, found], self.goal.confidence), trace=())
            return self._bound(pooled, drawn) if pooled.p == 0 else pooled, n_old + n
        if found.status is Status.STOPPED:
            return replace(old, base_draws=drawn), n_old
        if found.interval[1] < old.interval[0]:
            about = f"The larger of two runs found less ({found.p:.1e} after {old.p:.1e}): it may have missed failures."
            hits, draws = old.counts or (0, 0)
            by_chance = hits > 0 and found.p > 0 and bdtrc(hits - 1, draws, found.interval[1]) > DISAGREEMENT_LEVEL
            of, behind = (found, n) if by_chance else (old, n_old)
            ends = min(old.interval[0], found.interval[0]), max(old.interval[1], found.interval[1])
            return replace(of, interval=ends, base_draws=drawn, warnings=(*of.warnings, about)), behind
        if found.p == 0 < old.p and found.counts is not None and not is_resolved(old):
            # plain draws say that what a search has not resolved is rare; one heavy draw may even be above their end
            most = clopper_pearson(0, drawn, self.goal.confidence)[1]
            met = old if old.p <= most else dilute(old, found, n_old / (n_old + n))
            return replace(met, interval=(min(met.interval[0], most), max(most, met.p)), base_draws=drawn), n_old
        if found.p == 0 == old.p:
            return self._bound(found, drawn), n
        if found.p == 0 < old.p:  # what the old run met is not to be lost
            return dilute(old, found, n_old / (n_old + n)), n_old + n
        return replace(found, base_draws=drawn), n

    def _bound(self, nothing: Outcome, drawn: int) -> Outcome:
        """Return an outcome without a failure, with the upper limit of all base draws, those of a search included."""
        interval = clopper_pearson(0, drawn, self.goal.confidence)
        about = f"None of {drawn:,} base draws failed: p = 0 with a one-sided interval."
        return replace(nothing, interval=interval, base_draws=drawn, warnings=(about,))
