"""Brakings to a standstill in a table of trajectories: made-up ones are found with their size."""

import numpy as np
import pytest

from tests.training.data.stopping_traffic import PAUSE, stopping_track, stopping_traffic
from training.data.events import (
    END_TICKS,
    HARD_BRAKE_COLUMNS,
    SHORTEST_TRACK,
    braking_exposure,
    find_standstill_brakings,
    hard_brake_events,
)

SPEEDS, GAPS, DECELERATIONS = (10.0, 14.0, 18.0), (6.0, 15.0, 30.0), (1.5, 2.5, 3.5)


def test_brakings_are_found_with_their_size():
    events = hard_brake_events(stopping_traffic(SPEEDS, GAPS, DECELERATIONS))
    assert tuple(events) == HARD_BRAKE_COLUMNS
    own = ~np.isnan(events["gap"])
    assert events["vehicle"][own].tolist() == [0, 2, 4] and events["lead"][own].tolist() == [1, 3, 5]
    assert events["vehicle"][~own].tolist() == [1, 3, 5]  # nobody is ahead of these
    onsets = events["frame"][own] - np.array([0, 400, 800])
    assert (np.abs(onsets - PAUSE) <= 12).all()  # the filter of .40 Hz spreads a jump over a second
    np.testing.assert_allclose(events["speed"][own], SPEEDS, rtol=0.06)
    np.testing.assert_allclose(events["gap"][own], GAPS, rtol=1e-9)
    # the smooth deceleration overshoots a jump by up to a tenth
    np.testing.assert_allclose(events["deceleration"][own], DECELERATIONS, rtol=0.12)


def test_a_braking_that_does_not_end_in_a_standstill_is_none():
    assert len(hard_brake_events(stopping_traffic(SPEEDS, GAPS, DECELERATIONS, final=5.0))["speed"]) == 0


def test_a_braking_under_way_where_a_track_begins_is_left_out():
    """A hole 2.5 s after the onset: the track behind it begins in the braking. A hole before it leaves the braking."""
    table = stopping_traffic((14.0,), (15.0,), (2.5,))
    assert len(hard_brake_events(table)["frame"]) == 2
    assert len(hard_brake_events(table.select(np.abs(table.frame - PAUSE - 25) > 2))["frame"]) == 0
    assert len(hard_brake_events(table.select(np.abs(table.frame - PAUSE + 30) > 2))["frame"]) == 2


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
    assert len(find_standstill_brakings(position, gap)[0]) == 1
    stop = position[-1]
    frozen = np.where(position > stop - 4.0, stop - 4.0, position)
    frozen[np.argmax(position > stop - 4.0) :] -= 1.0
    assert len(find_standstill_brakings(frozen, gap)[0]) == 0
