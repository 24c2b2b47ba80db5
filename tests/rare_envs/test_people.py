"""People by kind of event, recounted from the study's table; and the factor by which a model misses them, by hand."""

import csv

import pytest

from rare_envs.people import (
    HUMAN_BENCHMARKS,
    UNSEEN_CHANGES_100CAR,
    EventCalibration,
    ModelCount,
    calibration,
    people_in,
)
from tests.training.shared_data import DATA, needs_data

EVENTS = "car100_events.csv"
KM_100CAR = 2e6 * 1.609344


@pytest.fixture(scope="module")
def recorded():
    """Return the rows of the 828 events."""
    with (DATA / EVENTS).open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


@needs_data(EVENTS)
def test_people_by_event_are_those_of_the_table(recorded):
    def count(rows, severity):
        return sum(row["severity"] == severity for row in rows)

    striking = [row for row in recorded if row["group"] == "lead_slows"]
    assert {row["incident_type"] for row in striking} == {"Rear-end, striking"}
    by_event = {
        "cut_in": [row for row in recorded if row["group"] == "cut_in"],
        "stop": [row for row in striking if "stopped" in row["precipitating_event"]],
        "slowing": [row for row in striking if "decelerating" in row["precipitating_event"]],
    }
    for event, rows in by_event.items():
        people = people_in(event)
        counted = (count(rows, "Crash"), count(rows, "Near-Crash"))
        assert counted == (people.contacts.count, people.near_crashes.count)
    types = [row["incident_type"].partition(",")[0] for row in by_event["cut_in"] if row["severity"] == "Near-Crash"]
    assert (types.count("Rear-end"), types.count("Sideswipe")) == (74, 58)
    own = [row for row in recorded if row["group"] == "own_lane_change"]
    unseen = [row for row in own if any("Did not see other vehicle" in row[f"behaviour_{k}"] for k in (1, 2, 3))]
    assert (len(own), count(own, "Crash")) == (76, 2)
    assert (len(unseen), count(unseen, "Crash")) == (UNSEEN_CHANGES_100CAR.count, 0)


def test_people_per_event_are_counts_over_events_in_as_many_km():
    """1 contact (exact Poisson interval 0.0253 to 5.572) in 2 million miles; none is below 3.689."""
    p, (low, high) = people_in("cut_in").contacts.per_event(0.26)
    assert (p, low, high) == pytest.approx([k / KM_100CAR / 0.26 for k in (1.0, 0.02532, 5.572)], rel=1e-3)
    p, (low, high) = people_in("slowing").contacts.per_event(1.04)
    assert (p, low, high) == pytest.approx((0.0, 0.0, 3.689 / KM_100CAR / 1.04), rel=1e-3)


@pytest.mark.parametrize(
    ("model", "factor"),
    [
        (ModelCount(4e-5, 3e-5, 5e-5), 2.0),  # above the upper end
        (ModelCount(1.5e-5, 1e-6, 9e-5), 1.0),  # inside, whatever its own interval
        (ModelCount(2.5e-6, 1e-6, 9e-6), 0.25),  # below the lower end
        (ModelCount(0.0, 0.0, 1e-4), 5.0),  # nothing counted, and too little simulated to tell: up to 5 times
        (ModelCount(0.0, 0.0, 1.9e-5), 1.0),  # nothing counted, all that it may be is inside or below
        (ModelCount(0.0, 0.0, 5e-6), 0.5),  # nothing counted, below people's lower end by 2 or more
    ],
)
def test_factor_by_which_a_model_misses_an_interval(model, factor):
    assert model.factor_from(1e-5, 2e-5) == pytest.approx(factor)


def test_calibrated_is_within_a_factor_of_3_of_either_end():
    """13 contacts have the exact Poisson interval 6.92 to 22.23."""
    low, high = (k / KM_100CAR / 0.19 for k in (6.922, 22.23))
    for times, calibrated in ((2.9, True), (3.1, False)):
        for p in (high * times, low / times):
            counts = {"human": {"contacts": ModelCount(p, p, p)}}
            found = EventCalibration(event="stop", base="us101", per_km=0.19, drivers=counts)
            assert found.is_calibrated == calibrated


def test_the_shipped_calibration_has_the_driver_with_and_without_headway_rule_at_each_site():
    for event, base in (("cut_in", "us101"), ("cut_in", "i80"), ("stop", "us101"), ("slowing", "us101")):
        found = calibration(event, base)
        assert (found.event, found.base) == (event, base)
        for driver in ("human", "human:no-headway-rule"):
            for outcome in ("contacts", "near_crashes"):
                count = found.drivers[driver][outcome]
                assert 0.0 <= count.low <= count.p <= count.high < 1.0


TABLE = {
    ("100-Car", "contacts of all kinds"): (21, 16, 27),
    ("100-Car", "near-crashes"): (236, 220, 254),
    ("100-Car", "contacts into a vehicle ahead"): (4.3, 2.4, 7.3),
    ("100-Car", "near-crashes with a vehicle ahead"): (120, 108, 132),
    ("100-Car", "contacts begun by another's lane change"): (0.31, 0.01, 1.7),
    ("100-Car", "near-crashes begun by another's lane change"): (42, 36, 50),
    ("100-Car", "contacts with a lead that stopped"): (4.0, 2.15, 6.9),
    ("100-Car", "near-crashes with a lead that stopped"): (41, 34.3, 48.6),
    ("100-Car", "contacts with a lead that slowed"): (0.0, 0.0, 1.15),
    ("100-Car", "near-crashes with a lead that slowed"): (47.2, 40.0, 55.4),
    ("100-Car", "near-crashes in own lane changes into a vehicle that was not seen"): (13.7, 9.9, 18.4),
    ("SHRP 2", "crashes without tyre strikes"): (15, None, None),
    ("SHRP 2", "severe crashes"): (4.5, None, None),
}
"""Per million km with its interval."""


@pytest.mark.parametrize("benchmark", HUMAN_BENCHMARKS, ids=lambda each: f"{each.study} {each.kind}")
def test_rates_of_people(benchmark):
    rate, low, high = TABLE[benchmark.study, benchmark.kind]
    assert benchmark.per_million_km == pytest.approx(rate, rel=0.03)
    if low is not None:
        assert benchmark.interval_per_million_km == pytest.approx((low, high), rel=0.03, abs=0.005)
    assert benchmark.source
    assert benchmark.words
    assert benchmark.to_dict()["per_million_km"] == benchmark.per_million_km
