"""Smoothing against its transfer function, exact replay, and the recorded scenes against what is known of them."""

from pathlib import Path

import numpy as np
import pytest

from training.data.ngsim_tables import SCENES_FILE
from training.data.scenes import TrafficScene, load_us101_scenes, split_by_clock
from training.data.smoothing import MIN_HEADING_SPEED, infer_motion, smooth_positions
from training.data.trajectories import DT

DATA = Path(__file__).parents[4] / "shared" / "data"
needs_data = pytest.mark.skipif(
    not (DATA / SCENES_FILE).is_file(), reason=f"recorded traffic is not part of the repository: {DATA} is absent"
)


def test_parabolas_pass_unchanged():
    t = DT * np.arange(80)
    positions = 3.0 + 12.0 * t - 0.7 * t**2
    np.testing.assert_allclose(smooth_positions(positions, 0.4, DT), positions, atol=1e-6)


@pytest.mark.parametrize("frequency", [0.1, 0.4, 0.8])
def test_gain_of_a_wave_is_that_of_the_filter(frequency):
    t = DT * np.arange(2000)
    wave = np.sin(2.0 * np.pi * frequency * t)
    gain = 1.0 / (1.0 + ((1 - np.cos(2 * np.pi * frequency * DT)) / (1 - np.cos(2 * np.pi * 0.4 * DT))) ** 3)
    middle = slice(500, 1500)
    np.testing.assert_allclose(smooth_positions(wave, 0.4, DT)[middle], gain * wave[middle], atol=1e-6)


def test_short_tracks_come_back_and_holes_are_refused():
    assert smooth_positions(np.array([1.0, 5.0, 2.0]), 0.4, DT).tolist() == [1.0, 5.0, 2.0]
    with pytest.raises(ValueError, match="cut the track"):
        smooth_positions(np.array([1.0, np.nan, 2.0, 3.0]), 0.4, DT)
    with pytest.raises(ValueError, match="cut-off"):
        smooth_positions(np.zeros(9), 6.0, DT)


def replayed(track, x, y):
    """The simulator's step: explicit Euler, old values."""
    states = [(x[0], y[0], track.heading[0], track.speed[0])]
    for a, w in zip(track.acceleration[:-2], track.yaw_rate[:-2], strict=True):
        px, py, h, v = states[-1]
        states.append((px + v * np.cos(h) * DT, py + v * np.sin(h) * DT, h + w * DT, v + a * DT))
    return np.array(states)


def test_replaying_the_actions_gives_the_track():
    t = DT * np.arange(60)
    x, y = 10.0 * t + np.sin(t), 3.5 / (1.0 + np.exp(3.0 - t))
    states = replayed(infer_motion(x, y, DT), x, y)
    np.testing.assert_allclose(states[:, 0], x[:-1], atol=1e-10)
    np.testing.assert_allclose(states[:, 1], y[:-1], atol=1e-10)


def test_a_creeping_vehicle_does_not_spin():
    jitter = 0.02 * np.random.default_rng(0).standard_normal((2, 50))
    track = infer_motion(np.cumsum(jitter[0]), jitter[1], DT)
    assert np.nanmin(track.speed) >= 0.0
    assert np.nanmax(np.abs(track.heading)) <= np.arctan2(1.5, MIN_HEADING_SPEED)


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


@needs_data
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


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(ValueError, match=SCENES_FILE):
        load_us101_scenes(tmp_path)
