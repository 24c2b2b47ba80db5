"""Tracks and scenes: tables and their file, smoothing and exact replay, axes of roads, lanes and leaders."""

import numpy as np
import pytest

from tests.training.data.recordings import bend, cutting_in
from tests.training.shared_data import DATA, needs_data
from training.data.road_axis import estimate_lane_edges, fit_road_axis
from training.data.scenes import TrafficScene, load_us101_scenes, scenes_of, split_by_clock
from training.data.table import (
    COLUMNS,
    DT,
    MIN_HEADING_SPEED,
    NOBODY,
    SCENES_FILE,
    infer_motion,
    resample_tracks,
    smooth_positions,
    synthetic_traffic,
    tabulate,
)

GOOD = {
    "recording": "r",
    "vehicle": [1, 1, 2],
    "frame": [1, 2, 1],
    "x": [0.0, 1.0, 9.0],
    "y": 1.75,
    "speed": 10.0,
    "acceleration": 0.0,
    "length": 4.5,
    "width": 1.8,
    "lane": 1,
    "leader": [2, NOBODY, NOBODY],
}


def test_a_table_is_sorted_and_checked():
    shuffled = {**GOOD, "vehicle": [2, 1, 1], "frame": [1, 2, 1], "x": [9.0, 1.0, 0.0], "leader": [-1, -1, 2]}
    assert tabulate(shuffled).x.tolist() == [0.0, 1.0, 9.0]
    assert tabulate(GOOD).find_rows(tabulate(GOOD).leader).tolist() == [2, -1, -1]
    for changes, message in (
        ({"frame": [1, 1, 1]}, "Rows 0 and 1 are not in order"),
        ({"x": [0.0, np.nan, 9.0]}, "Row 1: expected x a finite number, got nan"),
        ({"speed": [1.0, 1.0, -1.0]}, "Row 2: expected speed of at least 0, got -1"),
        ({"length": 0.0}, "Row 0: expected length above 0, got 0"),
        ({name: [] for name in COLUMNS}, "at least one row"),
    ):
        with pytest.raises(ValueError, match=message):
            tabulate({**GOOD, **changes})
    with pytest.raises(ValueError, match="must increase"):
        tabulate(GOOD, {"r": (0.0, 3.5, 3.5)})


def replayed(track, x, y):
    """The simulator's step: explicit Euler, old values."""
    heading, speed, acceleration, yaw_rate = track
    states = [(x[0], y[0], heading[0], speed[0])]
    for a, w in zip(acceleration[:-2], yaw_rate[:-2], strict=True):
        px, py, h, v = states[-1]
        states.append((px + v * np.cos(h) * DT, py + v * np.sin(h) * DT, h + w * DT, v + a * DT))
    return np.array(states)


def test_gain_of_a_wave_is_that_of_the_filter_and_holes_are_refused():
    t, middle = DT * np.arange(2000), slice(500, 1500)
    for frequency in (0.1, 0.4, 0.8):
        wave = np.sin(2.0 * np.pi * frequency * t)
        gain = 1.0 / (1.0 + ((1 - np.cos(2 * np.pi * frequency * DT)) / (1 - np.cos(2 * np.pi * 0.4 * DT))) ** 3)
        np.testing.assert_allclose(smooth_positions(wave, 0.4)[middle], gain * wave[middle], atol=1e-6)
    with pytest.raises(ValueError, match="cut the track"):
        smooth_positions(np.array([1.0, np.nan, 2.0, 3.0]), 0.4)


def test_replaying_the_actions_gives_the_track():
    t = DT * np.arange(60)
    x, y = 10.0 * t + np.sin(t), 3.5 / (1.0 + np.exp(3.0 - t))
    states = replayed(infer_motion(x, y), x, y)
    np.testing.assert_allclose(states[:, 0], x[:-1], atol=1e-10)
    np.testing.assert_allclose(states[:, 1], y[:-1], atol=1e-10)


def test_a_creeping_vehicle_does_not_spin():
    jitter = 0.02 * np.random.default_rng(0).standard_normal((2, 50))
    heading, speed, *_ = infer_motion(np.cumsum(jitter[0]), jitter[1])
    assert np.nanmin(speed) >= 0.0
    assert np.nanmax(np.abs(heading)) <= np.arctan2(1.5, MIN_HEADING_SPEED)


