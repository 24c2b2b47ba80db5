"""Measures and collisions of rows in their slots."""

import numpy as np
import pytest

from rare_envs.simulation.compiled.highway import measure_kinds, row_measures
from rare_envs.simulation.compiled.highway.curved_road import CurvedRoadNumbers
from rare_envs.simulation.compiled.highway.traffic_slots import Found, Rules, Slots, TrafficRows, place_row
from rare_envs.traffic.road import i80

ROAD, VEHICLES, TICKS = CurvedRoadNumbers.of(i80()), 3, 10
NO_BEAMS = np.zeros((20, 384), np.float32)


def one_row(x=(100.0, 120.0, 150.0), y=(5.0, 5.0, 5.0), speed=(20.0, 10.0, 10.0)):
    """A row in the first of its slots."""
    fields = [np.array([values], np.float32) for values in (x, y, np.zeros(VEHICLES), speed)]
    shapes = ((1, 0), (1, 0, 2, 2), (1, 2, 2, 2), (1, 2, 0))
    rows = TrafficRows(*fields, *(np.zeros(shape, np.float32) for shape in shapes))
    slots = Slots.of(1, VEHICLES)
    slots.row[0] = 0
    place_row(rows, 0, 0, slots.poses, ROAD)
    return rows, slots


def none_found(terms):
    """Results before the first moment."""
    cut = measure_kinds.find_cut(terms)
    count = measure_kinds.count_terms(terms, VEHICLES) * (1 if cut == np.inf else 2)
    return Found(np.full(1, np.inf, np.float32), np.full((1, count), np.inf, np.float32), np.zeros((1, count), int))


def rules_of(measure, terms):
    cut = measure_kinds.find_cut(terms) * TICKS
    return Rules(measure, False, terms, cut, np.float32(0.1), TICKS)


def test_distances_early_and_late():
    rows, slots = one_row()
    rules, found = rules_of(measure_kinds.BY_CLEARANCE, measure_kinds.DISTANCES), none_found(measure_kinds.DISTANCES)
    for slots.tick[0] in (4, 6):
        row_measures.measure_rows(rows, slots, NO_BEAMS, ROAD, rules, found)
    assert np.allclose(found.values, [[15.0, 45.0, 15.0, 45.0]], atol=0.1) and found.f[0] == found.values[0, 0]
    assert found.ticks.tolist() == [[4, 4, 6, 6]]
    assert np.isclose(slots.gap[0], 15.0) and np.isclose(slots.closing[0], 10.0)


def test_a_slot_is_free_after_the_horizon():
    rows, slots = one_row()
    slots.tick[0] = TICKS
    found = none_found(measure_kinds.NO_TERMS)
    rules = rules_of(measure_kinds.BY_TTC, measure_kinds.NO_TERMS)
    row_measures.measure_rows(rows, slots, NO_BEAMS, ROAD, rules, found)
    assert slots.row.tolist() == [-1] and np.isclose(found.f[0], 1.5)  # 15 m / (10 m/s)


@pytest.mark.parametrize(
    ("terms", "x", "y", "term"),
    [
        (measure_kinds.DISTANCES, (100.0, 150.0, 103.0), (5.0, 5.0, 5.0), 1 + 2),
        (measure_kinds.PAIR_DISTANCES, (100.0, 150.0, 153.0), (5.0, 5.0, 5.0), 2 + 3),
        (measure_kinds.PAIR_DISTANCES, (100.0, 150.0, 149.0), (-9.0, 5.0, 9.0), 0 + 3),
        (measure_kinds.LEAD_TIMES, (100.0, 150.0, 180.0), (-9.0, 5.0, 5.0), 2),
        (measure_kinds.LEAD_TIMES, (100.0, 103.0, 180.0), (5.0, 5.0, 5.0), 0),
    ],
)
def test_a_late_collision_belongs_to_a_term(terms, x, y, term):
    rows, slots = one_row(x, y)
    slots.tick[0] = 8
    found, rules = none_found(terms), rules_of(measure_kinds.BY_TTC, terms)
    assert row_measures.has_collided(rows, 0, 0, slots.poses, ROAD, terms == measure_kinds.PAIR_DISTANCES)
    row_measures.record_collision(rows, slots, 0, ROAD, rules, found)
    assert found.f.tolist() == [-1.0] and np.flatnonzero(found.values[0] == -1.0).tolist() == [term]
    assert found.ticks[0, term] == 8


def test_a_collision_of_others_counts_if_asked_for():
    rows, slots = one_row((100.0, 150.0, 153.0))
    assert [row_measures.has_collided(rows, 0, 0, slots.poses, ROAD, any_) for any_ in (False, True)] == [False, True]
