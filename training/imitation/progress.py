"""Progress of a training: a bar, and TensorBoard logs."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from training.imitation.algorithms.learner import Learner, Log

AfterUpdate = Callable[[Learner, Log], None]
"""Function that is called after every update."""


@contextlib.contextmanager
def progress_bar(learner: Learner, show: bool) -> Iterator[AfterUpdate]:
    """Open a progress bar on standard error.

    Args:
        learner: The training.
        show: False gives a function that does nothing.

    Yields:
        Function to call after every update.
    """
    if not show:
        yield lambda learner, entry: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(), TextColumn("{task.description}"))
    with Progress(*columns, console=Console(stderr=True)) as shown:
        task = shown.add_task("", total=learner.config.updates, completed=learner.update)

        def after(learner: Learner, entry: Log) -> None:
            text = ", ".join(f"{name} {entry[name]:.3f}" for name in ("collision", "edge", "critic") if name in entry)
            shown.update(task, completed=learner.update, description=text)

        yield after


def summary_writer() -> Any:
    """Return TensorBoard's class of writers.

    Raises:
        ValueError: TensorBoard is not installed.
    """
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError as error:
        raise ValueError("Logs need TensorBoard: pip install 'rare-envs[logs]', or leave logs out.") from error
    return SummaryWriter


@contextlib.contextmanager
def tensorboard_logs(folder: Path | None, update: int) -> Iterator[AfterUpdate]:
    """Open TensorBoard logs in a folder.

    Args:
        folder: Folder of the logs; None gives a function that does nothing.
        update: Number of updates made before; entries of later ones, left by a run that was stopped, are dropped.

    Yields:
        Function to call after every update.

    Raises:
        ValueError: TensorBoard is not installed.
    """
    if folder is None:
        yield lambda learner, entry: None
        return
    writer: Any = summary_writer()(str(folder), purge_step=update + 1)

    def after(learner: Learner, entry: Log) -> None:
        for name, value in entry.items():
            writer.add_scalar(name, value, learner.update)
        writer.add_scalar("vehicle_steps", learner.simulated, learner.update)

    try:
        yield after
    finally:
        writer.close()
