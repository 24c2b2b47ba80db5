"""Events with pencil-and-paper answers, and the recorded ones."""

import csv

import numpy as np
import pytest

from tests.training.data.recordings import cutting_in, table_of
from tests.training.shared_data import DATA, needs_data
from training.data.events import (
    CAR_FOLLOWING_COLUMNS,
    CUT_IN_COLUMNS,
    LATERAL_SPEED,
    MIN_PAIR_FRAMES,
    car_following_events,
    concatenate_events,
    course_durations,
    cut_in_events,
    time_around_peak,
    write_events,
)
from training.data.smoothing import CUTOFF_ACROSS, smooth_positions
from training.data.table import DT, NOBODY, SCENES_FILE, find_leaders, read_columns, tabulate


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


def load_us101(merged=True):
    """The scenes of US 101 as one recording, copies of a vehicle averaged; or each as its own."""
    names = ("scene", "vehicle", "epoch_ms", "y_along", "d", "speed", "accel", "length", "width", "lane")
    rows = read_columns(DATA / SCENES_FILE, names)
    rows = {name: values[rows["scene"] != 1] for name, values in rows.items()}
    recording = np.char.add("us101-", np.char.zfill(rows["scene"].astype(np.str_), 2))
    if merged:
        keys = np.column_stack([rows["vehicle"], rows["epoch_ms"]])
        _, first, copy = np.unique(keys, axis=0, return_index=True, return_inverse=True)
        count = np.bincount(copy.ravel())
        for name, values in rows.items():
            rows[name] = np.bincount(copy.ravel(), values) / count if values.dtype.kind == "f" else values[first]
        recording = np.full(len(first), "us101")
    frame, lane = rows["epoch_ms"] // 100, rows["lane"]
    lead = find_leaders(frame, lane, rows["y_along"], recording)
    columns = {"recording": recording, "frame": frame, "lane": lane, "y": rows["d"], "acceleration": rows["accel"]}
    columns |= {name: rows[name] for name in ("vehicle", "speed", "length", "width")}
    columns |= {
        "x": rows["y_along"] - 0.5 * rows["length"],
        "leader": np.where(lead >= 0, rows["vehicle"][lead], NOBODY),
    }
    return tabulate(columns)


@needs_data(SCENES_FILE)
def test_recorded_events_are_those_behind_the_shipped_bases():
    """The shipped events were found scene by scene; here all scenes are one recording, so a few differ."""
    table = load_us101()
    with (DATA / "us101_car_following_events.csv").open(encoding="utf-8") as file:
        shipped = {(int(row["ego"]), int(row["lead"])): row for row in csv.DictReader(file)}
    events = car_following_events(table)
    mine = {pair: i for i, pair in enumerate(zip(events["ego"].tolist(), events["lead"].tolist(), strict=True))}
    common = set(mine) & set(shipped)
    assert len(common) >= 465 and len(mine) <= 493
    same = [pair for pair in common if 100 * events["frame"][mine[pair]] == int(shipped[pair]["epoch_ms"])]
    assert len(same) >= 451
    apart = car_following_events(load_us101(merged=False))
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


def course(t, duration, displacement, start):
    """Return how far a cubic course has moved across at times t [m]."""
    s = np.clip((t - start) / duration, 0.0, 1.0)
    return displacement * (3.0 * s**2 - 2.0 * s**3)


def changing(duration, displacement=3.2, start=3.0, seconds=16.0, smooth=False):
    """Return a table of one vehicle that changes lanes between two others."""
    t = DT * np.arange(round(seconds / DT))
    across = 0.5 * 3.5 + course(t, duration, displacement, start)
    if smooth:
        across = smooth_positions(across, CUTOFF_ACROSS, DT)
    return table_of((20.0 + 10.0 * t, across, 10.0), (9.0 * t, 1.5 * 3.5, 9.0), (50.0 + 12.0 * t, 1.5 * 3.5, 12.0))


def test_a_course_has_the_duration_it_was_made_with():
    duration, displacement = 4.0, 3.0
    t = np.linspace(0.0, duration, 200_001)
    speed = 6.0 * displacement * (t / duration) * (1.0 - t / duration) / duration
    above = time_around_peak(speed, t)
    assert course_durations(np.array([above]), np.array([displacement])) == pytest.approx([duration], rel=1e-3)
    longest = course_durations(np.array([60.0]), np.array([3.0]))
    assert longest == pytest.approx([3.0 / LATERAL_SPEED])  # no course moves for 60 s


@pytest.mark.parametrize(("duration", "mean"), [(2.0, 2.17), (4.0, 4.0), (8.0, 8.0)])
def test_the_duration_of_a_recorded_change_is_found(duration, mean):
    """Starts and ends are found to a frame each, and the mean of twelve phases of the clock to a third of that.

    Spans of 0.5 s make the shortest changes longer.
    """
    found = np.concatenate(
        [cut_in_events(changing(duration, start=3.0 + DT * phase / 12.0))["duration"] for phase in range(12)]
    )
    assert len(found) == 24
    assert np.abs(found - mean).max() < 0.2 + 0.02 * duration
    assert found.mean() == pytest.approx(mean, abs=0.07)


def test_without_a_start_or_an_end_a_change_has_no_duration():
    for table in (changing(6.0, start=-1.0), changing(6.0, seconds=8.0)):
        events = cut_in_events(table)
        assert len(events["duration"]) == 2 and np.isnan(events["duration"]).all()


@pytest.mark.parametrize(("duration", "found"), [(2.0, 3.1), (4.0, 4.3), (8.0, 7.8)])
def test_smoothing_makes_short_changes_longer(duration, found):
    """What the description of the shipped shapes of US 101 says; over a frame."""
    tables = [changing(duration, start=4.0 + DT * phase / 12.0, smooth=True) for phase in range(12)]
    durations = [cut_in_events(table)["duration"][0] for table in tables]
    assert np.mean(durations) == pytest.approx(found, abs=0.1)


def test_pooled_events_are_written_with_missing_values_as_empty_fields(tmp_path):
    events = {"ego": np.array([-1, 4]), "v_ego": np.array([np.nan, 12.34567])}
    pooled = concatenate_events([events, {name: values[:1] for name, values in events.items()}])
    write_events(pooled, tmp_path / "events.csv")
    with (tmp_path / "events.csv").open(encoding="utf-8") as file:
        rows = [(row["ego"], row["v_ego"]) for row in csv.DictReader(file)]
    assert rows == [("-1", ""), ("4", "12.3457"), ("-1", "")]
    with pytest.raises(ValueError, match="at least one recording, got none"):
        concatenate_events([])
