"""Events with pencil-and-paper answers, and the recorded ones."""

import csv

import numpy as np
import pytest

from tests.training.data.recordings import cutting_in, table_of
from tests.training.shared_data import DATA, needs_data
from training.data.events import (
    CAR_FOLLOWING_COLUMNS,
    CUT_IN_COLUMNS,
    MIN_PAIR_FRAMES,
    car_following_events,
    cut_in_events,
)
from training.data.ngsim_tables import SCENES_FILE, load_us101_trajectories


def test_a_pair_is_an_event_once_it_was_seen_for_two_seconds():
    t = 0.1 * np.arange(MIN_PAIR_FRAMES)
    follower, leader = (10.0 * t, 1.75, 10.0), (30.0 + 8.0 * t, 1.75, 8.0)
    events = car_following_events(table_of(follower, leader))
    assert tuple(events) == CAR_FOLLOWING_COLUMNS
    assert {name: values.tolist() for name, values in events.items()} == {
        "recording": ["r"],
        "frame": [0],
        "lane": [1],
        "ego": [1],
        "lead": [2],
        "v_ego": [10.0],
        "v_lead": [8.0],
        "gap": [26.0],
        "a_ego": [0.5],
        "a_lead": [0.5],
        "n": [MIN_PAIR_FRAMES],
        "at_entry": [True],
    }
    shorter = [tuple(values[:-1] if np.ndim(values) else values for values in track) for track in (follower, leader)]
    assert len(car_following_events(table_of(*shorter))["gap"]) == 0
    beside = (30.0 + 8.0 * t, 5.25, 8.0)
    assert len(car_following_events(table_of(follower, beside))["gap"]) == 0


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_cut_in_has_a_start_and_a_crossing(sign):
    events = cut_in_events(cutting_in(sign))
    assert tuple(events) == CUT_IN_COLUMNS
    assert events["phase"].tolist() == ["crossing", "start"]
    assert (events["vehicle"] == 1).all() and (events["ego"] == 2).all() and (events["lead"] == 3).all()
    assert events["from_lane"].tolist() == [1, 1] if sign > 0 else [2, 2]
    crossing, start = events["frame"].tolist()
    assert crossing == 34  # 1.75 m take 1.35 s
    assert start == 20  # one frame later 0.13 m in 0.5 s are more than 0.2 m/s
    assert events["start_seen"].all()
    np.testing.assert_allclose(events["lateral_speed"], 1.3)
    np.testing.assert_allclose(events["lateral_offset"][1], 3.5)
    seconds = 0.1 * events["frame"]
    np.testing.assert_allclose(events["gap_ego_cutin"], 16.0 + seconds)
    np.testing.assert_allclose(events["gap_cutin_lead"], 26.0 + 2.0 * seconds)
    assert (events["v_cutin"] == 10.0).all() and (events["v_ego"] == 9.0).all() and (events["v_lead"] == 12.0).all()


def test_a_start_before_the_track_is_not_seen_and_short_visits_do_not_count():
    events = cut_in_events(cutting_in(pause=0))
    assert not events["start_seen"].any()
    t = 0.1 * np.arange(60)
    touch = (10.0 * t, np.where((t > 2.0) & (t < 2.6), 3.6, 3.4), 10.0)
    assert len(cut_in_events(table_of(touch))["frame"]) == 0


def test_without_neighbours_values_are_missing():
    t = 0.1 * np.arange(90)
    alone = cut_in_events(table_of((10.0 * t, 1.75 + np.clip(t - 2.0, 0.0, 3.5), 10.0)))
    assert (alone["ego"] == -1).all() and np.isnan(alone["gap_ego_cutin"]).all() and np.isnan(alone["v_lead"]).all()


@needs_data(SCENES_FILE)
def test_recorded_events_are_those_behind_the_shipped_bases():
    """The shipped events were found scene by scene; here all scenes are one recording, so a few differ."""
    table = load_us101_trajectories(DATA)
    with (DATA / "us101_car_following_events.csv").open(encoding="utf-8") as file:
        shipped = {(int(row["ego"]), int(row["lead"])): row for row in csv.DictReader(file)}
    events = car_following_events(table)
    mine = {pair: i for i, pair in enumerate(zip(events["ego"].tolist(), events["lead"].tolist(), strict=True))}
    common = set(mine) & set(shipped)
    assert len(common) >= 465 and len(mine) <= 493
    same = [pair for pair in common if 100 * events["frame"][mine[pair]] == int(shipped[pair]["epoch_ms"])]
    assert len(same) >= 451
    apart = car_following_events(load_us101_trajectories(DATA, merged=False))
    assert len(set(zip(apart["ego"].tolist(), apart["lead"].tolist(), strict=True)) & set(shipped)) == 468
    for column in ("v_ego", "v_lead", "gap"):
        differences = [events[column][mine[pair]] - float(shipped[pair][column]) for pair in same]
        assert np.abs(differences).max() < 0.03

    with (DATA / "us101_cut_in_events.csv").open(encoding="utf-8") as file:
        rows = {(int(row["vehicle"]), int(row["to_lane"]), row["phase"]): row for row in csv.DictReader(file)}
    cuts = cut_in_events(table)
    keys = list(zip(cuts["vehicle"].tolist(), cuts["to_lane"].tolist(), cuts["phase"].tolist(), strict=True))
    assert set(rows) <= set(keys) and len(keys) == len(rows) + 4
    late = {key: cuts["frame"][i] - int(rows[key]["epoch_ms"]) // 100 for i, key in enumerate(keys) if key in rows}
    assert sum(value == 0 for key, value in late.items() if key[2] == "crossing") == 63
    assert sum(abs(value) <= 1 for key, value in late.items() if key[2] == "start") >= 61
