import subprocess
import sys

from benchmarks.simulation import throughput


def test_the_highway_is_measured_against_highway_env():
    row = throughput.measure_highway(batch=2, rounds=1)
    assert row["ratio"] == row["per_second"] / row["reference_per_second"] > 0
    assert {f"highway_{batch}" for batch in throughput.REAL_TIME} < set(throughput.FLOORS)


def test_the_memory_of_a_highway_is_measured():
    """In a process of its own: the peak is that of the process, tests before this one included."""
    code = "from benchmarks.simulation.throughput import highway_memory; print(highway_memory(rollouts=8)['peak_gib'])"
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert 0.1 < float(shown) < throughput.MEMORY_LIMIT


def test_the_camera_is_measured_against_lidar():
    row = throughput.measure_camera(batch=2, rounds=1)
    assert row["slow_down"] == row["lidar_per_second"] / row["per_second"] > 0
