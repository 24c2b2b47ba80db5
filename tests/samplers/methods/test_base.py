"""Base class of the methods: a user's own method runs in `estimate` and step by step."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest

import samplers
from samplers.method import Outcome, no_outcome_share
from samplers.methods.base import Method


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


def test_a_method_of_one_s_own_gives_an_estimate():
    """Share of 1000 draws beyond 1, within four standard errors of Phi(-1)."""
    result = samplers.estimate(PROBLEM, Batches(), seed=0)
    assert result.p == pytest.approx(0.15866, abs=4 * np.sqrt(0.15866 * 0.84134 / 1000))
    assert (result.n_sim, result.method) == (1000, Batches())


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
