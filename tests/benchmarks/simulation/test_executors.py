"""The benchmark of executors: the time of n simulations without that in which workers start."""

from benchmarks.simulation import executors
from samplers import LocalProcesses


def test_time_to_start_workers_is_left_out(monkeypatch):
    """A run takes 3 s to start and 2 s a simulation here; 10 simulations take 20 s."""
    monkeypatch.setattr(executors, "run_seconds", lambda executor, chunk_size, n: 3.0 + 2.0 * n)
    assert executors.measure_seconds(workers=2, chunk_size=4, n=10) == 20.0


def test_run_takes_at_least_the_time_of_its_simulations():
    """Four simulations of 50 ms."""
    assert executors.run_seconds(LocalProcesses(1), chunk_size=2, n=4) >= 4 * executors.EGO_SECONDS
