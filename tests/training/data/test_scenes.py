"""Scenes: lanes, leaders, the split by the clock, and the recorded ones against what is known of them."""

import numpy as np
import pytest

from tests.training.data.recordings import cutting_in
from tests.training.shared_data import DATA, needs_data
from training.data.scenes import TrafficScene, load_us101_scenes, scenes_of, split_by_clock
from training.data.smoothing import MIN_HEADING_SPEED
from training.data.table import COLUMNS, DT, SCENES_FILE, synthetic_traffic, tabulate


def tiny_scene(**changes):
    lane = np.array([[1.0, 1.0, 5.0], [1.2, 1.2, 5.0]])
    known = np.ones((2, 3))
    fields = {
        "name": "tiny",
        "start": 0.0,
        "edges": (0.0, 3.5, 7.0),
        "x": np.array([[0.0, 9.0, 4.0], [1.0, 10.0, 5.0]]),
        "y": lane,
        "heading": 0.0 * known,
        "speed": 10.0 * known,
        "acceleration": np.array([[0.0] * 3, [np.nan] * 3]),
        "yaw_rate": np.array([[0.0] * 3, [np.nan] * 3]),
        "present": known.astype(bool),
        "length": np.full(3, 4.5),
        "width": np.full(3, 1.8),
    }
    return TrafficScene(**(fields | changes))


def test_lanes_and_leaders_of_a_scene():
    scene = tiny_scene()
    assert scene.lane_numbers().tolist() == [[0, 0, 1]] * 2
    assert scene.leads_lane().tolist() == [[False, True, True]] * 2
    assert scene.acted.tolist() == [[True] * 3, [False] * 3]
    assert scene.end == pytest.approx(0.1)


def test_a_scene_with_states_missing_is_refused():
    with pytest.raises(ValueError, match="finite where present"):
        tiny_scene(x=np.array([[0.0, np.nan, 4.0], [1.0, 10.0, 5.0]]))
    with pytest.raises(ValueError, match="length and width"):
        tiny_scene(length=np.zeros(2))


def test_no_scene_lies_across_the_end_of_a_test_interval():
    early, late = tiny_scene(), tiny_scene(start=10.0)
    assert split_by_clock([early, late], [(9.0, 11.0)]) == ((early,), (late,))
    with pytest.raises(ValueError, match="lies across"):
        split_by_clock([early, late], [(10.05, 11.0)])


@needs_data(SCENES_FILE)
def test_recorded_scenes_are_what_was_measured():
    scenes = load_us101_scenes(DATA)
    train, test = split_by_clock(scenes)
    assert [scene.name[-2:] for scene in test] == ["02", "11", "12", "17", "21", "22", "29"]
    assert len(train) == 21
    chosen = [[scene.acted & ~scene.leads_lane() for scene in part] for part in (train, test)]
    assert [sum(int(mask.sum()) for mask in masks) for masks in chosen] == [37_999, 13_343]
    masks = dict(zip([s.name for s in (*train, *test)], [m for masks in chosen for m in masks], strict=True))
    acceleration = np.concatenate([scene.acceleration[masks[scene.name]] for scene in scenes])
    yaw_rate = np.concatenate([scene.yaw_rate[masks[scene.name]] for scene in scenes])
    assert acceleration.std() == pytest.approx(0.79, abs=0.01)
    assert (acceleration <= -3.0).mean() == pytest.approx(0.0006, abs=0.0001)
    assert yaw_rate.std() == pytest.approx(0.019, abs=0.001)
    assert sum(int((scene.present & (scene.lane_numbers() < 0)).sum()) for scene in scenes) <= 1
    for scene in scenes:
        assert scene.edges[:2] == (0.0, 3.49)
        moved = scene.x[:-1] + scene.speed[:-1] * np.cos(scene.heading[:-1]) * DT - scene.x[1:]
        assert np.abs(moved[scene.acted[:-1] & scene.present[1:] & (scene.speed[:-1] > MIN_HEADING_SPEED)]).max() < 1e-9


def test_scenes_follow_the_record_and_meet_where_they_were_cut():
    table = synthetic_traffic(seconds=12.0)
    (whole,) = scenes_of(table, seconds=100.0)
    first, second, _ = scenes_of(table, seconds=4.0)
    np.testing.assert_array_equal(np.concatenate((first.x, second.x)), whole.x[:80])
    assert (first.acted & ~first.leads_lane()).any(axis=0).sum() == 6
    assert np.nanmax(np.abs(whole.acceleration)) < 1.5  # the recorded speeds have 1.3 m/s^2


def test_what_scenes_need_is_named():
    table = cutting_in()
    columns = {name: table.column(name) for name in COLUMNS}
    with pytest.raises(ValueError, match=r"'r' has no lane boundaries.*y = 1\.8 to 5\.2 m.*lane 1 at 1\.8 m"):
        scenes_of(tabulate(columns))
    with pytest.raises(ValueError, match=r"nobody between its lane boundaries, -7 to 0 m; its vehicles are at y ="):
        scenes_of(tabulate(columns, {"r": (-7.0, -3.5, 0.0)}))
    with pytest.raises(ValueError, match="Scenes need width"):
        scenes_of(tabulate({name: table.column(name) for name in COLUMNS} | {"width": np.nan}))
    with pytest.raises(ValueError, match=r"scenes of 0\.4 s or more"):
        scenes_of(table, seconds=0.1)
