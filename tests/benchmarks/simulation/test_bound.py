"""Operations are counted by hand, and the bound is theirs."""

import numpy as np
import pytest
import torch

import rare_envs
from benchmarks.simulation.bound import OperationCount, bound_rate, bound_seconds, count_operations, measure_machine


def test_each_kind_is_counted_by_its_results():
    a, b = torch.ones(2, 3), torch.ones(3, 5)

    def work() -> None:
        ((a + 1.0).clamp(min=0.0) / 2.0).sin()  # 6 each of: sum, clamp, quotient, sine
        a @ b  # 2 x 5 results of 3 products and 3 sums
        torch.nn.functional.linear(a, b.T, torch.ones(5))
        a.sum()  # reads 6
        torch.cat((a, a)).view(-1)[::2].clone()  # moves

    assert count_operations(work) == {"simple": 6 + 6 + 6, "roots": 6, "curves": 6, "products": 60 + 60}


def test_an_operation_of_no_known_kind_is_refused():
    with OperationCount(), pytest.raises(ValueError, match="known kind, got 'lgamma'"):
        torch.ones(3).lgamma()


def test_the_bound_is_the_longer_of_arithmetic_and_memory():
    machine = {"simple": 100.0, "roots": 10.0, "bytes": 50.0}
    assert bound_seconds({"simple": 100, "roots": 10}, machine) == pytest.approx(2.0)
    assert bound_seconds({"simple": 100, "roots": 10}, machine, n_bytes=200) == pytest.approx(4.0)


@pytest.mark.parametrize("env_id", ["rare_envs/CarFollowing-v0", "rare_envs/CutIn-v0", "rare_envs/Highway-v0"])
def test_a_rollout_of_twice_the_time_has_half_the_bound(env_id):
    machine = dict.fromkeys(("simple", "roots", "curves", "products"), 1e9) | {"bytes": 1e10}
    rates = []
    for horizon in (2.0, 4.0):
        problem = rare_envs.DrivingProblem(env_id, horizon=horizon, core="torch", noise="fixed")
        rates.append(bound_rate(problem.evaluate, problem.base.sample(4, np.random.default_rng(0)), machine))
    assert rates[0] / rates[1] == pytest.approx(2.0, rel=0.2)


def test_a_core_is_faster_at_sums_than_at_quotients_and_curves():
    rates = measure_machine()
    assert rates["simple"] > rates["roots"] > 1e8
    assert rates["simple"] > rates["curves"] > 1e7
