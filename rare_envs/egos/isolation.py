"""Isolation: a batch on which an ego fails is split until the failing rows stand alone."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TypeVar

from rare_envs.egos.errors import EgoGone, NoAnswer, reason_of

_T = TypeVar("_T")
Attempt = tuple[_T, dict[int, str]]
"""Values of some rows, and reasons by row of the batch where rows alone have failed."""


def attempt_in_parts(
    attempt: Callable[[range], Attempt[_T] | None],
    give_up: Callable[[int], _T],
    rows: range,
    error: BaseException | None = None,
    whole: int | None = None,
) -> tuple[list[_T], dict[int, str]] | None:
    """Attempt some rows, and after an error their parts, until the rows that fail stand alone.

    Args:
        attempt: Gives values and reasons of some rows of the batch, or raises; None if a batch cannot be split.
        give_up: Gives the value of a row that has failed.
        rows: Rows of the batch.
        error: What an attempt at all of them has raised; None to attempt them first.
        whole: Rows of the batch; None if these are all.

    Returns:
        Values of the parts in the order of rows, and reasons by row of the batch; None as soon as `attempt` gives None.

    Raises:
        EgoGone: The ego cannot be queried any more.
    """
    whole = len(rows) if whole is None else whole
    alone = len(rows) == 1
    if error is None:
        try:
            done = attempt(rows)
            return None if done is None else ([done[0]], done[1])
        except EgoGone:
            raise
        except (Exception, SystemExit) as raised:  # the ego is the user's: anything may happen in it
            error = raised
    elif alone and not isinstance(error, NoAnswer):
        return attempt_in_parts(attempt, give_up, rows, None, whole)  # once more
    if alone:
        return [give_up(rows.start)], {rows.start: reason_of(error)}
    values: list[_T] = []
    reasons: dict[int, str] = {}
    size = part_size(len(rows), error, whole)
    for first in range(rows.start, rows.stop, size):
        part = range(first, min(first + size, rows.stop))
        attempted = attempt_in_parts(attempt, give_up, part, None, whole)
        if attempted is None:
            return None
        values += attempted[0]
        reasons |= attempted[1]
    return values, reasons


def part_size(n: int, error: BaseException, whole: int) -> int:
    """Return how many rows to attempt at a time after an error on n of them, to find those that cause it.

    Half of them, which takes the fewest attempts. If the error is that no answer came, attempts are cheap, but waiting
    for one that does not come, or for a process that starts again, is not: then the square root of the whole batch,
    and after that each row alone. So a row is found by two more waits, not by one for each halving, in about twice
    that root of attempts.

    Args:
        n: Rows, 2 or more.
        error: What happened.
        whole: Rows of the batch that they are part of.
    """
    if not isinstance(error, NoAnswer):
        return (n + 1) // 2
    root = math.isqrt(whole)
    return root if 1 < root < n else 1
