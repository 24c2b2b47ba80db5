"""Tables of trajectories: order, checks, leaders, and the file that keeps them."""

import numpy as np
import pytest

from training.data.formats import load_ngsim
from training.data.table import (
    COLUMNS,
    NOBODY,
    read_trajectories,
    tabulate,
    write_trajectories,
)

GOOD = {
    "recording": "r",
    "vehicle": [1, 1, 2],
    "frame": [1, 2, 1],
    "x": [0.0, 1.0, 9.0],
    "y": 1.75,
    "speed": 10.0,
    "acceleration": 0.0,
    "length": 4.5,
    "width": 1.8,
    "lane": 1,
    "leader": [2, NOBODY, NOBODY],
}


def test_tables_survive_a_file(ngsim, tmp_path):
    table = load_ngsim(ngsim[0])
    write_trajectories(table, tmp_path / "table.parquet")
    again = read_trajectories(tmp_path / "table.parquet")
    assert again.edges == table.edges
    for name in COLUMNS:
        assert (again.column(name) == table.column(name)).all()
    with pytest.raises(ValueError, match="Cannot read trajectories from"):
        read_trajectories(tmp_path / "none.parquet")


def test_a_table_is_sorted_and_checked():
    shuffled = {**GOOD, "vehicle": [2, 1, 1], "frame": [1, 2, 1], "x": [9.0, 1.0, 0.0], "leader": [-1, -1, 2]}
    assert tabulate(shuffled).x.tolist() == [0.0, 1.0, 9.0]
    assert tabulate(GOOD).find_rows(tabulate(GOOD).leader).tolist() == [2, -1, -1]
    for changes, message in (
        ({"frame": [1, 1, 1]}, "Rows 0 and 1 are not in order"),
        ({"x": [0.0, np.nan, 9.0]}, "Row 1: expected x a finite number, got nan"),
        ({"speed": [1.0, 1.0, -1.0]}, "Row 2: expected speed of at least 0, got -1"),
        ({"length": 0.0}, "Row 0: expected length above 0, got 0"),
        ({name: [] for name in COLUMNS}, "at least one row"),
    ):
        with pytest.raises(ValueError, match=message):
            tabulate({**GOOD, **changes})
    with pytest.raises(ValueError, match="must increase"):
        tabulate(GOOD, {"r": (0.0, 3.5, 3.5)})