def test_cubics_and_lines_are_exact_and_holes_are_cut():
    frames = np.concatenate([np.arange(3, 40), np.arange(52, 80)])  # at 25 Hz, frames 40 to 51 are missing
    time = 0.04 * frames
    order = np.random.default_rng(0).permutation(len(time))
    cubic, line = (1.0 + 20.0 * time - time**3)[order], (20.0 - 1.5 * time)[order]
    rows, nearest = resample_tracks(np.full(len(time), 7.0), time[order], 0.04, {"x": cubic}, {"speed": line})
    # 0.12 to 1.56 s and 2.08 to 3.16 s
    assert rows["frame"].tolist() == [*range(2, 16), *range(21, 32)]
    t = 0.1 * rows["frame"]
    np.testing.assert_allclose(rows["x"], 1.0 + 20.0 * t - t**3, atol=1e-9)
    np.testing.assert_allclose(rows["speed"], 20.0 - 1.5 * t, atol=1e-9)
    assert (np.abs(time[order][nearest] - t) <= 0.02 + 1e-9).all()
    assert set(rows["vehicle"]) == {7.0}


LANES = np.array([1.8, 5.4, 9.0])


def tracks(rng, length=1200.0, noise=0.3):
    """Positions along and across, and lanes: lanes are used unevenly, and vehicles weave."""
    lane = rng.choice(3, 6000, p=[0.6, 0.3, 0.1])
    return rng.uniform(0.0, length, 6000), LANES[lane] + noise * rng.standard_normal(6000), lane


@pytest.mark.parametrize(("radius", "angle"), [(np.inf, 2.5), (1000.0, 0.0), (-800.0, 2.5)])
def test_distances_along_and_across_are_kept(radius, angle):
    x, y, lane = tracks(np.random.default_rng(0))
    there = {"radius": radius, "angle": angle, "shift": (300.0, 90.0)}
    u, w = bend(x, y, **there)
    heading = np.array([np.subtract(*bend(np.array([600.0, 590.0]), 0.0, **there)[k]) for k in (0, 1)])
    along, across = fit_road_axis(u, w, lane, heading)(u, w)
    # the axis is parallel to the road at some distance, of which radians of the turn are lost along it
    offset = np.median(across - y)
    assert abs(offset) < 20.0
    np.testing.assert_allclose(across - offset, y, atol=0.25)
    scale = 1.0 + offset / radius
    np.testing.assert_allclose(along - along.mean(), scale * (x - x.mean()), atol=0.3)


def test_points_beyond_the_ends_lie_on_the_tangents():
    x, y, lane = tracks(np.random.default_rng(2), noise=0.0)
    along, across = fit_road_axis(x, y, lane, np.array([1.0, 0.0]))(np.array([0.0, 1200.0, 1250.0]), np.full(3, 5.4))
    assert np.diff(along) == pytest.approx([1200.0, 50.0], abs=0.01)
    assert np.ptp(across) < 0.01


def test_lane_boundaries_lie_halfway_and_ramps_do_not_count():
    y = np.array([1.8, 5.4, 9.1, 12.0, 12.1])
    np.testing.assert_allclose(estimate_lane_edges(y, np.arange(1, 6)), (0.0, 3.6, 7.25, 10.55, 13.45), atol=1e-12)
    assert estimate_lane_edges(y[:1], np.array([1])) == ()
    assert estimate_lane_edges(y[1:3], np.array([2, 3])) == ()


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
    columns = {name: getattr(table, name) for name in COLUMNS}
    for changes, edges, message in (
        ({}, None, r"'r' .* boundaries, of which it has none.*y = 1\.8 to 5\.2 m, lane 1 at 1\.8 m"),
        ({}, {"r": (-7.0, -3.5, 0.0)}, r"nobody between .*, \(-7\.0, -3\.5, 0\.0\).* its vehicles are at y ="),
        ({"width": np.nan}, None, "Scenes need width"),
    ):
        with pytest.raises(ValueError, match=message):
            scenes_of(tabulate({**columns, **changes}, edges))
    with pytest.raises(ValueError, match=r"scenes of 0\.4 s or more"):
        scenes_of(table, seconds=0.1)
