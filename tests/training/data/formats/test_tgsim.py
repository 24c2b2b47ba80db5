"""Files of TGSIM, there and back: runs, directions and curves in the frame of the road, and what is refused."""

import numpy as np
import pytest

from tests.training.data.formats.published_files import tgsim_rows, write_tgsim
from tests.training.data.recordings import DT, LANE, change, simulate, write_csv
from training.data.events import car_following_events, cut_in_events, find_lane_changes
from training.data.formats.tgsim import find_tgsim_files, load_tgsim
from training.data.trajectories import COLUMNS, NOBODY, find_leaders
from training.data.windows import scenes_of

TURNED = {"radius": 900.0, "angle": 2.6, "shift": (400.0, 60.0)}


@pytest.fixture(scope="module")
def rows(traffic):
    return tgsim_rows(traffic)


def truth(traffic, table, first=0):
    k, i = np.rint(table.time / DT).astype(int), table.vehicle - first
    values = {name: getattr(traffic, name)[k, i] for name in ("x", "y", "speed", "acceleration", "lane")}
    return values | {"length": traffic.length[i], "width": traffic.width[i]}


@pytest.mark.parametrize(
    ("place", "side"),
    [
        ({}, "right"),
        ({"angle": np.pi / 2, "shift": (50.0, 0.0)}, "down"),
        ({"angle": np.pi - 0.2}, "left"),
        ({"angle": -1.4}, "up"),
        (TURNED, "left"),
        ({**TURNED, "radius": -900.0, "angle": 2.0}, "down"),
    ],
)
def test_tracks_are_found_in_the_frame_of_the_road(place, side, traffic, tmp_path):
    table = load_tgsim(write_tgsim(tmp_path / "I294.csv", tgsim_rows(traffic, lanes=(11, 12, 13), **place)))
    name = f"I294-1-{side}"
    assert set(table.recording) == {name}
    values = truth(traffic, table)
    for column in ("speed", "acceleration", "length", "width"):
        np.testing.assert_allclose(table.column(column), values[column], atol=1e-4)
    assert (table.lane == 1 + values["lane"]).all()
    offset = np.median(table.y - values["y"])
    np.testing.assert_allclose(table.y - offset, values["y"], atol=0.15)
    scale = 1.0 + offset / place.get("radius", np.inf)
    np.testing.assert_allclose(table.x - table.x.mean(), scale * (values["x"] - values["x"].mean()), atol=0.25)
    row = find_leaders(table.frame, 1 + values["lane"], values["x"])
    assert (table.leader == np.where(row >= 0, table.vehicle[row], NOBODY)).all()
    np.testing.assert_allclose(np.diff(table.edges[name]), LANE, atol=0.25)
    assert len(scenes_of(table, seconds=5.0)) >= 2


def test_events_on_a_curve_are_those_of_the_straight_road(traffic, rows, tmp_path):
    straight = load_tgsim(write_tgsim(tmp_path / "straight.csv", rows))
    curved = load_tgsim(write_tgsim(tmp_path / "curved.csv", tgsim_rows(traffic, **TURNED)))
    pairs = [car_following_events(table) for table in (straight, curved)]
    for name in ("ego", "lead", "frame", "n"):
        assert (pairs[0][name] == pairs[1][name]).all()
    np.testing.assert_allclose(pairs[0]["gap"], pairs[1]["gap"], rtol=0.02, atol=0.1)
    cuts = [cut_in_events(table) for table in (straight, curved)]
    assert len(cuts[0]["ego"]) >= 6 and (traffic.changed[cuts[0]["vehicle"]] >= 0).all()
    for name in ("vehicle", "ego", "lead", "from_lane", "to_lane", "start_seen"):
        assert (cuts[0][name] == cuts[1][name]).all()
    assert np.abs(cuts[0]["frame"] - cuts[1]["frame"]).max() <= 2
    np.testing.assert_allclose(cuts[0]["lateral_offset"], cuts[1]["lateral_offset"], atol=0.25)


def test_runs_and_directions_are_recordings_of_their_own(traffic, rows, tmp_path):
    """Numbers of vehicles come again in the next run; the lanes of the other direction are negative."""
    other = simulate(1, lanes=2, per_lane=6, seconds=10.0)
    back = tgsim_rows(other, lanes=(-2, -1), first=500, angle=np.pi, shift=(400.0, -6.0))
    table = load_tgsim(write_tgsim(tmp_path / "I294.csv", [*rows, *back, *tgsim_rows(other, run=2)]))
    assert np.unique(table.recording).tolist() == ["I294-1-left", "I294-1-right", "I294-2-right"]
    left = table.select(table.recording == "I294-1-left")
    assert (left.vehicle >= 500).all() and (left.speed > 0.0).all()
    values = truth(other, left, 500)
    assert (left.lane == 1 + values["lane"]).all()
    np.testing.assert_allclose(
        np.diff(left.x)[np.diff(left.vehicle) == 0], np.diff(values["x"])[np.diff(left.vehicle) == 0], atol=2e-3
    )
    first = load_tgsim(write_tgsim(tmp_path / "I294.csv", rows))
    right = table.select(table.recording == "I294-1-right")
    for name in COLUMNS:
        assert (right.column(name) == first.column(name)).all()


