"""Cut-ins of the shipped bases: which lane changes are used, and how offset and duration go together."""

import numpy as np
import pytest
from scipy import stats

from tests.training.shared_data import DATA, needs_data
from training.scenario_fitting.mixture import select_mixture
from training.scenario_fitting.shipped import cut_ins
from training.scenario_fitting.shipped.cut_ins import (
    read_i80_cut_ins,
    read_i80_timed_cut_ins,
    read_us101_cut_ins,
    read_us101_timed_cut_ins,
)
from training.scenario_fitting.shipped.lateral_offsets import CHANGES_FILE, PROFILES_FILE

EVENTS = "us101_cut_in_events.csv"


@needs_data(EVENTS)
def test_shapes_within_the_ranges_are_used_and_the_others_counted(monkeypatch):
    shapes = np.array([[3.0, 4.0], [np.nan, 4.0], [3.0, np.nan], [1.0, 4.0], [3.0, 13.0], [4.0, 1.4], [4.9, 11.0]])
    monkeypatch.setattr(cut_ins, "lane_change_shapes", lambda folder, site: shapes)
    events, _ = read_us101_timed_cut_ins(DATA)
    assert events.apart.tolist() == [[3.0, 4.0], [4.9, 11.0]]
    last = [(rule["rule"], rule.get("dropped", rule.get("events"))) for rule in events.log[-5:]]
    assert last == [
        ("lane changes read", 7),
        ("displacement and duration are given", 2),
        ("2.2 <= displacement <= 5 m", 1),
        ("1.5 <= duration <= 12 s", 2),
        ("events used", 2),
    ]


@needs_data(EVENTS, PROFILES_FILE, CHANGES_FILE)
def test_both_versions_have_the_same_speeds_and_gaps():
    for first, second in ((read_us101_cut_ins, read_us101_timed_cut_ins), (read_i80_cut_ins, read_i80_timed_cut_ins)):
        (one, frequency), (other, same) = first(DATA), second(DATA)
        assert (one.joint == other.joint).all() and (one.clusters == other.clusters).all() and frequency == same
        assert (one.apart.shape[1], other.apart.shape[1]) == (1, 2)


@needs_data(PROFILES_FILE, CHANGES_FILE)
@pytest.mark.parametrize(
    ("read", "n", "median", "correlation"),
    [(read_us101_timed_cut_ins, 259, 4.65, 0.36), (read_i80_timed_cut_ins, 131, 5.55, 0.42)],
    ids=["us101", "i80"],
)
def test_recorded_changes_that_go_farther_take_longer(read, n, median, correlation):
    events, _ = read(DATA)
    offset, duration = events.apart.T
    assert len(offset) == n
    assert np.median(duration) == pytest.approx(median, abs=0.05)
    assert np.corrcoef(offset, np.log(duration))[0, 1] == pytest.approx(correlation, abs=0.005)
    assert stats.spearmanr(offset, duration).pvalue < 1e-4
    together = select_mixture(np.column_stack([offset, np.log(duration)]))
    by_themselves = sum(select_mixture(y[:, None], most=1).bic for y in (offset, np.log(duration)))
    assert len(together.components.weights) == 1 and together.bic < by_themselves - 15.0
