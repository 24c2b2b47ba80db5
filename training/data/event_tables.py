"""Events of several recordings: extraction by scenario, pooling and files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from pyarrow import csv

from training.data.brakings import hard_brake_events
from training.data.events import Events, car_following_events, cut_in_events

EXTRACTORS = {
    "car_following": car_following_events,
    "cut_in": cut_in_events,
    "hard_brake": hard_brake_events,
}
"""Functions that extract the events of a scenario, by the scenario's name."""


def concatenate_events(parts: Sequence[Events]) -> Events:
    """Return the events of several tables as one.

    Raises:
        ValueError: No table is given.
    """
    if not parts:
        raise ValueError("Expected events of at least one recording, got none.")
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def write_events(events: Mapping[str, NDArray[Any]], path: Path | str) -> None:
    """Write events to a CSV file, missing values as empty fields."""
    columns = {
        name: pa.array(np.round(values, 4) if values.dtype.kind == "f" else values, from_pandas=True)
        for name, values in events.items()
    }
    csv.write_csv(pa.table(columns), path)
