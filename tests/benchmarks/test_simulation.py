"""Rates of the simulation: operations counted by hand, floors kept or missed, and the parts of a GPU on the CPU."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import rare_envs
from benchmarks.devices import gpu
from benchmarks.simulation import throughput
from benchmarks.simulation.bound import bound_rate, bound_seconds, count_operations


def test_each_kind_is_counted_by_its_results():
    a, b = torch.ones(2, 3), torch.ones(3, 5)

    def work() -> None:
        ((a + 1.0).clamp(min=0.0) / 2.0).sin()  # 6 each of: sum, clamp, quotient, sine
        a @ b  # 2 x 5 results of 3 products and 3 sums
        torch.nn.functional.linear(a, b.T, torch.ones(5))
        a.sum()  # reads 6
        torch.cat((a, a)).view(-1)[::2].clone()  # moves

    assert count_operations(work) == {"simple": 6 + 6 + 6, "roots": 6, "curves": 6, "products": 60 + 60}


def test_the_bound_is_the_longer_of_arithmetic_and_memory():
    machine = {"simple": 100.0, "roots": 10.0, "bytes": 50.0}
    assert bound_seconds({"simple": 100, "roots": 10}, machine) == pytest.approx(2.0)
    assert bound_seconds({"simple": 100, "roots": 10}, machine, n_bytes=200) == pytest.approx(4.0)


@pytest.mark.parametrize("env_id", ["rare_envs/CutIn-v0", pytest.param("rare_envs/Highway-v0", marks=pytest.mark.slow)])
def test_a_rollout_of_twice_the_time_has_half_the_bound(env_id):
    machine = dict.fromkeys(("simple", "roots", "curves", "products"), 1e9) | {"bytes": 1e10}
    rates = []
    for horizon in (2.0, 4.0):
        problem = rare_envs.DrivingProblem(env_id, horizon=horizon, core="torch", noise="fixed")
        rates.append(bound_rate(problem.evaluate, problem.base.sample(4, np.random.default_rng(0)), machine))
    assert rates[0] / rates[1] == pytest.approx(2.0, rel=0.2)


@pytest.mark.slow
def test_the_memory_of_a_highway_is_measured():
    """In a process of its own: the peak is that of the process, tests before this one included."""
    code = "from benchmarks.simulation.throughput import highway_memory; print(highway_memory(rollouts=8)['peak_gib'])"
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert 0.1 < float(shown) < throughput.CEILINGS["highway_memory"]


@pytest.mark.slow
def test_rates_are_measured_against_those_of_something_known(monkeypatch):
    highway = throughput.measure_highway(batch=2, rounds=1)
    assert highway["ratio"] == highway["per_second"] / highway["reference_per_second"] > 0
    camera = throughput.measure_camera(batch=2, rounds=1)
    assert camera["slow_down"] == camera["lidar_per_second"] / camera["per_second"] > 0
    monkeypatch.setattr(throughput, "ANSWER_SIMULATIONS", 500)
    monkeypatch.setattr(throughput, "LEAST_ESTIMATES", 1)
    row = throughput.measure_answer(throughput.CAR_FOLLOWING, rounds=1)
    assert row["slow_down"] == row["seconds"] / row["call_seconds"] > 0
    assert row["compiled"] == 1.0


def test_floors_and_ceilings_are_kept_or_missed(capsys):
    assert throughput.judge("env_step", {"ratio": 20.0})
    assert not throughput.judge("env_step", {"ratio": 19.9})
    assert not throughput.judge("answer_cut_in", {"slow_down": 8.1})
    assert throughput.judge("memory", {"peak_gib": 1.9})
    assert "8.1 times the time of one call of torch (ceiling 8)" in capsys.readouterr().out


def test_every_part_is_measured_and_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gpu, "QUESTIONS", {"cut_in": gpu.QUESTIONS["cut_in"]})
    monkeypatch.setattr(gpu, "COMPILED", ())
    monkeypatch.setattr(gpu, "BATCHES", (3,))
    monkeypatch.setattr(gpu, "CPU_BATCH", 5)
    rates = gpu.measure_rollouts("cut_in", (3,), "cpu")
    assert rates["batches"]["3"]["vehicle_steps"] > 0.0 < rates["unrecorded_1024"]
    assert list(rates["one_core"]) == ["torch"]
    assert gpu.measure_steps(gpu.CUT_IN, 2) > 0.0


def test_a_goal_that_is_missed_is_named() -> None:
    def reached(**rates: float) -> dict[str, Any]:
        return {"rollouts": {name: {"batches": {"1": {"vehicle_steps": rate}}} for name, rate in rates.items()}}

    assert gpu.find_missed(reached(car_following=2e7, highway=3e6)) == []
    assert gpu.find_missed(reached(car_following=2e7, highway=3e5)) == ["highway: 3e+05, goal 2e+06"]


def test_the_record_is_of_a_gpu_and_reaches_the_goals() -> None:
    record = json.loads(Path("benchmarks/results/gpu.json").read_text(encoding="utf-8"))
    assert "H100" in record["gpu"]
    assert gpu.find_missed(record) == []
