"""Schedules of chunks on workers, against ones that are counted by hand."""

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
