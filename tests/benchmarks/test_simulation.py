"""Rates of the simulation: floors kept or missed, and the parts of a GPU on the CPU."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from benchmarks.devices import gpu
from benchmarks.simulation import throughput


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
