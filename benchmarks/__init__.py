"""Benchmarks: scripts that measure, one question each; run them as `python -m benchmarks.FOLDER.NAME`."""

import time
from collections.abc import Callable
from pathlib import Path

RESULTS = Path(__file__).parent / "results"
"""Folder of the committed results, where the scripts write by default."""


def seconds(work: Callable[[], object], repeat: int = 1, clock: Callable[[], float] = time.process_time) -> float:
    """Return the time [s] of one call, the least of several; by default that of the process."""
    best = float("inf")
    for _ in range(repeat):
        start = clock()
        work()
        best = min(best, clock() - start)
    return best
