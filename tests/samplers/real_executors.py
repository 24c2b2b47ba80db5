"""Executors with the real libraries, by name, for tests that all of them are to pass."""

from __future__ import annotations

import importlib.util
import multiprocessing
import os
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from typing import Any

import pytest

import samplers
from samplers.executors import FuturesPool

LIBRARIES = {"futures": "concurrent.futures", "loky": "loky", "dask": "distributed", "ray": "ray"}
"""What an executor needs; `local` needs nothing."""


def case(*values: Any, quick: bool = False) -> Any:
    """Return a case of a test whose first value is an executor: slow, and skipped without its library."""
    library = LIBRARIES.get(values[0], "samplers")
    marks = [
        pytest.mark.skipif(importlib.util.find_spec(library) is None, reason=f"{library} is not installed"),
        pytest.mark.filterwarnings("ignore"),  # of the libraries, on sockets and processes that were killed
    ]
    return pytest.param(*values, marks=marks if quick else [*marks, pytest.mark.slow])


@contextmanager
def open_executor(name: str, workers: int = 2, **limits: Any) -> Iterator[Any]:
    """Yield an executor whose workers are processes of this machine.

    Args:
        name: "here", "local" or one of `LIBRARIES`.
        workers: Number of processes.
        limits: time_limit [s], memory_limit [bytes].
    """
    if name == "here":
        yield samplers.executors.InProcess()
    elif name == "local":
        yield samplers.executors.LocalProcesses(workers, **limits)
    elif name == "futures":
        spawn = multiprocessing.get_context("spawn")
        yield FuturesPool(lambda: ProcessPoolExecutor(workers, mp_context=spawn), workers=workers, **limits)
    elif name == "loky":
        import loky

        yield FuturesPool(lambda: loky.ProcessPoolExecutor(workers), workers=workers, **limits)
    elif name == "dask":
        with open_dask(workers) as pool:
            yield FuturesPool(pool, **limits)
    else:
        os.environ.setdefault("RAY_worker_niceness", "0")  # it is 15, so that on a busy machine they hardly begin
        yield samplers.executors.RayCluster(workers=workers, **limits)


@contextmanager
def open_dask(workers: int) -> Iterator[Any]:
    """Yield the executor of a cluster of dask whose tasks fail with their worker, and which waits for a new one."""
    import dask
    from distributed import Client, LocalCluster

    settings = {"distributed.scheduler.allowed-failures": 0, "distributed.deploy.lost-worker-timeout": "1 h"}
    with dask.config.set(settings):
        with LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=None) as cluster:
            with Client(cluster) as client:
                yield client.get_executor()
