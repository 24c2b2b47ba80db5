"""Decisions by a limit, and plans of further runs."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
from scipy import stats

import samplers
from samplers.analysis.base_error import BaseUncertainty
from samplers.analysis.gate import Pilot, judge_estimate, plan
from samplers.limit_states import half_space

BASE = BaseUncertainty(
    value=1e-4,
    interval=(1e-5, 1e-3),
    expected=2e-4,
    spread=1.0,
    bound=None,
    confidence=0.9,
    value_refits=(1e-4, 2e-4),
    ess_refits=(50.0, 50.0),
    clusters=17,
    fitted_to="38 events",
    family="1 component",
)


class Known:
    """An estimate that the gate looks at."""

    def __init__(self, warnings: tuple[str, ...] = (), sequence: tuple[float, float] | None = None) -> None:
        self.interval, self.confidence, self.warnings = (8e-5, 1.2e-4), 0.9, warnings
        self.status, self.base_draws, self.sequence = samplers.Status.CONVERGED, 500, sequence


@pytest.mark.parametrize(
    ("max_p", "base", "given", "decision"),
    [
        (2e-4, None, False, "passes"),
        (1e-4, None, False, "undecided"),
        (5e-5, None, False, "fails"),
        (2e-4, BASE, False, "undecided"),
        (2e-4, BASE, True, "passes"),
        (2e-3, BASE, False, "passes"),
        (5e-6, BASE, False, "fails"),
        (2e-3, replace(BASE, interval=None, bound=1e-3), False, "passes"),
        (5e-6, replace(BASE, interval=None, bound=1e-3), False, "undecided"),  # there is no lower end
        (2e-3, replace(BASE, interval=None, reason="no spread."), False, "undecided"),
    ],
)
def test_decisions(max_p: float, base: BaseUncertainty | None, given: bool, decision: str) -> None:
    verdict = judge_estimate(Known(), max_p, None if given else base)
    assert verdict.decision == decision and bool(verdict) is (decision == "passes")
    assert verdict.confidence == 0.95 and verdict.includes_base is (base is not None and not given)
    assert str(verdict).startswith(decision) and "\n" not in str(verdict)
    assert json.loads(json.dumps(verdict.to_dict()))["text"] == str(verdict)


def test_an_undecided_limit_names_what_would_decide_it() -> None:
    """The simulations leave 8e-5 to 1.2e-4 open, the events 1e-5 to 1e-3."""
    few = "; more recordings are needed, not simulations; it passes if the base distribution is exact"
    assert str(judge_estimate(Known(), 2e-4, BASE)).endswith(few)
    for base in (None, BASE):
        assert str(judge_estimate(Known(), 1e-4, base)).endswith("limit 0.0001; more simulations are needed")


def test_a_warning_that_p_may_be_wrong_leaves_it_undecided() -> None:
    verdict = judge_estimate(Known(warnings=("weights are uneven.",)), 2e-4, None)
    assert verdict.decision == "undecided" and "a warning says that p may be wrong: weights are un" in str(verdict)
    doubtful = replace(BASE, warnings=("the spread is large.",))
    assert judge_estimate(Known(), 2e-3, doubtful).decision == "undecided"
    few = samplers.estimate(samplers.FunctionProblem(lambda x: 3.0 - x[:, 0], dim=1), "mc", seed=0, max_sim=2000)
    assert 0 < few.failures.total < 5 and "the estimate is imprecise" in few.warnings[0]
    assert few.meets(0.02).decision == "passes" and few.meets(1e-3).decision == "undecided"


@pytest.mark.parametrize(
    ("max_p", "base", "decision"),
    [(1.3e-4, None, "undecided"), (1.5e-4, None, "passes"), (1.1e-3, BASE, "undecided"), (1.3e-3, BASE, "passes")],
)
def test_a_run_that_stopped_on_what_it_saw_is_judged_by_its_sequence(
    max_p: float, base: BaseUncertainty | None, decision: str
) -> None:
    """1.4e-4 for 1.2e-4, and what an uncertain base leaves as much further out: 1.17e-3 for 1e-3."""
    assert judge_estimate(Known(sequence=(7e-5, 1.4e-4)), max_p, base).decision == decision


@pytest.mark.parametrize("max_p", [0.0, 1.0, -1.0, float("nan"), "low"])
def test_a_limit_is_a_probability(max_p: float) -> None:
    with pytest.raises(ValueError, match="max_p"):
        judge_estimate(Known(), max_p, None)


def test_it_is_as_often_wrong_as_it_says() -> None:
    """Limits at p itself: at 95 % one-sided it passes in at most 1 of 20 runs, and fails in at most 1 of 20."""
    p = stats.norm.cdf(-2.0)
    problem = samplers.FunctionProblem(lambda x: x[:, 0] + 2.0, dim=1)
    runs = [samplers.estimate(problem, "mc", seed=seed, max_sim=2000, confidence=0.9).meets(p) for seed in range(200)]
    counts = [sum(run.decision == decision for run in runs) for decision in ("passes", "fails")]
    allowed = stats.binom.ppf(0.999, 200, 0.05)  # Clopper-Pearson's ends are wrong in 5 % at most
    assert max(counts) <= allowed
    assert sum(counts) > 0  # and they are not idle: about 8 % of 200


@pytest.mark.parametrize("method", ["mc", "two-stage"])
def test_no_failure_passes_where_base_draws_are_enough(method: str) -> None:
    """0 of n passes a limit of 1 - 0.05^(1/n), and no less; n are the base draws alone of a search."""
    problem = samplers.FunctionProblem(lambda x: x[:, 0] + 50.0, dim=1)
    result = samplers.estimate(problem, method, seed=0, max_sim=2000, confidence=0.9)
    assert result.p == 0.0 and 0 < result.base_draws and (result.base_draws == 2000) == (method == "mc")
    limit = 1 - 0.05 ** (1 / result.base_draws)
    assert result.meets(1.001 * limit) and not result.meets(0.999 * limit)


def pilot(**values: object) -> Pilot:
    return Pilot(**{"method": "ce", "p": 1e-3, "cov": 0.1, "n_sim": 1000, "final_draws": 400, **values})  # type: ignore[arg-type]


def test_a_method_that_goes_on() -> None:
    own, plain = plan(pilot(seconds=10.0), 0.05)
    assert (own.method, own.n_sim, own.seconds) == ("ce", 600 + 4 * 400, 22.0)
    assert (plain.method, plain.n_sim) == ("mc", 399_600)
    assert plan(pilot(), 0.2)[0].n_sim == 700 and plan(pilot(), 0.2)[0].seconds is None


def test_a_method_of_single_runs() -> None:
    counts = [plan(pilot(final_draws=None), target)[0].n_sim for target in (0.1, 0.09, 0.05, 0.01)]
    assert counts == [1000, 5000, 5000, 100_000]


@pytest.mark.parametrize(
    ("values", "word"), [({"p": 0.0}, "no failure"), ({"cov": 0.8}, "0.8"), ({"cov": float("nan")}, "nan")]
)
def test_what_is_no_pilot(values: dict[str, float], word: str) -> None:
    with pytest.raises(ValueError, match=word):
        pilot(**values)
    with pytest.raises(ValueError, match="target_cov"):
        plan(pilot(), 0.0)


@pytest.mark.parametrize("method", ["mc", "ce", "two-stage"])
def test_a_plan_is_within_a_factor_of_two(method: str) -> None:
    problem = half_space(5, 2.0).problem
    first = samplers.estimate(problem, method, seed=0, max_sim=10_000 if method == "mc" else None)
    planned = plan(first.pilot(), first.cov / 2)[0]
    run = samplers.estimate(problem, method, seed=1, target_cov=first.cov / 2)
    assert 0.5 < planned.n_sim / run.n_sim < 2.0
