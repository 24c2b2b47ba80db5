"""Ray: the same bits, whatever happens to tasks, processes and machines. Skipped where Ray is not installed."""

from __future__ import annotations

import hashlib
import importlib.util
import threading
import time
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import pytest

import samplers
from samplers.execution.executors import ray_cluster
from samplers.execution.executors.seeding import SeededWork
from samplers.execution.executors.transport import pack_work
from tests.samplers.execution.executors.egos import FAULTS, matrix, problem
from tests.samplers.execution.executors.test_local_processes import estimate

needs_ray = pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="Ray is not installed")
slow = [pytest.mark.slow, needs_ray, pytest.mark.filterwarnings("ignore")]


def test_without_ray_there_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ValueError, match=r"^The executor ray needs Ray: pip install 'rare-envs\[ray\]'\.$"):
        estimate(problem(), "ray", 10)


@pytest.mark.parametrize(
    ("address", "said"), [(None, "Ray does not start"), ("a:1", "No Ray cluster answers at 'a:1'")]
)
def test_a_cluster_that_does_not_start_is_one_line(
    address: str | None, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    import sys

    ended: list[bool] = []

    def init(**words: Any) -> None:
        raise OSError("The current node timed out during startup.\n  See the logs.")

    fake = SimpleNamespace(init=init, is_initialized=lambda: False, shutdown=lambda: ended.append(True))
    monkeypatch.setitem(sys.modules, "ray", fake)
    with pytest.raises(samplers.ExecutorError) as refused:
        estimate(problem(), samplers.RayCluster(address), 10)
    assert str(refused.value) == f"{said} (OSError: The current node timed out during startup. See the logs.)."
    assert ended == [True]


class FakeRay:
    """What the pool uses of Ray, with a thread for every task; a task that is cancelled is lost."""

    def __init__(self) -> None:
        self.cancelled: list[Any] = []

    def remote(self, **options: Any) -> Any:
        self.options = options

        def wrap(function: Any) -> Any:
            def submit(key: str, packed: Any, *arguments: Any) -> Any:
                task = Future[Any]()
                threading.Thread(
                    target=lambda: task.set_result(function(key, packed.value, *arguments)), daemon=True
                ).start()
                return task

            return SimpleNamespace(remote=submit)

        return wrap

    def put(self, value: Any) -> Any:
        return SimpleNamespace(value=value, hex=lambda: hashlib.sha256(value).hexdigest())

    def cluster_resources(self) -> dict[str, float]:
        return {"CPU": 3.0}

    def wait(self, tasks: list[Any], num_returns: int, timeout: float) -> Any:
        done, left = wait(tasks, timeout, FIRST_COMPLETED)
        return list(done)[:num_returns], list(left)

    def get(self, task: Any) -> Any:
        return task.result()

    def cancel(self, task: Any, force: bool) -> None:
        assert force
        self.cancelled.append(task)


class FakeCluster(ray_cluster.RayCluster):
    """A cluster of `FakeRay`."""

    fake = FakeRay()

    @contextmanager
    def open(self, work: Any, seed: int) -> Any:
        pool = ray_cluster._RayPool(self.fake, self, pack_work(SeededWork(work, seed)))
        try:
            yield pool
        finally:
            pool.close()


def test_tasks_give_the_bits_of_one_process() -> None:
    asked = samplers.FunctionProblem(matrix, dim=3)
    whole = samplers.estimate(asked, "mc", seed=3, max_sim=100, executor=samplers.InProcess())
    assert samplers.estimate(asked, "mc", seed=3, max_sim=100, executor=FakeCluster(options={"num_gpus": 0})) == whole
    assert FakeCluster.fake.options == {"num_cpus": 1, "max_retries": 0, "num_gpus": 0}


def test_a_task_that_does_not_end_is_cancelled_by_force(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ray_cluster, "START_SECONDS", 0.0)
    monkeypatch.setattr("faulthandler.dump_traceback_later", lambda seconds, exit: None)  # it would end this process
    FakeCluster.fake.cancelled.clear()
    result = estimate(problem(FAULTS["hanging"]), FakeCluster(time_limit=2.0), 60)
    assert "1 simulations gave no outcome" in " ".join(result.warnings)
    assert "no answer within 2 s" in " ".join(result.remarks)
    assert len(FakeCluster.fake.cancelled) == 3


def test_a_cluster_that_is_gone_ends_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    def gone(self: Any, tasks: Any, num_returns: int, timeout: float) -> Any:
        raise ConnectionError("the head does not answer")

    monkeypatch.setattr(FakeRay, "wait", gone)
    with pytest.raises(samplers.ExecutorError, match=r"Ray does not answer any more \(ConnectionError: the head"):
        estimate(problem(), FakeCluster(), 60)


@pytest.mark.parametrize("nodes", [pytest.param(2, marks=slow)])
def test_a_machine_that_is_lost_changes_no_bit(nodes: int) -> None:

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
