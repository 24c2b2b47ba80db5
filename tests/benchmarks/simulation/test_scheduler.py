"""Schedules of chunks on workers, against ones that are counted by hand."""

import json
import sys
from types import SimpleNamespace

import pytest

from benchmarks.simulation import scheduler


def test_workers_take_the_next_chunk_when_they_are_free_and_a_batch_waits_for_its_last():
    wall, utilisation = scheduler.simulate_schedule([[3.0, 1.0, 1.0, 1.0], [2.0]], workers=2)
    assert (wall, utilisation) == (3.0 + 2.0, [1.0, 0.5])


def test_no_schedule_of_equal_chunks_is_above_the_bound():
    sizes = [100, 40, 7, 1]
    for workers in (1, 3, 10, 99, 1000):
        batches = [[1.0] * n for n in sizes]
        wall, _ = scheduler.simulate_schedule(batches, workers)
        assert scheduler.bound_utilisation(sizes, workers) == pytest.approx(sum(sizes) / (wall * workers), rel=1e-12)


def test_stages_end_where_the_trace_has_as_many_simulations():
    """Two batches of 10 and 20, one of 5, and two of 1,000: three stages, each chunk of 1 s on 1,000 workers."""
    sizes = [10, 20, 5, 1000, 1000]
    result = SimpleNamespace(trace=[SimpleNamespace(n_sim=n) for n in (30, 5, 2000)])
    stages = scheduler.share_stages(result, sizes, [[1.0] * n for n in sizes])
    assert [(stage["batches"], stage["n_sim"]) for stage in stages] == [(2, 30), (1, 5), (2, 2000)]
    assert [stage["share_of_time"] for stage in stages] == [0.4, 0.2, 0.4]
    assert [stage["utilisation"] for stage in stages] == pytest.approx([0.015, 0.005, 1.0])


def test_every_run_is_written_when_it_is_done(tmp_path, monkeypatch):
    """The second run is interrupted; the first one is in the file."""

    def record(budget, replicates):
        if budget == 2:
            raise KeyboardInterrupt
        return [3, 1], SimpleNamespace(cov=0.1, trace=[SimpleNamespace(n_sim=4)])

    out = tmp_path / "found.json"
    (tmp_path / "times.json").write_text('{"seconds_of_a_drive": [1.0]}')
    monkeypatch.setattr(scheduler, "record_batches", record)
    monkeypatch.setattr(scheduler, "RUNS", ((1, 1), (2, 1)))
    monkeypatch.setattr(sys, "argv", ["scheduler", "--out", str(out), "--times", str(tmp_path / "times.json")])
    with pytest.raises(KeyboardInterrupt):
        scheduler.main()
    (run,) = json.loads(out.read_text())["runs"]
    assert run["utilisation"] == [1.0, *(4 / (2 * workers) for workers in scheduler.WORKERS[1:])]
