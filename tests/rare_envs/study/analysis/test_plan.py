"""Plans from a result that anybody may have written, and from pilots."""

from __future__ import annotations

from typing import Any

import pytest

from rare_envs.study import Question
from rare_envs.study.errors import BadInput
from rare_envs.study.plan import plan_by_pilots, plan_from_result

RECORDED = {
    "p": 1e-3,
    "cov": 0.1,
    "n_sim": 1000,
    "final_draws": 400,
    "seconds": 10.0,
    "method": {"name": "ce", "settings": {}},
}


def test_a_result() -> None:
    own, plain = plan_from_result(RECORDED, 0.05)
    assert (own.method, own.n_sim, own.seconds, plain.n_sim) == ("ce", 2200, 22.0, 399_600)
    chains = {**RECORDED, "method": {"name": "adss"}}
    assert plan_from_result(chains, 0.05)[0].n_sim == 5000  # five runs


@pytest.mark.parametrize(
    "values",
    [
        {"p": None},
        {"p": "1e-3"},
        {"cov": None},
        {"cov": 0.9},
        {"p": 0.0},
        {"n_sim": -5},
        {"n_sim": True},
        {"seconds": [1]},
        {"final_draws": 2000},
        {"final_draws": {}},
        {"method": "ce"},
        {"method": {"name": "magic"}},
        {"method": {"name": ["ce"]}},
    ],
)
def test_a_result_that_is_none(values: dict[str, Any]) -> None:
    with pytest.raises(BadInput) as refused:
        plan_from_result({**RECORDED, **values}, 0.05)
    assert "\n" not in str(refused.value)


def test_pilots_of_two_methods(risky: str) -> None:
    question = Question(env_id="rare_envs/CarFollowing-v0", base=risky, horizon=4.0, max_sim=2000)
    found = plan_by_pilots(question, ["mc", "adss"], 0.05)
    assert [each.method for each in found] == ["adss", "mc"]
    assert all(each.n_sim > 1000 and each.seconds for each in found)
    with pytest.raises(BadInput, match="magic"):
        plan_by_pilots(question, ["mc", "magic"], 0.05)
