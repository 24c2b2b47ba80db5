"""Ray: the same bits, whatever happens to tasks, processes and machines. Skipped where Ray is not installed."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import pytest

import samplers
from samplers.execution.executors import ray_cluster
from tests.samplers.execution.executors.egos import FAULTS, KillsItself, matrix, problem
from tests.samplers.execution.executors.test_local_processes import estimate

needs_ray = pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="Ray is not installed")
slow = [pytest.mark.slow, needs_ray, pytest.mark.filterwarnings("ignore")]


def test_without_ray_there_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ValueError, match=r"^The executor ray needs Ray: pip install 'rare-envs\[ray\]'\.$"):
        estimate(problem(), "ray", 10)


@pytest.mark.parametrize("workers", [pytest.param(each, marks=slow) for each in (1, 2)])
def test_the_number_of_workers_changes_no_bit(workers: int) -> None:
    asked = samplers.FunctionProblem(matrix, dim=3)
    whole = samplers.estimate(asked, "mc", seed=3, max_sim=200, executor=samplers.InProcess())
    found = samplers.estimate(asked, "mc", seed=3, max_sim=200, executor=samplers.RayCluster(workers=workers))
    assert found == whole


@pytest.mark.parametrize("name", [pytest.param(each, marks=slow) for each in sorted(set(FAULTS) - {"hungry"})])
def test_a_bad_row_has_no_outcome(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ray_cluster, "START_SECONDS", 10.0)
    n = 60
    expected = estimate(problem(FAULTS["nan"]), samplers.InProcess(), n)
    result = estimate(problem(FAULTS[name]), samplers.RayCluster(workers=2, time_limit=2.0), n)
    assert result.p == expected.p
    assert "1 simulations gave no outcome" in " ".join(result.warnings)
    if name == "hanging":
        assert "no answer within 2 s" in " ".join(result.remarks)


@pytest.mark.parametrize("chance", [pytest.param(20, marks=slow)])
def test_workers_that_are_killed_change_no_bit(chance: int, tmp_path: Path) -> None:
    result = estimate(problem(KillsItself(tmp_path, chance), chunk_size=2), samplers.RayCluster(workers=2), 80)
    assert result == estimate(problem(chunk_size=2), samplers.InProcess(), 80)


@pytest.mark.parametrize("nodes", [pytest.param(2, marks=slow)])
def test_a_machine_that_is_lost_changes_no_bit(nodes: int) -> None:
    import time

    import ray
    from ray.cluster_utils import Cluster

    def slow_half_space(x: Any) -> float:
        time.sleep(0.05)
        return float(1.0 - x[0])

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    lost = cluster.add_node(num_cpus=1)
    try:
        ray.init(address=cluster.address, log_to_driver=False)
        left = [lost]

        def remove(progress: samplers.Progress) -> None:
            if progress.n_sim > 30 and left:
                cluster.remove_node(left.pop())

        result = estimate(problem(slow_half_space), samplers.RayCluster(), 80, progress=remove)
    finally:
        ray.shutdown()
        cluster.shutdown()
    assert not left
    assert result == estimate(problem(), samplers.InProcess(), 80)
