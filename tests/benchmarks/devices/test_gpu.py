"""Rates of a GPU, measured here on the CPU: the same parts, and goals that are told apart."""

from pathlib import Path
from typing import Any

import pytest

from benchmarks.devices import gpu


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
    import json

    record = json.loads(Path("benchmarks/results/gpu.json").read_text(encoding="utf-8"))
    assert "H100" in record["gpu"]
    assert gpu.find_missed(record) == []
