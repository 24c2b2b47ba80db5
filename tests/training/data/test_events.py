"""Events with pencil-and-paper answers, the recorded ones, and made-up brakings that are found with their size."""

import csv

import numpy as np
import pytest

from tests.training.data.recordings import PAUSE, cutting_in, stopping_track, stopping_traffic, table_of
from training.data.events import (
    END_TICKS,
    LATERAL_SPEED,
    MIN_PAIR_FRAMES,
    SHORTEST_TRACK,
    braking_exposure,
    car_following_events,
    course_durations,
    cut_in_events,
    find_brakings,
    hard_brake_events,
    time_around_peak,
    write_events,
)
from training.data.table import DT


def test_a_pair_is_an_event_once_it_was_seen_for_two_seconds():
    t = 0.1 * np.arange(MIN_PAIR_FRAMES)
    follower, leader = (10.0 * t, 1.75, 10.0), (30.0 + 8.0 * t, 1.75, 8.0)
    events = car_following_events(table_of(follower, leader))
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

    alone = cut_in_events(table_of((10.0 * t, 1.75 + np.clip(t - 2.0, 0.0, 3.5), 10.0)))
    assert (alone["ego"] == -1).all() and np.isnan(alone["gap_ego_cutin"]).all() and np.isnan(alone["v_lead"]).all()


def course(t, duration, displacement, start):
    """Return how far a cubic course has moved across at times t [m]."""
    s = np.clip((t - start) / duration, 0.0, 1.0)
    return displacement * (3.0 * s**2 - 2.0 * s**3)


def changing(duration, displacement=3.2, start=3.0, seconds=16.0):
    """Return a table of one vehicle that changes lanes between two others."""
    t = DT * np.arange(round(seconds / DT))
    across = 0.5 * 3.5 + course(t, duration, displacement, start)
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


def test_events_are_written_with_missing_values_as_empty_fields(tmp_path):
    events = {"ego": np.array([-1, 4]), "v_ego": np.array([np.nan, 12.34567])}
    write_events(events, tmp_path / "events.csv")
    with (tmp_path / "events.csv").open(encoding="utf-8") as file:
        rows = [(row["ego"], row["v_ego"]) for row in csv.DictReader(file)]
    assert rows == [("-1", ""), ("4", "12.3457")]


SPEEDS, GAPS, DECELERATIONS = (10.0, 14.0, 18.0), (6.0, 15.0, 30.0), (1.5, 2.5, 3.5)


def test_brakings_are_found_with_their_size():
    events = hard_brake_events(stopping_traffic(SPEEDS, GAPS, DECELERATIONS))
    own = ~np.isnan(events["gap"])
    assert events["vehicle"][own].tolist() == [0, 2, 4] and events["lead"][own].tolist() == [1, 3, 5]
    assert events["vehicle"][~own].tolist() == [1, 3, 5]  # nobody is ahead of these
    onsets = events["frame"][own] - np.array([0, 400, 800])
    assert (np.abs(onsets - PAUSE) <= 12).all()  # the filter of .40 Hz spreads a jump over a second
    np.testing.assert_allclose(events["speed"][own], SPEEDS, rtol=0.06)
    np.testing.assert_allclose(events["gap"][own], GAPS, rtol=1e-9)
    # the smooth deceleration overshoots a jump by up to a tenth
    np.testing.assert_allclose(events["peak"][own], DECELERATIONS, rtol=0.12)


def test_a_braking_counts_from_its_onset_to_a_standstill():
    """A hole 2.5 s after the onset: the track behind it begins in the braking. A hole before it leaves the braking."""
    table = stopping_traffic((14.0,), (15.0,), (2.5,))
    slowing = hard_brake_events(stopping_traffic((14.0,), (15.0,), (2.5,), final=5.0))
    assert slowing["loss"] == pytest.approx(9.0, rel=0.05)  # 14 - 5 m/s
    stops = hard_brake_events(table)
    assert stops["loss"].tolist() == stops["speed"].tolist()
    for hole, found in ((None, 2), (25, 0), (-30, 2)):
        kept = table.select(np.full(len(table), True) if hole is None else np.abs(table.frame - PAUSE - hole) > 2)
        assert len(hard_brake_events(kept)["frame"]) == found


def positions(table):
    return np.split(table.x, table.track_starts()[1:])


def test_exposure_is_that_of_the_tracks_without_their_ends():
    table = stopping_traffic((14.0, 10.0), (15.0, 15.0), (2.5, 2.5))
    seconds, metres = braking_exposure(positions(table))
    lengths = np.diff(np.append(table.track_starts(), len(table)))
    assert seconds == pytest.approx(0.1 * (lengths - 2 * END_TICKS).sum())
    braked = [14.0**2 / 5.0, 10.0**2 / 5.0]  # v^2 / (2 a) of each of two vehicles
    expected = sum(
        2 * (way + speed * (PAUSE - END_TICKS) * 0.1) for way, speed in zip(braked, (14.0, 10.0), strict=True)
    )
    assert metres == pytest.approx(expected, rel=0.03)
    short = table.select(table.frame < SHORTEST_TRACK - 1)
    assert braking_exposure(positions(short)) == (0.0, 0.0)


def test_a_track_that_runs_backwards_is_left_out():
    """A recorded position that freezes: the smoothed one overshoots and comes back."""
    position = stopping_track(12.0, 2.5)
    gap = np.full(len(position), 30.0)
    assert len(find_brakings(position, gap)[0]) == 1
    stop = position[-1]
    frozen = np.where(position > stop - 4.0, stop - 4.0, position)
    frozen[np.argmax(position > stop - 4.0) :] -= 1.0
    assert len(find_brakings(frozen, gap)[0]) == 0
