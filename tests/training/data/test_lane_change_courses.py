"""Courses of lane changes: durations from how long vehicles move across, by pencil and paper and through the search."""

import numpy as np
import pytest

from tests.training.data.recordings import table_of
from training.data.events import cut_in_events
from training.data.lane_change_courses import LATERAL_SPEED, course_durations, time_around_peak
from training.data.smoothing import CUTOFF_ACROSS, smooth_positions
from training.data.trajectories import DT

LANE = 3.5


def course(t, duration, displacement, start):
    """Return how far a cubic course has moved across at times t [m]."""
    s = np.clip((t - start) / duration, 0.0, 1.0)
    return displacement * (3.0 * s**2 - 2.0 * s**3)


def changing(duration, displacement=3.2, start=3.0, seconds=16.0, smooth=False):
    """Return a table of one vehicle that changes lanes between two others."""
    t = DT * np.arange(round(seconds / DT))
    across = 0.5 * LANE + course(t, duration, displacement, start)
    if smooth:
        across = smooth_positions(across, CUTOFF_ACROSS, DT)
    return table_of((20.0 + 10.0 * t, across, 10.0), (9.0 * t, 1.5 * LANE, 9.0), (50.0 + 12.0 * t, 1.5 * LANE, 12.0))


@pytest.mark.parametrize(("duration", "displacement"), [(2.0, 3.5), (4.0, 3.0), (8.0, 2.5)])
def test_a_course_has_the_duration_it_was_made_with(duration, displacement):
    t = np.linspace(0.0, duration, 200_001)
    speed = 6.0 * displacement * (t / duration) * (1.0 - t / duration) / duration
    above = time_around_peak(speed, t)
    assert course_durations(np.array([above]), np.array([displacement])) == pytest.approx([duration], rel=1e-3)


def test_a_course_that_never_moves_so_long_is_the_one_that_moves_longest():
    assert course_durations(np.array([60.0]), np.array([3.0])) == pytest.approx([3.0 / LATERAL_SPEED])


@pytest.mark.parametrize(("duration", "mean"), [(2.0, 2.17), (3.0, 3.05), (4.0, 4.0), (6.0, 6.0), (8.0, 8.0)])
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


@pytest.mark.parametrize(("duration", "found"), [(2.0, 3.1), (3.0, 3.6), (4.0, 4.3), (5.0, 5.1), (8.0, 7.8)])
def test_smoothing_makes_short_changes_longer(duration, found):
    """What the description of the shipped shapes of US 101 says; over a frame."""
    tables = [changing(duration, start=4.0 + DT * phase / 12.0, smooth=True) for phase in range(12)]
    durations = [cut_in_events(table)["duration"][0] for table in tables]
    assert np.mean(durations) == pytest.approx(found, abs=0.1)
