"""Files of TGSIM, there and back: runs, directions and curves in the frame of the road, and what is refused."""

import numpy as np
import pytest

from tests.training.data.published_files import tgsim_rows, write_tgsim
from tests.training.data.recordings import DT, LANE, change, simulate, write_csv
from training.data.formats import find_tgsim_files, load_tgsim
from training.data.scenes import scenes_of
from training.data.table import COLUMNS, NOBODY, find_leaders

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


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda r: [{k: v for k, v in x.items() if k != "lane_kf"} for x in r], "lacks the columns lane_kf"),
        (lambda r: [{**x, "speed_kf_x": 1.0, "speed_kf_y": 0.0} for x in r], "is of streets"),
        (lambda r: change(r, 7, speed_kf="fast"), "line 9: speed_kf is 'fast', a number was expected"),
        (lambda r: change(r, 7, yloc_kf=""), "line 9: yloc_kf is empty"),
        (lambda r: [{**x, "length_smoothed": 10.0 * x["length_smoothed"]} for x in r], "median length .* in metres"),
        (lambda r: change(r, 7, xloc_kf=r[7]["xloc_kf"] + 30.0), r"line 9: vehicle \d+ moved 3\d\.\d* m"),
        (lambda r: [{**x, "time": 0.4 * x["time"]} for x in r], "times are 0.04 s apart, expected 0.1 s"),
    ],
)
def test_broken_files_are_refused_with_file_and_line(spoil, message, rows, tmp_path):
    path = tmp_path / "broken.csv"
    write_csv(path, spoil(rows))
    with pytest.raises(ValueError, match=message) as caught:
        load_tgsim(path)
    assert "broken.csv" in str(caught.value) and "\n" not in str(caught.value)


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
