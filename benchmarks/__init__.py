"""Benchmarks: scripts that measure, one question each; run them as `python -m benchmarks.FOLDER.NAME`."""

import time
from collections.abc import Callable, Iterable, Sequence
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


def format_table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table as Markdown.

    Example:
        >>> print(format_table(["a", "b"], [["1", "2"]]))
        | a | b |
        |---|---|
        | 1 | 2 |
    """
    lines = (f"| {' | '.join(row)} |" for row in (heads, *rows))
    return "\n".join([next(lines), "|---" * len(heads) + "|", *lines])
