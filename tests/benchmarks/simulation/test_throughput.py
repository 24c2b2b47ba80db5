import subprocess
import sys

import pytest

from benchmarks.simulation import throughput


def test_the_highway_is_measured_against_highway_env():
    row = throughput.measure_highway(batch=2, rounds=1)
    assert row["ratio"] == row["per_second"] / row["reference_per_second"] > 0
    assert {f"highway_{batch}" for batch in throughput.BATCHES} < set(throughput.FLOORS)


@pytest.mark.slow
def test_the_memory_of_a_highway_is_measured():
    """In a process of its own: the peak is that of the process, tests before this one included."""
    code = "from benchmarks.simulation.throughput import highway_memory; print(highway_memory(rollouts=8)['peak_gib'])"
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert 0.1 < float(shown) < throughput.CEILINGS["highway_memory"]


@pytest.mark.slow
def test_the_camera_is_measured_against_lidar():
    row = throughput.measure_camera(batch=2, rounds=1)
    assert row["slow_down"] == row["lidar_per_second"] / row["per_second"] > 0


@pytest.mark.slow
def test_an_answer_is_measured_against_one_call(monkeypatch):
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


def test_a_rate_stands_beside_what_the_core_allows(capsys):
    machine = {"simple": 1e10, "roots": 1e9, "curves": 1e8, "products": 1e10, "bytes": 1e10}
    bound = throughput.count_bound(machine, throughput.CAR_FOLLOWING)
    assert 2e4 < bound < 1e6  # 100 ticks of a curve, some roots and some dozens of sums: about 1.5e-6 s
    row = throughput.stand_by_bound({"per_second": 0.184 * bound, "ratio": 30.0}, bound)
    assert throughput.judge("env_step", row)
    assert "18 % of this core's bound" in capsys.readouterr().out


def test_a_record_says_what_was_measured_where():
    described = throughput.describe_run({"simple": 1e10})
    assert described["rates"] == {"simple": 1e10}
    assert {"processor", "python", "torch", "rare_envs"} <= {name for name, value in described.items() if value}
    assert described["commit"] == "" or len(described["commit"].removesuffix("-dirty")) >= 7
