"""Chunks: rows of a request that are computed together, and the search for the rows on which that fails."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from samplers.problem import FloatArray
from samplers.validation import FinalError

Index = tuple[int, ...]
"""Number of a chunk in its run; of a part that is computed by itself, also its number in the chunk. It keys random
draws."""
Rows = NDArray[np.int64]
"""Numbers of rows of a chunk."""
NAN_REASON = "f is NaN"


class Result(NamedTuple):
    """What a chunk gives."""

    table: FloatArray
    """A row of numbers for each row of the chunk, shape (n, k): f; of terms f, values and ticks; or a gradient. NaN
    where there is none; of k = 1 where no row has any."""
    notes: dict[str, Any]
    """What else is known, JSON-ready: `reasons` of rows without f, in their order, `n_retried`, `lost`, `seconds`,
    `cost` of gradients, `threshold` and `names` of terms."""


@dataclass(frozen=True, eq=False)
class Chunk:
    """Rows of a request."""

    kind: str
    """What is asked for: "f", "terms" or "gradient"."""
    arrays: tuple[NDArray[Any], ...]
    """x (n, d); of gradients also the numbers and the ticks of terms, (n,) each."""

    @property
    def x(self) -> FloatArray:
        """Points, shape (n, d)."""
        return self.arrays[0]

    def __len__(self) -> int:
        return len(self.arrays[0])

    def take(self, rows: Rows | slice) -> Chunk:
        """Return some of the rows."""
        return Chunk(self.kind, tuple(array[rows] for array in self.arrays))

    def split(self, size: int | None) -> list[Chunk]:
        """Return chunks of `size` rows, the last one of what is left; itself for None."""
        if size is None or len(self) <= size:
            return [self]
        return [self.take(slice(first, first + size)) for first in range(0, len(self), size)]


def join_results(parts: Sequence[Result]) -> Result:
    """Return the results of parts as one: numbers in notes are added, lists joined, the rest is that of the first."""
    notes: dict[str, Any] = {}
    for name, value in (item for part in parts for item in part.notes.items()):
        adds = name in notes and name not in ("names", "threshold") and isinstance(value, int | float | list)
        notes[name] = notes[name] + value if adds else notes.get(name, value)
    return Result(join_tables([part.table for part in parts]), notes)


def join_tables(tables: Sequence[FloatArray]) -> FloatArray:
    """Return tables below each other; narrow ones, which know nothing, get columns of NaN."""
    width = max(table.shape[1] for table in tables)
    pads = [np.pad(t, ((0, 0), (0, width - t.shape[1])), constant_values=np.nan) for t in tables if t.shape[1] < width]
    padded = iter(pads)
    return np.concatenate([next(padded) if table.shape[1] < width else table for table in tables])


class Attempted(NamedTuple):
    """What an attempt at some rows has given."""

    table: FloatArray
    """As of `Result`."""
    reasons: dict[int, str]
    """Why rows have nothing, by their number."""
    notes: dict[str, Any]


Attempt = Callable[[Chunk], Attempted]
Fail = Callable[[int, str, BaseException | None], None]


def isolate(attempt: Attempt, chunk: Chunk, first: Attempted | BaseException, fail: Fail) -> tuple[Attempted, int]:
    """Find the rows of a chunk that fail, after a first attempt at all of it.

    Where an attempt raises, its parts are attempted (`split_rows`), until the rows that raise stand alone. A row that
    has given nothing is attempted once more, and fails for good if that gives nothing either.

    Args:
        attempt: Gives a table and reasons for some rows, or raises.
        chunk: The rows.
        first: What it gave for the chunk, or raised.
        fail: Told of every row that fails for good, why, and what it raised; it may raise.

    Returns:
        What all rows have given, and how many rows were attempted again.
    """
    n_retried, lost, found = 0, dict[int, str](), list[tuple[Rows, Attempted]]()

    def settle(rows: Rows, met: Attempted | BaseException, again: bool) -> None:
        nonlocal n_retried
        if isinstance(met, Attempted):
            found.append((rows, met))
        elif isinstance(met, FinalError) and met.final:
            raise met
        elif again and len(rows) == 1:
            lost[int(rows[0])] = reason_of(met)
            fail(int(rows[0]), lost[int(rows[0])], met)
            found.append((rows, Attempted(np.full((1, 1), np.nan), {}, {})))
        else:
            for part in split_rows(rows, met, len(chunk)):
                n_retried += len(part)
                settle(part, try_attempt(attempt, chunk.take(part)), True)

    settle(np.arange(len(chunk)), first, False)
    unsure = {int(rows[at]): why for rows, each in found for at, why in each.reasons.items()}
    if unsure:
        part = np.array(sorted(unsure))
        n_retried += len(part)
        settle(part, try_attempt(attempt, chunk.take(part)), True)
    whole = join_tables([each.table for _, each in found])
    table = np.empty((len(chunk), whole.shape[1]))
    table[np.concatenate([rows for rows, _ in found])] = whole  # what came last stands
    again_failed = {row: why for row, why in unsure.items() if np.isnan(table[row, 0])}
    for row in sorted(set(again_failed) - set(lost)):
        fail(row, again_failed[row], None)
    notes = join_results([Result(each.table[:, :1], each.notes) for _, each in found]).notes
    return Attempted(table, {**again_failed, **lost}, notes), n_retried


def try_attempt(attempt: Attempt, chunk: Chunk) -> Attempted | BaseException:
    """Return what an attempt gives or raises; what is no fault of a row (an ego that is gone, Ctrl-C) is raised."""
    try:
        return attempt(chunk)
    except (Exception, SystemExit) as error:  # the simulation is the user's: anything may happen in it
        return error


def split_rows(rows: Rows, error: BaseException, whole: int) -> list[Rows]:
    """Return the parts in which rows are attempted after an error.

    Halves take the fewest attempts. Where the error means that an answer was waited for (its attribute `waits`),
    attempts are cheaper than errors: then parts of about the root of the whole chunk, and after that each row alone.
    """
    if not getattr(error, "waits", False):
        return np.array_split(rows, min(2, len(rows)))
    root = math.isqrt(whole)
    size = root if 1 < root < len(rows) else 1
    return np.split(rows, range(size, len(rows), size))


def reason_of(error: BaseException) -> str:
    """Return what went wrong, in one line."""
    words = " ".join(str(error).split())
    if isinstance(error, ValueError) and words:  # most say what is wrong by themselves
        return words
    return f"{type(error).__name__}: {words}" if words and not isinstance(error, SystemExit) else repr(error)
