import math
from dataclasses import replace

import pytest
import torch

from agents import load_driver
from agents.learned.collision_avoidance import CloseRange
from agents.learned.lane_changes import LaneChanges, Waiting
from tests.agents.learned.test_lane_changes import OTHERS, on_lane
from tests.training.imitation.synthetic_scenes import CROSSING, crossing_recording
from training.imitation.changes_under_way import (
    Moving,
    TakenUp,
    collect_moving,
    format_recognition,
    format_waiting,
    judge_recognition,
    take_up_changes,
    wait_for_gaps,
)
from training.imitation.traffic.replayed_traffic import first_in_lane


def test_moments_before_a_crossing_know_its_side_and_the_others_know_none():
    recording = crossing_recording()
    moving = collect_moving(recording)
    coming = moving.coming != 0.0
    assert int(coming.sum()) == CROSSING  # all of its moments before the line are within 3 s of it
    assert moving.coming[coming].unique().tolist() == [1.0]
    assert float(moving.across[coming].max()) == pytest.approx(1.0, abs=1e-3)


def test_vehicles_that_nobody_drives_are_left_out_and_the_end_of_the_record_is_not_known():
    recording = crossing_recording()
    moving = collect_moving(recording)
    driven = 0
    for tick in range(recording.x.shape[1]):
        x, y, present = recording.x[:, tick], recording.y[:, tick], recording.present[:, tick]
        driven += int((recording.acts[:, tick] & ~first_in_lane(x, y, present, recording.edges)).sum())
    assert len(moving.known) == driven
    assert 0 < int(moving.known.sum()) < driven


def made_moments():
    """Four moments at 0.2 m/s and more to the right: two of changes, one that is not one, one at the road's edge."""
    offset, across = (1.0, 0.5, 0.5, 1.1), (0.8, 0.6, 0.5, 1.0)
    beams = (OTHERS, OTHERS, OTHERS, {})
    rows = [on_lane(o, math.asin(v / 20.0), **seen) for o, v, seen in zip(offset, across, beams, strict=True)]
    return Moving(
        features=torch.cat(rows)[:, 0],
        coming=torch.tensor([1.0, 1.0, 0.0, 0.0]),
        known=torch.tensor([True, True, True, False]),
        across=torch.tensor(across),
        off_road=torch.tensor([False, False, False, True]),
    )


def judged(foresight, over_line):
    return judge_recognition(made_moments(), replace(LaneChanges(), foresight=foresight, over_line=over_line))


def test_who_looks_further_ahead_takes_up_more_changes_and_has_more_alarms():
    """The middles reach the line, 1.8 m off, in 1, 2.17 and 2.6 s."""
    assert judged(0.9, 0.4) == TakenUp(changing=2, share=0.0, alarms=0.0, off_road=0)
    assert judged(2.1, 0.4) == TakenUp(changing=2, share=0.5, alarms=0.0, off_road=0)
    assert judged(2.4, 0.4) == TakenUp(changing=2, share=1.0, alarms=0.0, off_road=0)
    assert judged(2.7, 0.4) == TakenUp(changing=2, share=1.0, alarms=1000.0, off_road=0)


def test_a_change_over_the_edge_of_the_road_is_counted_and_is_no_alarm_where_the_record_ends():
    assert judged(2.4, 0.2) == TakenUp(changing=2, share=1.0, alarms=0.0, off_road=1)  # 0.3 m over the line


def test_the_table_has_a_row_for_each_choice():
    lines = format_recognition(collect_moving(crossing_recording()), LaneChanges(), (2.1, 2.4)).splitlines()
    assert len(lines) == 2 + 4
    assert lines[2].startswith("| 2.1 | 0.4 | ")


def test_the_shipped_driver_is_mgail3_with_other_settings():
    shipped, before = load_driver("mgail4"), load_driver("mgail3")
    made = take_up_changes(before, "mgail4")
    assert (shipped.changes, shipped.avoidance, shipped.hard_braking) == (
        made.changes,
        made.avoidance,
        made.hard_braking,
    )
    assert shipped.changes == replace(before.changes, foresight=2.4, over_line=0.2)
    assert shipped.avoidance == replace(before.avoidance, close=CloseRange())
    assert shipped.colour == before.colour
    same = [torch.equal(a, b) for a, b in zip(shipped.policy.parameters(), before.policy.parameters(), strict=True)]
    assert all(same)


def test_with_waiting_changes_into_lanes_that_nobody_shows_are_taken_up_and_no_slower_ones():
    """The middles reach the line in 1, 2.17 and 2.6 s, and the one at the road's edge in 0.7 s."""
    changes = replace(LaneChanges(), foresight=0.9, waiting=Waiting(foresight=1.1))
    taken = judge_recognition(made_moments(), changes)
    assert (taken.share, taken.alarms, taken.off_road) == (0.5, 0.0, 1)


def test_the_table_has_a_row_without_waiting_and_one_for_each_time():
    lines = format_waiting(collect_moving(crossing_recording()), LaneChanges(), (1.5, 1.8)).splitlines()
    assert [line.split("|")[1].strip() for line in lines[2:]] == ["none", "1.5", "1.8"]


def test_the_shipped_driver_that_waits_is_mgail4_with_other_settings():
    shipped, before = load_driver("mgail5"), load_driver("mgail4")
    assert shipped.changes == wait_for_gaps(before, "mgail5").changes
    assert shipped.changes == replace(before.changes, waiting=Waiting())
    assert (shipped.avoidance, shipped.hard_braking, shipped.colour) == (
        before.avoidance,
        before.hard_braking,
        before.colour,
    )
    same = [torch.equal(a, b) for a, b in zip(shipped.policy.parameters(), before.policy.parameters(), strict=True)]
    assert all(same)


@pytest.mark.parametrize("make", [take_up_changes, wait_for_gaps])
def test_a_driver_without_lane_changes_is_refused(make):
    with pytest.raises(ValueError, match="Expected a driver that changes lanes at a hazard rate, got 'mgail2'"):
        make(load_driver("mgail2"), "any")
