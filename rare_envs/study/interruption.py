"""Interruption of a run: what is known when it is stopped, in one line, and how it goes on."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rare_envs.study.report import Report
from samplers.journal import Journal
from samplers.result import Estimate
from samplers.sample import Status

NOT_KEPT = " With --out finished simulations would have been kept."
"""Advice where simulations are lost."""


FIRST_BATCH = "Stopped: no estimate yet, the first batch of simulations was not complete."
"""What is known of a run whose single simulations are not counted, before its method has an estimate."""


class RunInterrupted(KeyboardInterrupt):
    """A run was interrupted; the message says what is known and how to continue it."""

    def __init__(self, message: str, report: Any = None) -> None:
        super().__init__(message)
        self.report = report
        """The answer from the simulations made so far, as the command prints it; None before the first ones."""


def describe_stop(estimate: Estimate, name: str = "p") -> str:
    """Return what a run knows that was stopped, in one line.

    Args:
        estimate: Of the run.
        name: Of the probability.
    """
    low, high = estimate.interval
    so_far = f"{name} so far" if estimate.status is Status.STOPPED else name
    return (
        f"Stopped after {estimate.n_sim:,} simulations: {so_far} {estimate.p:.3e} "
        f"({100 * estimate.confidence:g} % interval {low:.3e} to {high:.3e})."
    )


def describe_early_stop(n_made: int, n_failed: int) -> str:
    """Return what a run knows that was stopped before its method had an estimate.

    Args:
        n_made: Simulations made.
        n_failed: Those of them that failed.

    Example:
        >>> describe_early_stop(400, 2)
        'Stopped: no estimate yet, 400 simulations made, 2 of them failed.'
        >>> describe_early_stop(0, 0)
        'Stopped: no estimate yet, no simulation made.'
    """
    made = f"{n_made:,} simulations made, {n_failed:,} of them failed" if n_made else "no simulation made"
    return f"Stopped: no estimate yet, {made}."


@contextmanager
def keep_answer(report: Report) -> Iterator[None]:
    """Let an interruption of what follows an estimate say the estimate.

    Raises:
        RunInterrupted: The block was interrupted.
    """
    try:
        yield
    except KeyboardInterrupt:
        raise RunInterrupted(describe_stop(report.estimate), report) from None


def describe_kept(journal: Journal, folder: Path, trust: bool, report: Report | None = None) -> str:
    """Return the number of simulations kept and the command that continues the run, behind a space.

    Args:
        journal: Of the run.
        folder: Of the run.
        trust: Whether the ego's file may run code.
        report: The answer, where there is one.
    """
    if not journal.has_simulations or not journal.flush():
        return ""
    command = f"rare-envs resume {shlex.quote(str(folder))}{' --trust' if trust else ''}"
    return f" {_count_kept(journal, report)} are kept; go on with: {command}"


def _count_kept(journal: Journal, report: Report | None) -> str:
    """Return the number of simulations in a journal, with those of the further run apart."""
    if report is not None and report.estimate.status is not Status.STOPPED:
        n, further = report.estimate.n_sim, report.estimate.ensemble_run
        n_further = journal.n - n if further is None else further.n_sim
        if n_further > 0:
            return f"{n:,} simulations and a further {n_further:,} under the mixture of the refits"
    return f"{journal.n:,} simulations"
