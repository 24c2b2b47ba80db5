"""Time of a piece of work."""

import time
from collections.abc import Callable


def seconds(work: Callable[[], object], repeat: int = 1, clock: Callable[[], float] = time.process_time) -> float:
    """Return the time [s] of one call, the least of several; by default that of the process."""
    best = float("inf")
    for _ in range(repeat):
        start = clock()
        work()
        best = min(best, clock() - start)
    return best
