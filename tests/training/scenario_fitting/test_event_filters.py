"""Filters of events: what they drop and count, and files that lack a column."""

import csv

import pytest

from rare_envs.scenarios.registry import scenario_named
from training.scenario_fitting.event_filters import EVENT_RECIPES, filter_events, read_events


def write_events(path, rows):
    columns = ["phase", *EVENT_RECIPES["cut_in"].columns, "start_seen", "recording", "frame"]
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(rows)


GOOD = [15.0, 14.0, 16.0, 12.0, 20.0, 3.0, 4.5]


def test_filters_drop_and_count(tmp_path):
    path = tmp_path / EVENT_RECIPES["cut_in"].file
    write_events(
        path,
        [
            ["start", *GOOD, True, "a", 299],
            ["crossing", *GOOD, True, "a", 299],
            ["start", *GOOD, False, "a", 300],
            ["start", "", *GOOD[1:], True, "a", 1],  # no ego
            ["start", *GOOD[:3], -2.0, *GOOD[4:], True, "a", 1],  # side by side
            ["start", *GOOD[:5], 1.5, 4.5, True, "b", 10],  # bodies overlap across
            ["start", 16.0, *GOOD[1:], True, "a", 10],
            ["start", *GOOD[:6], "", True, "a", 11],  # the end was not recorded
            ["start", *GOOD[:6], 1.2, True, "a", 12],  # faster than tyres allow
        ],
    )
    recipe, box = EVENT_RECIPES["cut_in"], scenario_named("cut_in").parameters
    events = filter_events(read_events(path, recipe), recipe, box)
    points, shapes, log = events.joint, events.apart, events.log
    # speeds and gaps count even where the offset at the start was not seen or is out of range, or the duration
    assert points.tolist() == [GOOD[:5], GOOD[:5], GOOD[:5], [16.0, *GOOD[1:5]], GOOD[:5], GOOD[:5]]
    assert shapes.tolist() == [[3.0, 4.5], [3.0, 4.5]]
    # 30 s windows: frame 299 of a, frame 300 of a, frame 10 of b, frame 10 of a
    assert (events.clusters == events.clusters[[0, 3]][:, None]).tolist() == [
        [True, False, False, True, True, True]
    ] * 2
    assert (events.counts.used, events.counts.clusters, events.counts.cluster) == ((6, 2), 3, "half-minute")
    assert log[0]["events"] == 8
    assert [entry["events"] for entry in log if entry["rule"] == "events used"] == [6, 2]
    dropped = {entry["rule"]: entry["dropped"] for entry in log if entry.get("dropped")}
    assert dropped == {
        "v_ego is given": 1,
        "start_seen": 1,
        "1 <= gap_ego_cutin <= 120 m": 1,
        "2.2 <= lateral_offset <= 5 m": 1,
        "duration is given": 1,
        "1.5 <= duration <= 12 s": 1,
    }


def test_missing_column_is_named(tmp_path):
    path = tmp_path / "events.csv"
    path.write_text("v_ego,v_lead\n1,2\n", encoding="utf-8")
    with pytest.raises(ValueError, match="lacks the columns gap"):
        read_events(path, EVENT_RECIPES["car_following"])


def test_pairs_that_were_under_way_are_no_new_leaders(tmp_path):
    path = tmp_path / "car_following_events.csv"
    rows = ["v_ego,v_lead,gap,at_entry,recording,frame", "10,9,20,true,a,0", "11,9,20,false,a,5", "12,9,0.5,false,a,9"]
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")
    recipe = EVENT_RECIPES["car_following"]
    events = filter_events(read_events(path, recipe), recipe, scenario_named("car_following").parameters)
    assert events.joint.tolist() == [[11.0, 9.0, 20.0]]
    dropped = {entry["rule"]: entry["dropped"] for entry in events.log if entry.get("dropped")}
    assert dropped == {"not at_entry": 1, "1 <= gap <= 150 m": 1}
