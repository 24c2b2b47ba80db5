"""Shapes of lane changes: displacement and duration of made-up changes, and the recorded ones."""

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from scipy import stats

from tests.training.shared_data import DATA, needs_data
from training.scenario_fitting.event_filters import read_csv_columns
from training.scenario_fitting.shipped.lane_change_shapes import change_shapes, lane_change_shapes, profile_shapes
from training.scenario_fitting.shipped.lateral_offsets import CHANGES_FILE, PROFILES_FILE, settled_changes


def test_profiles_of_cubic_courses_have_their_durations(tmp_path):
    """The time above 0.2 m/s is counted in frames of 0.1 s."""
    parts = []
    for side, number, far, duration in (("left", 1, 3.4, 4.0), ("right", 1, 2.8, 7.0), ("right", 2, 3.0, 2.5)):
        sign = 1.0 if side == "right" else -1.0
        t = 0.1 * np.arange(120)
        s = np.clip((t - 2.0) / duration, 0.0, 1.0)
        across, speed = far * (3.0 * s**2 - 2.0 * s**3), 6.0 * far * s * (1.0 - s) / duration
        rows = {"t": t, "across": 5.0 + sign * across, "v_across": sign * speed}
        parts.append(pa.table({"site": ["i80"] * 120, "side": [side] * 120, "change": [number] * 120, **rows}))
    pq.write_table(pa.concat_tables(parts[::-1]), tmp_path / PROFILES_FILE)
    found = profile_shapes(tmp_path, "i80")
    np.testing.assert_allclose(found[:, 0], [3.4, 2.8, 3.0], atol=1e-12)
    np.testing.assert_allclose(found[:, 1], [4.0, 7.0, 2.5], atol=0.15)
    assert profile_shapes(tmp_path, "us101").shape == (0, 2)


def test_changes_have_a_duration_where_start_and_end_were_seen(tmp_path):
    """From 1.6 s before the crossing to 1.7 s after it, and 0.4 s for the spans: 3.7 s above 0.2 m/s, T = 4.07 s."""
    header = "before_s,after_s,start_seen,end_seen,start_s,end_s,across_-4s,across_+4s,across_-3s,across_+3s\n"
    seen = [
        "5,5,True,True,-1.6,1.7,-1.5,1.6,-1.4,1.5",
        "5,5,True,False,-1.6,1.7,-1.5,1.6,,",
        "2,5,True,True,-1,1,-1,1,,",
    ]
    (tmp_path / CHANGES_FILE).write_text(header + "\n".join(seen) + "\n", encoding="utf-8")
    found = change_shapes(tmp_path)
    expected = 3.7**2  # of T^2 (1 - 2 v T / (3 D)) with v = 0.2 m/s and D = 3.1 m
    assert found[0, 0] == pytest.approx(3.1)
    assert found[0, 1] ** 2 * (1.0 - 0.4 * found[0, 1] / 9.3) == pytest.approx(expected, rel=1e-9)
    assert found[0, 1] == pytest.approx(4.07, abs=0.01)
    assert found[1, 0] == pytest.approx(3.1) and np.isnan(found[1, 1])
    assert len(found) == 2


@needs_data(CHANGES_FILE)
def test_recorded_durations_do_not_go_with_speed_or_gap():
    """Rank correlations of 247 changes; those of independent columns have a standard deviation of .064."""
    rows = read_csv_columns(DATA / CHANGES_FILE, ("before_s", "after_s", "v_start", "gap_lead"))
    settled = settled_changes(rows)
    duration = lane_change_shapes(DATA, "us101")[:, 1]
    for name in ("v_start", "gap_lead"):
        other = rows[name][settled].astype(float)
        known = np.isfinite(duration) & np.isfinite(other)
        assert abs(stats.spearmanr(duration[known], other[known]).statistic) < 2.0 * 0.064