def test_a_shoulder_is_outside_the_lanes(traffic, rows, tmp_path):
    shoulder = [{**row, "lane_kf": -1 if row["lane_kf"] == 3 else row["lane_kf"]} for row in rows]
    table = load_tgsim(write_tgsim(tmp_path / "I395.csv", shoulder))
    assert ((table.lane == 0) == (truth(traffic, table)["lane"] == 2)).all()
    assert (table.leader[table.lane == 0] == NOBODY).all()


def test_hyphens_no_runs_and_a_clock_between_ticks(rows, tmp_path):
    """Headers of earlier downloads, and I-395's file, which has no column of runs."""
    table = load_tgsim(write_tgsim(tmp_path / "I395.csv", rows))
    old = [{k.replace("_", "-").replace("id", "ID"): v for k, v in row.items() if k != "run_index"} for row in rows]
    late = [{**row, "time": round(row["time"] + 0.04, 2)} for row in old]
    (tmp_path / "old").mkdir()
    other = load_tgsim(write_tgsim(tmp_path / "old" / "I395.csv", late))
    for name in COLUMNS:
        assert (other.column(name) == table.column(name)).all()


def test_files_of_a_folder_are_found(rows, tmp_path):
    write_tgsim(tmp_path / "b.csv", rows[:1])
    write_tgsim(tmp_path / "a.csv", rows[:1])
    (tmp_path / "geometry.csv").write_text("x1,y1\n1,2\n", encoding="utf-8")
    (tmp_path / "empty.csv").write_text("", encoding="utf-8")
    assert [path.name for path in find_tgsim_files(tmp_path)] == ["a.csv", "b.csv"]
    assert find_tgsim_files(tmp_path / "geometry.csv") == (tmp_path / "geometry.csv",)
    (tmp_path / "none").mkdir()
    with pytest.raises(ValueError, match="has no CSV file with a column xloc_kf"):
        find_tgsim_files(tmp_path / "none")


BROKEN = {
    "a column is missing": (
        lambda r: [{k: v for k, v in x.items() if k != "lane_kf"} for x in r],
        "lacks the columns lane_kf",
    ),
    "streets": (lambda r: [{**x, "speed_kf_x": 1.0, "speed_kf_y": 0.0} for x in r], "is of streets"),
    "a row is given twice": (
        lambda r: [*r, r[4]],
        r"line \d+: vehicle \d+ at frame \d+ is given twice, first in line 6",
    ),
    "a frame is missing": (lambda r: r[:20] + r[23:], r"line 22: vehicle \d+ was missing for 3 frames"),
    "a word": (lambda r: change(r, 7, speed_kf="fast"), "line 9: speed_kf is 'fast', a number was expected"),
    "nothing": (lambda r: change(r, 7, yloc_kf=""), "line 9: yloc_kf is empty"),
    "not finite": (lambda r: change(r, 7, xloc_kf="inf"), "line 9: xloc_kf is inf"),
    "feet": (
        lambda r: [{**x, "length_smoothed": x["length_smoothed"] / 0.3048 * 3.0} for x in r],
        "the median length of vehicles is .* in metres",
    ),
    "km/h": (
        lambda r: [{**x, "speed_kf": 2.0 * x["speed_kf"]} for x in r],
        r"positions move 0\.(5|49)\d* times as fast",
    ),
    "a jump": (lambda r: change(r, 7, xloc_kf=r[7]["xloc_kf"] + 30.0), r"line 9: vehicle \d+ moved 3\d\.\d* m"),
    "25 Hz": (lambda r: [{**x, "time": 0.4 * x["time"]} for x in r], "times are 0.04 s apart, expected 0.1 s"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_files_are_refused_with_file_and_line(name, rows, tmp_path):
    spoil, message = BROKEN[name]
    path = tmp_path / "broken.csv"
    write_csv(path, spoil(rows))
    with pytest.raises(ValueError, match=message) as caught:
        load_tgsim(path)
    assert "broken.csv" in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(("text", "message"), [("", "is empty"), ("id,time\n1,2\n", "lacks the columns xloc_kf")])
def test_other_files_are_refused(text, message, tmp_path):
    path = tmp_path / "odd.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ValueError, match=message):
        load_tgsim(path)
    with pytest.raises(ValueError, match=r"Cannot read .*none\.csv"):
        load_tgsim(tmp_path / "none.csv")


def test_holes_and_empty_fields_are_cut_on_request(rows, tmp_path):
    """A frame without a position is a frame that the camera lost."""
    path = tmp_path / "holes.csv"
    write_csv(path, change(change(rows, 7, yloc_kf=""), 30, lane_kf=""))
    table = load_tgsim(path, gaps="cut")
    assert len(table) == len(rows) - 2
    assert len(table.track_starts()) == len({row["id"] for row in rows}) + 2
    write_csv(path, change(rows, 7, yloc_kf="lost"))
    with pytest.raises(ValueError, match="line 9: yloc_kf is 'lost'"):
        load_tgsim(path, gaps="cut")
    write_csv(path, [{**row, "yloc_kf": ""} for row in rows])
    with pytest.raises(ValueError, match="no row in which every number is given"):
        load_tgsim(path, gaps="cut")


def test_lane_changes_are_those_that_were_driven(traffic, rows, tmp_path):
    table = load_tgsim(write_tgsim(tmp_path / "I294.csv", rows))
    changes = find_lane_changes(table)
    assert len(changes) >= 3
    assert (traffic.changed[table.vehicle[changes]] >= 0).all()
