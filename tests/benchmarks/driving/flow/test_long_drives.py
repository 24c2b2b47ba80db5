"""Long drives: a ring is seen as if it had no seam; contacts, places off the road and lane changes are counted."""

import numpy as np
import pytest
import torch

from benchmarks.driving.flow import long_drives as module
from benchmarks.driving.flow.long_drives import (
    LANES,
    LEAST_HEADWAY,
    REACH,
    ROWS,
    STANDSTILL_GAP,
    Moments,
    choose,
    close_ring,
    drive_long,
    format_drives,
    measure_drives,
    start_column,
    start_speed,
    summarise_drive,
)
from benchmarks.driving.realism import constant_velocity, rule_driver
from benchmarks.driving.realism_score import by_features
from training.imitation.traffic.replayed_traffic import replay_features

VEHICLES = LANES * ROWS


def test_vehicles_of_the_column_keep_a_least_gap_and_fill_the_ring():
    traffic = start_column(60.0, np.random.default_rng(0))
    assert traffic.x.shape == (1, VEHICLES)
    length, least = 1000.0 * ROWS / 60.0, 5.0 + STANDSTILL_GAP + LEAST_HEADWAY * start_speed(60.0)
    for lane in range(LANES):
        x = traffic.x[0, lane::LANES]
        apart = torch.cat((x.diff(), x[:1] + length - x[-1:]))
        assert apart.min() >= least - 1e-3 and apart.std() > 2.0
        assert apart.sum() == pytest.approx(length, rel=1e-5)


def test_the_seam_of_a_ring_is_not_seen():
    """Moved along the ring, so that others stand at the seam, every vehicle perceives the same."""
    length = 1000.0 * ROWS / 25.0
    traffic = start_column(25.0, np.random.default_rng(1))._replace(vehicle=torch.arange(VEHICLES)[None])
    moved = traffic._replace(x=torch.remainder(traffic.x + 0.5 * length, length))
    one, other = (replay_features(close_ring(each, length), VEHICLES) for each in (traffic, moved))
    torch.testing.assert_close(one, other, rtol=0, atol=2e-2)
    cut = replay_features(traffic, VEHICLES)
    assert (cut - one).abs().max() > 10.0  # without copies the first of each lane sees a free road
    closed = close_ring(traffic, length)
    copies = closed.x[0, VEHICLES:]
    assert ((copies < 0.0) & (copies >= -REACH) | (copies >= length) & (copies < length + REACH)).all()
    assert not closed.driven[0, VEHICLES:].any() and closed.there.all()


def test_idm_keeps_flowing_on_a_ring_and_counts_are_nought():
    start = start_column(25.0, np.random.default_rng(0))
    moments = drive_long(start, by_features(rule_driver), 1600.0, seconds=2.0)
    assert moments.speed.shape == (20,)
    for counted in (moments.stopped, moments.collision, moments.off_road, moments.changes):
        assert not counted.any()


def test_contacts_across_the_seam_places_off_the_road_and_changes_are_counted():
    start = start_column(25.0, np.random.default_rng(0))
    heading, speed = start.heading.clone(), start.speed.clone()
    heading[0, 0] = -0.1  # in the leftmost lane: off the road soon
    heading[0, 2] = 0.1  # into the next lane
    speed[0, 3 - LANES] = 80.0  # the last of lane 3 runs into the first, beyond the seam
    start = start._replace(heading=heading, speed=speed)
    moments = drive_long(start, by_features(constant_velocity), 1600.0, seconds=2.0)
    assert moments.off_road[-1] == pytest.approx(1 / VEHICLES)
    assert moments.changes.sum() == 1
    assert moments.collision[0] == 0.0 and moments.collision.max() > 1.5 / VEHICLES
    on_the_road = drive_long(start._replace(heading=0 * heading), by_features(constant_velocity), None, 2.0)
    assert not on_the_road.changes.any() and not on_the_road.collision.any()  # nobody is ahead of the last one there


def test_the_summary_of_a_drive_leaves_out_the_settling():
    ticks = 1200
    speed = np.where(np.arange(ticks) < 600, 30.0, np.where(np.arange(ticks) < 900, 10.0, 12.0))
    zero = np.zeros(ticks)
    changes = np.where(np.arange(ticks) < 100, 2.0, 0.0)
    found = summarise_drive(Moments(speed, speed, zero, zero, zero, zero, changes), 20.0)
    assert found["speed"] == pytest.approx(11.0) and found["speed_drift"] == pytest.approx(2.0)
    assert found["flow"] == pytest.approx(20.0 * 11.0 * 3.6)
    assert found["lane_changes_first_10_s"] == pytest.approx(2.0 * 100 / VEHICLES)
    assert found["lane_changes_settled"] == 0.0
    assert found["lane_changes"][:2] == [pytest.approx(1.0), 0.0]
    table = format_drives(
        {
            "drivers": {"idm": {"ring": [found], "open_road": summarise_drive(Moments(*[zero] * 7), None)}},
            "recorded": {},
        }
    )
    assert "| idm | 20 | 11.0 | 792 | +2.00 |" in table and "| idm | open | 0.0 |  |" in table


def test_denser_traffic_starts_slower():
    assert start_speed(15.0) == 20.0
    assert start_speed(60.0) == pytest.approx((1000 / 60 - 7.0) / 1.5)
    assert start_speed(200.0) == 0.0


def test_drives_are_made_at_the_densities_that_are_asked_for(monkeypatch):
    monkeypatch.setattr(module, "SETTLING", 2.0)
    found = measure_drives({"idm": choose("idm", 0)}, seed=0, seconds=10.0, densities=(20.0, 50.0))
    sparse, dense = found["idm"]["ring"]
    assert (sparse["density"], dense["density"]) == (20.0, 50.0)
    assert sparse["speed"] > dense["speed"] + 5.0
    assert "density" not in found["idm"]["open_road"]
