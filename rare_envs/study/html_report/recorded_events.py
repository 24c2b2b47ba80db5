"""Recorded events beside failures: how near the recordings come to a failing scenario."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rare_envs.study.errors import BadInput
from samplers.problem import FloatArray


class NearestEvent(NamedTuple):
    """The recorded event that is nearest to a failure."""

    distance: float
    """Root mean square over the parameters of their differences in standard deviations of ordinary traffic."""
    rarer: float
    """Share of ordinary scenarios that are at least as far from the event nearest to them."""
    values: FloatArray
    """Its parameters, shape (k,)."""


def read_recorded_events(path: Path, names: list[str]) -> FloatArray:
    """Read events from a CSV file with a column for each of some parameters; others are not looked at.

    Args:
        path: Of the file.
        names: Of the parameters.

    Returns:
        Events, shape (n, k); rows with an empty cell are left out.

    Raises:
        BadInput: It cannot be read, or has not these columns, or no events.
    """
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
        missing = [name for name in names if rows and name not in rows[0]]
        if missing or not rows:
            has = f"it has {', '.join(rows[0])}" if rows else "it has no rows"
            raise BadInput(
                f"Expected events in {str(path)!r} with columns named as the parameters, {', '.join(names)}; {has}."
            )
        values = np.array([[float(row[name] or "nan") for name in names] for row in rows])
    except OSError as error:
        raise BadInput(f"Cannot read {str(path)!r}: {error.strerror}.") from error
    except (ValueError, TypeError, csv.Error) as error:
        raise BadInput(f"{str(path)!r} is no table of events: {error}.") from error
    known: FloatArray = values[np.isfinite(values).all(axis=1)]
    if not len(known):
        raise BadInput(f"{str(path)!r} has no event with all of {', '.join(names)}.")
    return known


def find_nearest_event(x: FloatArray, events: FloatArray, ordinary: FloatArray) -> NearestEvent:
    """Return the event nearest to a failure x (k,), among events (n, k), beside ordinary scenarios (m, k)."""
    spread = np.maximum(ordinary.std(axis=0), 1e-12)
    distances = _distances(x[None], events, spread)[0]
    nearest = int(distances.argmin())
    usual = _distances(ordinary, events, spread).min(axis=1)
    return NearestEvent(float(distances[nearest]), float((usual >= distances[nearest]).mean()), events[nearest])


def _distances(x: FloatArray, events: FloatArray, spread: FloatArray) -> FloatArray:
    """Return distances of x (m, k) to events (n, k), shape (m, n)."""
    squares = sum(
        ((x[:, None, j] - events[None, :, j]) / spread[j]) ** 2 for j in range(x.shape[1])
    )  # parameter by parameter, for memory
    return np.asarray(np.sqrt(squares / x.shape[1]))
