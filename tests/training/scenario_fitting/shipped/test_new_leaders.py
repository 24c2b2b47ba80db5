"""New leaders of an instrumented car: jumps of the gap, made by hand, and the recorded ones."""

import numpy as np
import pytest

from tests.training.shared_data import DATA, needs_data
from training.scenario_fitting.shipped.new_leaders import (
    CIRCLES_FILE,
    SETTLING_TICKS,
    STEADY_TICKS,
    find_new_leaders,
    load_new_leaders,
)


def drive(gaps, speed=25.0, relative=-1.0):
    gap = np.concatenate([np.full(n, value) for value, n in gaps])
    return np.full(len(gap), speed), np.full(len(gap), relative), gap


@pytest.mark.parametrize(
    ("gaps", "expected"),
    [
        ([(60.0, 50), (30.0, 50)], [30.0]),  # somebody cuts in
        ([(30.0, 50), (60.0, 50)], [60.0]),  # the leader leaves
        ([(np.nan, 50), (60.0, 50)], [60.0]),  # nobody, then somebody
        ([(60.0, 50), (55.0, 50)], []),  # less than 6 m
        ([(60.0, 50), (np.nan, 50)], []),  # nobody is ahead any more
        ([(60.0, 50), (30.0, 10)], []),  # the record ends before the new leader is tracked
        ([(60.0, 50), (30.0, 10), (50.0, 40)], []),  # it jumps again within the second after
        ([(60.0, 50), (30.0, 50), (50.0, 50)], [30.0, 50.0]),
    ],
)
def test_jumps(gaps, expected):
    found = find_new_leaders(*drive(gaps))
    assert found[:, 2].tolist() == expected
    assert (found[:, :2] == [25.0, 24.0]).all()


def test_values_are_taken_once_the_radar_has_settled():
    speed, relative, gap = drive([(60.0, 50), (30.0, 50)])
    speed = 20.0 + 0.01 * np.arange(len(speed))
    onset = 47  # the first tick whose gap 0.3 s later differs by more than 6 m
    assert find_new_leaders(speed, relative, gap)[0, 0] == pytest.approx(speed[onset + SETTLING_TICKS])


def test_the_speed_ahead_is_a_mean_over_a_second():
    speed, relative, gap = drive([(60.0, 50), (30.0, 50)])
    relative = 0.1 * np.arange(len(gap))
    first = 47 + SETTLING_TICKS
    ahead = find_new_leaders(speed, relative, gap)[0, 1]
    assert ahead == pytest.approx(25.0 + 0.1 * (first + (STEADY_TICKS - 1) / 2))


def test_an_unknown_speed_ahead_is_no_event():
    speed, relative, gap = drive([(60.0, 50), (30.0, 50)])
    relative[60] = np.nan
    assert find_new_leaders(speed, relative, gap).shape == (0, 3)


@needs_data(CIRCLES_FILE)
def test_recorded_new_leaders():
    events, drives = load_new_leaders(DATA)
    assert len(events) == len(drives)
    assert len(np.unique(drives)) <= 26
    assert 20.0 < np.median(events[:, 0]) < 30.0
