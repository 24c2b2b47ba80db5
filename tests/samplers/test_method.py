"""Outcomes, contract and base class of a method; checks of arguments."""

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest

import samplers
from samplers.method import Outcome, no_outcome_share
from samplers.methods.base import Method
from samplers.statistics import binomial_cov, clopper_pearson


@pytest.mark.parametrize(("hits", "n"), [(1, 50), (20, 400), (400, 400)])
def test_outcome_of_counts_is_the_binomial_share(hits, n):
    outcome = samplers.Outcome.of_counts(hits, n, 0.9, trace=())
    assert outcome.p == hits / n
    assert outcome.interval == clopper_pearson(hits, n, 0.9)
    assert outcome.cov == binomial_cov(hits / n, n)
    assert (outcome.counts, outcome.base_draws, outcome.status) == ((hits, n), n, "converged")


def test_no_hit_has_a_one_sided_interval_and_a_warning():
    outcome = samplers.Outcome.of_counts(0, 1000, 0.95, trace=())
    assert (outcome.p, outcome.cov, outcome.status) == (0.0, math.inf, "no_hits")
    assert outcome.interval[0] == 0 < outcome.interval[1] < 0.01
    assert outcome.warnings == ("None of 1,000 simulations failed: p = 0 with a one-sided interval.",)


def test_all_or_none_without_an_outcome_is_exact_whatever_the_weights():
    log_weights = np.log(np.array([0.1, 0.2, 0.7]))
    assert no_outcome_share(np.full(3, -np.inf), log_weights) == 1.0
    assert no_outcome_share(np.zeros(3), log_weights) == 0.0


@dataclass(frozen=True, kw_only=True)
class Batches(Method):
    """Two batches of base draws."""

    n: int = 500
    name: ClassVar[str] = "batches"
    stops_at_target: ClassVar[bool] = False

    def steps(self, inputs, goal, rng):
        parts = []
        for _ in range(2):
            parts.append((yield inputs.base.sample(self.n, rng)))
        f = np.concatenate(parts)
        hits = int((f <= goal.gamma).sum())
        return Outcome.of_counts(hits, len(f), goal.confidence, [], no_outcome_share(f[f <= goal.gamma]))


PROBLEM = samplers.FunctionProblem(lambda u: 1.0 - u[:, 0], dim=2)


def test_start_gives_what_estimate_gives():
    run = Batches().start(PROBLEM, seed=3)
    asked = 0
    while not run.done:
        x = run.ask()
        asked += len(x)
        run.tell(PROBLEM.evaluate(x))
    assert asked == 1000
    assert run.result().p == samplers.estimate(PROBLEM, Batches(), seed=3).p


def test_start_needs_no_evaluate():
    """Dimension and base distribution are enough."""

    class Inputs:
        dim = 2
        base = samplers.StandardNormal(2)

    assert Batches().start(Inputs(), seed=0).ask().shape == (500, 2)


def test_wrong_arguments_are_refused_at_the_start():
    with pytest.raises(ValueError, match="confidence"):
        Batches().start(PROBLEM, confidence=2.0)
