"""Plans: by pencil and paper, and against the runs that they plan."""

from __future__ import annotations

import pytest

import samplers
from samplers.analysis.gate import Pilot, plan_runs
from samplers.limit_states import half_space


def pilot(**values: object) -> Pilot:
    return Pilot(**{"method": "ce", "p": 1e-3, "cov": 0.1, "n_sim": 1000, "final_draws": 400, **values})  # type: ignore[arg-type]


def test_a_method_that_goes_on() -> None:
    own, plain = plan_runs(pilot(seconds=10.0), 0.05)
    assert (own.method, own.n_sim, own.seconds) == ("ce", 600 + 4 * 400, 22.0)
    assert (plain.method, plain.n_sim) == ("mc", 399_600)
    assert plan_runs(pilot(), 0.2)[0].n_sim == 700 and plan_runs(pilot(), 0.2)[0].seconds is None


def test_a_method_of_single_runs() -> None:
    counts = [plan_runs(pilot(final_draws=None), target)[0].n_sim for target in (0.1, 0.09, 0.05, 0.01)]
    assert counts == [1000, 5000, 5000, 100_000]


def test_monte_carlo_is_planned_once() -> None:
    """Its own formula: 10,000 draws with 100 hits have a c.o.v. of 0.0995, and 0.05 takes 39,600."""
    found = plan_runs(Pilot(method="mc", p=0.01, cov=0.0995, n_sim=10_000, final_draws=10_000), 0.05)
    assert [(each.method, each.n_sim) for each in found] == [("mc", 39_600)]


@pytest.mark.parametrize(
    ("values", "word"), [({"p": 0.0}, "no failure"), ({"cov": 0.8}, "0.8"), ({"cov": float("nan")}, "nan")]
)
def test_what_is_no_pilot(values: dict[str, float], word: str) -> None:
    with pytest.raises(ValueError, match=word):
        pilot(**values)
    with pytest.raises(ValueError, match="target_cov"):
        plan_runs(pilot(), 0.0)


@pytest.mark.parametrize("method", ["mc", "ce", "two-stage"])
def test_a_plan_is_within_a_factor_of_two(method: str) -> None:
    problem = half_space(5, 2.0).problem
    first = samplers.estimate(problem, method, seed=0, max_sim=10_000 if method == "mc" else None)
    planned = plan_runs(first.pilot(), first.cov / 2)[0]
    run = samplers.estimate(problem, method, seed=1, target_cov=first.cov / 2)
    assert 0.5 < planned.n_sim / run.n_sim < 2.0
