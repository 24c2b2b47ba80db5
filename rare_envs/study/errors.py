"""Errors in the input of a person, interruptions of a run, and folders for output."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from samplers import Estimate

MAX_MESSAGE = 2_000
"""Characters of a message, which may repeat a name or a value of any length; of a longer one the middle is left out."""
FIRST_BATCH = "Stopped: no estimate yet, the first batch of simulations was not complete."
"""What is known of a run whose single simulations are not counted, before its method has an estimate."""


class BadInput(Exception):
    r"""Input that cannot be used; the message is one line, of at most `MAX_MESSAGE` characters, that says what to do.

    Example:
        >>> raise BadInput("Expected a seed,\n  got None.")
        Traceback (most recent call last):
            ...
        rare_envs.study.errors.BadInput: Expected a seed, got None.
    """

    def __init__(self, message: object) -> None:
        text = " ".join(str(message).split())
        half = MAX_MESSAGE // 2 - 3
        super().__init__(text if len(text) <= MAX_MESSAGE else f"{text[:half]} ... {text[-half:]}")


class UnwrittenResults(BadInput):
    """A run is done, but its results could not be written; `report` is the answer, a `Report`."""

    def __init__(self, message: str, report: Any) -> None:
        super().__init__(message)
        self.report = report


class RunInterrupted(KeyboardInterrupt):
    """A run was interrupted; the message says what is known and how to continue it.

    `report` is the answer from the simulations made so far, as the command prints it; None before the first ones.
    """

    def __init__(self, message: str, report: Any = None) -> None:
        super().__init__(message)
        self.report = report


def describe_stop(estimate: Estimate, name: str = "p") -> str:
    """Return what a run knows that was stopped, in one line; `name` is that of the probability."""
    low, high = estimate.interval
    so_far = f"{name} so far" if estimate.status == "stopped" else name
    return (
        f"Stopped after {estimate.n_sim:,} simulations: {so_far} {estimate.p:.3e} "
        f"({100 * estimate.confidence:g} % interval {low:.3e} to {high:.3e})."
    )


@contextlib.contextmanager
def keep_answer(report: Any) -> Iterator[None]:
    """Let an interruption of what follows a `Report` say its estimate, as a RunInterrupted."""
    try:
        yield
    except KeyboardInterrupt:
        raise RunInterrupted(describe_stop(report.estimate), report) from None


@contextlib.contextmanager
def as_bad_input(*kinds: type[BaseException]) -> Iterator[None]:
    """Raise errors of these kinds as `BadInput`."""
    try:
        yield
    except kinds as error:
        raise BadInput(error) from error


@contextlib.contextmanager
def output_folder(path: Path) -> Iterator[None]:
    """Make the folder for results before the work, so that no run ends without a place to write to.

    If the work fails, new folders are removed again, as far as they are empty.
    """
    new = [folder for folder in (path, *path.parents) if not os.path.exists(folder)]
    try:
        _make_writable(path)
        yield
    except BaseException:
        for folder in new:  # the innermost first
            with contextlib.suppress(OSError):
                folder.rmdir()
        raise


@contextlib.contextmanager
def output_file(path: Path) -> Iterator[None]:
    """Make the folder of a file before the work, as `output_folder` does."""
    if path.is_dir():
        raise BadInput(f"Expected a file to write, got the folder {str(path)!r}.")
    with output_folder(path.parent):
        yield


def _make_writable(path: Path) -> None:
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        reason = "there is a file of that name" if os.path.isfile(path) else error.strerror
        raise BadInput(f"Cannot make the folder {str(path)!r}: {reason}.") from error
    if not os.access(path, os.W_OK):
        raise BadInput(f"Cannot write to the folder {str(path)!r}.")
