"""Selection: the executor that the arguments of a run name."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor as FuturesExecutor
from typing import Any, TypeAlias

from samplers.execution.executors.base import Executor
from samplers.execution.executors.futures import FuturesPool
from samplers.execution.executors.local_processes import LocalProcesses
from samplers.execution.executors.ray_cluster import RayCluster

AnyExecutor: TypeAlias = Executor | FuturesExecutor | Callable[[], FuturesExecutor] | str
"""Settings, a pool of another library or a function that makes one, or "ray"."""


def find_executor(workers: int | None, executor: Any) -> Executor | None:
    """Return the executor of a run; None where neither is given.

    Args:
        workers: Number of local processes.
        executor: See `AnyExecutor`.

    Raises:
        ValueError: If both are given, or the executor is none.

    Example:
        >>> find_executor(2, None)
        LocalProcesses(workers=2, time_limit=None, memory_limit=None)
        >>> find_executor(None, 2)
        Traceback (most recent call last):
            ...
        ValueError: Expected executor to be "ray", samplers.LocalProcesses(...) or another one, an object with submit, or a function that makes one, got 2; workers=2 gives 2 processes.
    """  # noqa: E501 (the example shows a whole message)
    if executor is None:
        return None if workers is None else LocalProcesses(workers)
    if workers is not None:
        raise ValueError("Expected workers or executor, got both; LocalProcesses(workers=...) has more settings.")
    if executor == "ray":
        return RayCluster()
    if isinstance(executor, Executor) and not isinstance(executor, type):
        return executor
    if callable(getattr(executor, "submit", None)) or callable(executor):
        return FuturesPool(executor)
    raise ValueError(
        'Expected executor to be "ray", samplers.LocalProcesses(...) or another one, an object with submit, or a '
        f"function that makes one, got {executor!r}{_hint(executor)}."
    )


def _hint(executor: Any) -> str:
    return f"; workers={executor} gives {executor} processes" if isinstance(executor, int) else ""
