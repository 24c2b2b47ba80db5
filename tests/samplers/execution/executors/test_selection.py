"""The executor that the arguments of a run name."""

from concurrent.futures import ThreadPoolExecutor

import pytest

import samplers
from samplers.execution.executors.selection import find_executor


def test_what_is_named_is_found():
    assert find_executor(None, None) is None
    assert find_executor(3, None) == samplers.LocalProcesses(3)
    assert find_executor(None, "ray") == samplers.RayCluster()
    here = samplers.InProcess()
    assert find_executor(None, here) is here
    with ThreadPoolExecutor(1) as threads:
        assert find_executor(None, threads) == samplers.FuturesPool(threads)
    assert isinstance(find_executor(None, lambda: threads), samplers.FuturesPool)


@pytest.mark.parametrize(
    ("workers", "executor", "words"),
    [
        (2, "ray", "got both"),
        (None, "rya", "got 'rya'"),
        (None, 2, "workers=2 gives 2 processes"),
        (0, None, "workers"),
    ],
)
def test_what_is_none_is_refused(workers, executor, words):
    with pytest.raises(ValueError, match=words):
        samplers.estimate(
            samplers.FunctionProblem(lambda x: x[:, 0], 1), "mc", seed=1, max_sim=5, workers=workers, executor=executor
        )
