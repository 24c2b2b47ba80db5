"""Lateral offsets: displacements of made-up profiles, and the recorded ones."""

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tests.training.shared_data import DATA, needs_data
from training.scenario_fitting.shipped.lateral_offsets import (
    CHANGES_FILE,
    PROFILES_FILE,
    change_displacements,
    lateral_offsets,
    profile_displacements,
)


def write_profiles(folder):
    """Three changes on the I-80: 3.5 m to the left, 3 m to the right, and one that comes back."""
    t = np.arange(5.0)
    rows = {"site": [], "side": [], "change": [], "t": [], "across": []}
    for side, change, end in (("left", 1, -3.5), ("right", 1, 3.0), ("right", 2, 0.4)):
        rows["site"] += ["i80"] * 5
        rows["side"] += [side] * 5
        rows["change"] += [change] * 5
        rows["t"] += t[::-1].tolist()  # the order of rows does not matter
        rows["across"] += (end * t / 4)[::-1].tolist()
    pq.write_table(pa.table(rows), folder / PROFILES_FILE)


def test_displacements_to_the_side_of_the_change(tmp_path):
    write_profiles(tmp_path)
    assert profile_displacements(tmp_path, "i80").tolist() == [3.5, 3.0, 0.4]
    assert profile_displacements(tmp_path, "us101").shape == (0,)
    assert lateral_offsets(tmp_path, "i80").tolist() == [3.5, 3.0, 0.4]


def test_changes_count_when_they_are_settled(tmp_path):
    header = "before_s,after_s,across_-4s,across_+4s,across_-3s,across_+3s\n"
    rows = ["5,5,-1.5,1.6,-1.4,1.5", "3.5,5,,1.6,-1.4,1.5", "2,5,-1.5,1.6,-1.4,1.5", "3,3,,,,"]
    (tmp_path / CHANGES_FILE).write_text(header + "\n".join(rows) + "\n", encoding="utf-8")
    assert change_displacements(tmp_path) == pytest.approx([3.1, 2.9])


@needs_data(PROFILES_FILE, CHANGES_FILE)
@pytest.mark.parametrize(("site", "n", "inside"), [("i80", 165, 131), ("us101", 301, 265)])
def test_recorded_offsets(site, n, inside):
    offsets = lateral_offsets(DATA, site)
    assert len(offsets) == n
    within = offsets[(offsets >= 2.2) & (offsets <= 5.0)]
    assert len(within) == inside
    assert 2.9 < within.mean() < 3.5  # a lane is 3.7 m wide
