"""Progress: how far a run has come, for a listener or a bar on standard error."""

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Protocol

from samplers.sample import Level


@dataclass(frozen=True, kw_only=True)
class Progress:
    """Progress of a run.

    Example:
        >>> import samplers
        >>> problem = samplers.FunctionProblem(lambda x: 2.0 - x[:, 0], dim=2)
        >>> seen = []
        >>> result = samplers.estimate(problem, "mc", seed=0, max_sim=2000, progress=seen.append)
        >>> seen[-1].n_sim, seen[-1].max_sim, seen[-1].p == result.p
        (2000, 2000, True)
    """

    n_sim: int
    """Simulations done."""
    max_sim: int | None
    """Simulations allowed; None for no limit."""
    level: float
    """Threshold of the last finished level; inf before the first."""
    p: float
    """Running estimate of P[f(X) <= level]; NaN before the first level."""
    run: int
    """Replicate that finished this level, counted from 0 (they run side by side)."""
    workers: int = 0
    """Workers of the executor; 0 without one."""
    n_retries: int = 0
    """Chunks that were computed again because a worker was lost."""
    seconds_left: float | None = None
    """Time that the rest of max_sim takes at the pace so far [s]; None where that is not known."""


NARROW_TERMINAL = 72
"""Columns of a terminal below which a bar keeps itself, the count and the time only."""

WIDE_TERMINAL = 110
"""Columns of a terminal below which the bar is short where there are workers, so that all of the line is seen."""

Listener = Callable[[Progress], None]


class Monitor:
    """Keeps the progress of a run and passes every change to a listener.

    Args:
        listener: Given `progress` whenever it changes.
        max_sim: Simulations allowed; None for no limit.

    Attributes:
        progress: The latest state.
    """

    def __init__(self, listener: Listener | None, max_sim: int | None) -> None:
        self.progress = Progress(n_sim=0, max_sim=max_sim, level=math.inf, p=math.nan, run=0)
        self._listener = listener

    def on_batch(self, n_sim: int) -> None:
        """Record that n_sim simulations are done."""
        self._update(replace(self.progress, n_sim=n_sim))

    def on_level(self, level: Level) -> None:
        """Record a finished level."""
        self._update(replace(self.progress, level=level.gamma, p=level.estimate, run=level.run))

    def _update(self, progress: Progress) -> None:
        """Replace the progress and pass it to the listener."""
        self.progress = progress
        if self._listener is not None:
            self._listener(progress)


class Counting(Protocol):
    """What counts the work of an executor."""

    n_restored: int
    """Rows whose results were known from before."""

    @property
    def n_retries(self) -> int:
        """Chunks that were computed again."""


class Pace:
    """Tells a listener of every chunk that workers have done, and how long the rest takes.

    Args:
        listener: Is told.
        workers: Their number.
        counts: Of the executor's work.
    """

    def __init__(self, listener: Listener, workers: int, counts: Counting) -> None:
        self._listener, self._workers, self._counts = listener, workers, counts
        self._started = time.monotonic()
        self._latest: Progress | None = None
        self._shown = 0

    def on_progress(self, progress: Progress) -> None:
        """Take the progress of the run, after a batch or a level."""
        self._latest = progress
        self._show(progress)

    def on_chunk(self, n_done: int) -> None:
        """Take the number of simulations of the present batch that are done."""
        latest = self._latest
        if latest is not None and latest.n_sim + n_done > self._shown:
            self._show(replace(latest, n_sim=latest.n_sim + n_done))

    def _show(self, progress: Progress) -> None:
        self._shown = progress.n_sim
        n_made, seconds = progress.n_sim - self._counts.n_restored, time.monotonic() - self._started
        left = None
        if progress.max_sim is not None and n_made > 0:
            left = (progress.max_sim - progress.n_sim) * seconds / n_made
        self._listener(replace(progress, workers=self._workers, n_retries=self._counts.n_retries, seconds_left=left))


def describe_workers(progress: Progress) -> str:
    """Return words for the workers, what they lost, and the time left; empty without workers.

    Example:
        >>> describe_workers(
        ...     Progress(n_sim=9, max_sim=90, level=0.0, p=0.1, run=0, workers=2, n_retries=1, seconds_left=200.0)
        ... )
        ', 2 workers, 1 retries, 3 min left'
    """
    if not progress.workers:
        return ""
    words = f", {progress.workers} workers{f', {progress.n_retries} retries' if progress.n_retries else ''}"
    if progress.seconds_left is None:
        return words
    for unit, seconds in (("d", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if progress.seconds_left >= 2 * seconds:
            return f"{words}, {progress.seconds_left / seconds:.0f} {unit} left"
    return f"{words}, {progress.seconds_left:.0f} s left"


@contextmanager
def open_listener(progress: bool | Listener, max_sim: int | None) -> Iterator[Listener | None]:
    """Yield the listener that corresponds to `progress`: None, one that shows a bar on standard error, or itself."""
    if callable(progress):
        yield progress
    elif progress:
        with _rich_bar(max_sim) as listener:
            yield listener
    else:
        yield None


@contextmanager
def _rich_bar(max_sim: int | None) -> Iterator[Listener]:
    """Show a bar on standard error while the run lasts; one that fails leaves nothing of it."""
    from rich.console import Console  # optional, and slow to import
    from rich.progress import BarColumn, ProgressColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bar

    console, length = Console(stderr=True), BarColumn(bar_width=20)
    columns: tuple[ProgressColumn, ...] = (
        TextColumn("[bold]{task.description}"),
        length,
        TextColumn("{task.completed:,.0f} {task.fields[unit]}"),
        TextColumn("{task.fields[state]}", markup=False),
        TimeElapsedColumn(),
    )
    narrow = (BarColumn(bar_width=10), TextColumn("{task.completed:,.0f} done"), TimeElapsedColumn())
    bar = Bar(*(columns if console.width >= NARROW_TERMINAL else narrow), console=console)
    task = bar.add_task("estimate", total=max_sim, state="", unit="simulations")

    def show(progress: Progress) -> None:
        state = f"run {progress.run + 1} " if progress.run else ""
        if not math.isnan(progress.p):
            state += f"P[f <= {progress.level:.3g}] = {progress.p:.2e}"
        state += describe_workers(progress)
        if progress.workers and console.width < WIDE_TERMINAL:  # the rest of the line needs the room
            length.bar_width = 10
            bar.update(task, description="", unit="done")
        bar.update(task, completed=progress.n_sim, state=state)

    bar.start()
    try:
        yield show
    except BaseException:
        bar.live.transient = True  # clears the line
        bar.live.stop()  # bar.stop() would add an empty line where standard error is a file
        raise
    bar.stop()
