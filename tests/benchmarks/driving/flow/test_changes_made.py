import math

import pytest
import torch

from benchmarks.driving.flow.changes_made import (
    QUANTITIES,
    describe_changes,
    drive_as_recording,
    exposure,
    share_completed,
    summarise_changes,
    under_way,
)
from rare_envs.sensors.perception import HEADING_COLUMN
from tests.training.imitation.synthetic_scenes import CROSSING, crossing_recording


@pytest.fixture
def recording():
    return crossing_recording()


def straight(features, memory):
    return torch.zeros(*features.shape[:2], 2), None


def test_a_change_is_described_from_its_beginning_to_its_end(recording):
    found = describe_changes(recording)
    assert {name: len(values) for name, values in found.items()} == dict.fromkeys((*QUANTITIES, "side", "lane"), 1)
    assert (found["side"][0], found["lane"][0]) == (1.0, 0.0)
    assert found["duration"][0] == pytest.approx(3.6, abs=0.5)  # 36 ticks at 1 m/s
    begun = 12
    assert found["speed"][0] == pytest.approx(float(recording.speed[1, begun : begun + 3, 0].mean()), abs=0.1)
    same, beside = recording.x[1, begun, 3], recording.x[1, begun, [1, 4, 7]]
    assert found["gap ahead"][0] == pytest.approx(float(same - recording.x[1, begun, 0] - 4.5), abs=1.5)
    ahead = beside[beside >= recording.x[1, begun, 0]].min() - recording.x[1, begun, 0]
    assert found["new gap ahead"][0] == pytest.approx(float(ahead) - 4.5, abs=1.5)


def test_who_crosses_from_the_first_tick_on_has_no_beginning(recording):
    y = recording.y.clone()
    y[1, :, 0] = 3.601 + 0.1 * (torch.arange(y.shape[1]) - CROSSING)
    found = describe_changes(recording._replace(y=y))
    assert math.isnan(found["duration"][0]) and math.isnan(found["new gap ahead"][0])


def test_changes_are_compared_with_those_of_people(recording):
    people = describe_changes(recording)
    found = summarise_changes(people, exposure(recording), people)
    assert found["changes"] == 1
    assert found["per_10_s"] == pytest.approx(10.0 / (0.1 * float(recording.acts.sum())))
    assert found["to_the_left"] == 0.0
    assert found["duration"]["distance"] == 0.0


def test_moments_at_which_a_change_is_under_way_are_completed_by_who_goes_straight_on(recording):
    def back(features, memory):
        action = torch.zeros(*features.shape[:2], 2)
        action[..., 1] = -features[..., HEADING_COLUMN] / 0.1 - 0.01
        return action, None

    chosen = under_way(recording)
    times = [seconds for seconds, crossings in chosen.items() if len(crossings.tick)]
    assert times == pytest.approx([0.2, 0.6, 1.0, 1.4, 1.8])  # it moves for 1.8 s before the crossing
    all_of_them = {"changes": 1, "moments": 5.0, "completed": 1.0, "interval": [1.0, 1.0]}
    assert share_completed(recording, [straight]) == all_of_them
    assert share_completed(recording, [back])["completed"] < 0.5
    assert share_completed(recording._replace(y=recording.y[:, :1].expand_as(recording.y)), [straight]) == {
        "changes": 0,
        "moments": 0.0,
        "completed": 0.0,
    }


def test_the_interval_of_the_share_is_by_changes_and_not_by_moments(recording):
    """Two changes, in either scene one, of five moments each; the driver goes on in the second scene alone."""
    both = recording
    for name in ("y", "heading"):
        field = getattr(both, name).clone()  # a field by its name
        field[0, :, 0] = field[1, :, 0]
        both = both._replace(**{name: field})

    def second_only(features, memory):
        action = torch.zeros(*features.shape[:2], 2)
        action[0, :, 1] = -features[0, :, HEADING_COLUMN] / 0.1 - 0.01
        return action, None

    found = share_completed(both, [second_only])
    assert (found["changes"], found["moments"]) == (2, 10.0)
    assert 0.5 <= found["completed"] < 1.0
    low, high = found["interval"]
    assert low == pytest.approx(2.0 * found["completed"] - 1.0)  # the first scene's change drawn twice
    assert high == 1.0


def test_drives_are_recorded(recording):
    made = drive_as_recording(recording, straight, 2.0)
    assert made.x.shape[:2] == made.acceleration.shape[:2]
    assert made.x.shape[1] == 20
    assert bool((made.speed[:, 0][made.acts[:, 0]] == made.speed[:, -1][made.acts[:, -1]]).all())
    assert exposure(made) == pytest.approx(0.2 * int(made.acts[:, 0].sum()))
