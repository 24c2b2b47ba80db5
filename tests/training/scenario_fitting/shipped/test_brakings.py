"""Recorded brakings: a made-up one is found, and the shipped moments are those of the recordings."""

import numpy as np
import pytest

from rare_envs.scenarios.hard_brake import US101
from tests.training.shared_data import DATA, needs_data
from training.data.brakings import find_standstill_brakings
from training.data.table import VEHICLES_FILE
from training.scenario_fitting.shipped.brakings import find_brakings, load_brakings, log_moments


def track(deceleration, seconds, speed=20.0, gap=30.0, before=5.0, after=5.0):
    """Positions and gaps of a vehicle that brakes once."""
    a = np.concatenate([np.zeros(round(10 * before)), np.full(round(10 * seconds), -deceleration)])
    a = np.concatenate([a, np.zeros(round(10 * after))])
    v = speed + np.cumsum(a) * 0.1
    return np.cumsum(v) * 0.1, np.full(len(v), gap)


@pytest.mark.parametrize(("deceleration", "seconds"), [(2.0, 3.0), (4.0, 3.0), (1.0, 6.0)])
def test_a_braking_is_found_with_its_size(deceleration, seconds):
    found, onsets = find_brakings(*track(deceleration, seconds))
    assert found.shape == (1, 3)
    assert 36 <= onsets[0] <= 52  # 5 s, and half a window earlier
    np.testing.assert_allclose(found[0], [20.0, 30.0, deceleration], rtol=0.03)


@pytest.mark.parametrize("case", [track(2.0, 1.0), track(0.4, 10.0), track(2.0, 3.0, gap=0.5), (np.arange(20.0),) * 2])
def test_what_is_no_braking(case):
    """Less than 3 m/s, too gentle, too near to have been measured right, too short a track."""
    assert find_brakings(*case).events.shape == (0, 3)


def test_moments_by_hand():
    events = np.array([[10.0, np.e, 1.0], [14.0, np.e**3, np.e**2]])
    mean, covariance = log_moments(events)
    np.testing.assert_allclose(mean, [12.0, 2.0, 1.0])
    np.testing.assert_allclose(covariance, [[8.0, 4.0, 4.0], [4.0, 2.0, 2.0], [4.0, 2.0, 2.0]])


@needs_data(VEHICLES_FILE)
def test_the_shipped_moments_are_the_recorded_ones():
    events = load_brakings(DATA).events
    assert len(events) == 265
    mean, covariance = log_moments(events)
    np.testing.assert_allclose(mean, US101["means"][0], atol=1e-4)
    np.testing.assert_allclose(covariance, US101["covariances"][0], atol=1e-4)


@needs_data(VEHICLES_FILE)
def test_recorded_brakings_to_a_standstill():
    brakings = load_brakings(DATA, find_standstill_brakings)
    assert len(brakings.events) == len(brakings.frames) == 41
    assert brakings.events[:, 2].max() < 4.0  # the one of 7.3 m/s^2 runs backwards
    assert brakings.hours == pytest.approx(5.75, abs=0.01)
    assert 200.0 < brakings.km < 250.0
