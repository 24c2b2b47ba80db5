"""The conformance checks find what is wrong with a method; p of the limit states is exact."""

import random
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest

import samplers
from samplers.limit_states import four_branches, half_space, parabola, plateau, shell, two_modes
from samplers.sample import binomial_cov, clopper_pearson
from samplers.testing import check_method


@dataclass(frozen=True, kw_only=True)
class Plain:
    """Plain draws in batches of 500, from outside the package; `fault` says what it does wrong."""

    fault: str = ""

    name: ClassVar[str] = "plain"
    stops_at_target: ClassVar[bool] = False

    def steps(self, inputs, goal, rng):
        assert not hasattr(inputs, "evaluate")  # nobody can simulate past the books
        if self.fault == "own seed":
            rng = np.random.default_rng(1)
        if self.fault == "numpy's generator":
            np.random.random()  # noqa: NPY002
        if self.fault == "python's generator":
            random.random()
        n = min(3000, goal.budget) + (self.fault == "overspends")
        f, status = np.empty(0), samplers.Status.CONVERGED
        while len(f) < n:
            try:
                f = np.append(f, (yield inputs.base.sample(min(500, n - len(f)), rng)))
            except samplers.methods.Interrupted:
                if self.fault == "cannot be interrupted":
                    raise
                status = samplers.Status.STOPPED
                break
        hits = int(np.count_nonzero(f < goal.gamma if self.fault == "strict" else f <= goal.gamma))
        if self.fault == "chokes on infinity" and not np.isfinite(f).all():
            raise FloatingPointError("overflow")
        trace = samplers.methods.Level(
            gamma=goal.gamma, p=hits / len(f), estimate=hits / len(f), n_points=len(f), cov=0.1,
            n_sim=len(f) - (self.fault == "hides a simulation"),
        )  # fmt: skip
        p = hits / len(f) * (1.7 if self.fault == "biased" else 1.0)
        interval = clopper_pearson(hits, len(f), 0.95)
        if self.fault == "too sure":
            interval = (p, p)
        return samplers.methods.Outcome(
            p=p,
            interval=(min(p, interval[0]), max(p, interval[1])),
            cov=binomial_cov(hits / len(f), len(f)),
            status=samplers.Status.NO_HITS if hits == 0 and status is samplers.Status.CONVERGED else status,
            warnings=("nothing failed",) if hits == 0 and self.fault != "silent" else (),
            trace=(trace,),
        )


def test_a_sound_method_from_outside_passes():
    check_method(Plain())


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        ("own seed", "another seed gave the same"),
        ("numpy's generator", "draws from a global generator"),
        ("python's generator", "draws from a global generator"),
        ("cannot be interrupted", "Interrupted after batch 1: expected an Outcome"),
        ("strict", "whole numbers: expected p near 0.0668"),
        ("hides a simulation", "2500 simulations, the levels of the trace add up to 2499|3000 .* 2999"),
        ("biased", "expected|times the true p"),
        ("too sure", "expected|intervals hold the true p"),
        ("silent", "expected a warning"),
    ],
)
def test_a_fault_is_found_and_named(fault, said):
    with pytest.raises(AssertionError, match=f"'plain': .*({said})"):
        check_method(Plain(fault=fault))


def test_overspending_and_crashing_are_errors_of_their_own():
    with pytest.raises(RuntimeError, match=r"must keep to goal\.max_sim"):
        check_method(Plain(fault="overspends"))
    with pytest.raises(FloatingPointError):
        check_method(Plain(fault="chokes on infinity"))


def test_something_else_than_a_method():
    with pytest.raises(AssertionError, match="attributes name, stops_at_target and steps"):
        check_method(object())


@pytest.mark.parametrize(
    "reference",
    [
        *(half_space(3, 1.5), two_modes(distance=0.8), parabola(1.0)),
        *(four_branches(k=1.8), plateau(beta=1.5), shell(5, 0.05)),
    ],
    ids=lambda r: r.name,
)
def test_exact_probability_against_monte_carlo(rng, reference):
    """The same formulas with the failures near enough to be counted."""
    n = 400_000
    u = rng.standard_normal((n, reference.problem.dim))
    share = np.mean(reference.problem.evaluate(u) <= 0)
    assert share == pytest.approx(reference.p, abs=4 * np.sqrt(reference.p / n))
