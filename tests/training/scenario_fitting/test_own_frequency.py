"""Frequencies of events of own recordings: exposure and counts by hand."""

import numpy as np
import pytest

from tests.training.data.stopping_traffic import stopping_traffic
from training.data.brakings import braking_exposure
from training.data.events import car_following_events, cut_in_events
from training.data.table import synthetic_traffic
from training.scenario_fitting.own_frequency import ObservedTraffic, count_events


def test_exposure_is_time_and_distance_of_all_vehicles():
    table = synthetic_traffic(seconds=10.0, per_lane=2)
    exposure = ObservedTraffic().plus(table).plus(table)
    assert exposure.hours == pytest.approx(2 * len(table) * 0.1 / 3600)
    assert exposure.km == pytest.approx(2 * table.speed.mean() * len(table) * 0.1 / 1000)


def test_pairs_at_the_entry_do_not_count():
    """Nobody changes lane, so that all pairs are there from the first frame on: no new leader was recorded."""
    table = synthetic_traffic(seconds=4.0, per_lane=2)
    events = car_following_events(table)
    assert events["at_entry"].all()
    assert count_events("car_following", events, len(events["ego"]), ObservedTraffic().plus(table)) is None


def test_new_leaders_count_with_the_share_that_is_used():
    events = {"at_entry": np.array([True, False, False, True, False, False]), "ego": np.arange(6)}
    frequency = count_events("car_following", events, 3, ObservedTraffic(hours=2.0, km=100.0))
    assert frequency is not None
    assert (frequency.count, frequency.share_events) == (4, 4)
    assert frequency.per_hour == pytest.approx(3 / 2.0)


def test_cut_ins_count_with_the_share_that_is_used():
    events = {"phase": np.array(["start", "crossing"] * 4), "ego": np.array([1, 1, 2, 2, -1, -1, 3, 3])}
    frequency = count_events("cut_in", events, 2, ObservedTraffic(hours=2.0, km=100.0))
    assert frequency is not None
    assert (frequency.count, frequency.share_events) == (3, 3)
    assert frequency.per_hour == pytest.approx(3 / 2.0 * 2 / 3)
    assert frequency.per_km == pytest.approx(3 / 100.0 * 2 / 3)
    none = cut_in_events(synthetic_traffic(seconds=3.0, per_lane=2))
    assert count_events("cut_in", none, 0, ObservedTraffic(2.0, 100.0)) is None


def test_brakings_count_in_the_time_in_which_they_could_begin():
    table = stopping_traffic((10.0, 14.0), (6.0, 15.0), (1.5, 2.5))
    traffic = ObservedTraffic().plus(table).plus(table)
    seconds, metres = braking_exposure(table)
    frequency = count_events("hard_brake", {}, 4, traffic)
    assert frequency is not None
    assert (frequency.count, frequency.share) == (4, 1.0)
    assert frequency.per_hour == pytest.approx(4 / (2 * seconds / 3600))
    assert frequency.per_km == pytest.approx(4 / (2 * metres / 1000))
    assert count_events("hard_brake", {}, 0, traffic) is None
