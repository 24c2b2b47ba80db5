"""Files in the formats of recorded traffic, there and back: values, lanes, leaders, and every way to be broken."""

from pathlib import Path

import numpy as np
import pytest

from tests.training.data.recordings import DT, FOOT, LANE, simulate, write_csv, write_highd, write_ngsim
from training.data.highd import highd_recordings, load_highd
from training.data.ngsim import estimate_lane_edges, load_ngsim
from training.data.ngsim_tables import (
    PAIRS_FILE,
    SCENES_FILE,
    VEHICLES_FILE,
    load_i80_pairs,
    load_us101_trajectories,
    load_us101_vehicles,
)
from training.data.trajectories import COLUMNS, NOBODY, find_leaders, read_trajectories, tabulate, write_trajectories

DATA = Path(__file__).parents[4] / "shared" / "data"
needs_data = pytest.mark.skipif(
    not all((DATA / name).is_file() for name in (SCENES_FILE, VEHICLES_FILE, PAIRS_FILE)),
    reason=f"recorded traffic is not part of the repository: {DATA} is absent",
)
ROAD = 400.0


@pytest.fixture(scope="module")
def traffic():
    return simulate(0, lanes=3, per_lane=8, seconds=14.0)


@pytest.fixture(scope="module")
def ngsim(traffic, tmp_path_factory):
    path = tmp_path_factory.mktemp("ngsim") / "trajectories-us101.csv"
    return path, write_ngsim(path, traffic, ROAD)


@pytest.fixture(scope="module")
def highd(traffic, tmp_path_factory):
    folder = tmp_path_factory.mktemp("highd")
    lower = simulate(1, lanes=2, per_lane=6, seconds=10.0)
    return folder, write_highd(folder, traffic, lower, road=ROAD), lower


def expected(traffic, table, steps, first=0):
    """Simulated values at the rows of a table, by name."""
    k, i = steps, table.vehicle - first
    names = ("x", "y", "speed", "acceleration")
    values = {name: getattr(traffic, name)[k, i] for name in names}
    return values | {"length": traffic.length[i], "width": traffic.width[i], "lane": traffic.lane[k, i] + 1}


def check_values(table, values, x_offset=0.0, atol=2e-3):
    for name in ("x", "y", "length", "width", "speed"):
        offset = x_offset if name == "x" else 0.0
        np.testing.assert_allclose(table.column(name), values[name] + offset, atol=atol, err_msg=name)


def test_ngsim_becomes_si_units_and_centres(traffic, ngsim):
    table = load_ngsim(ngsim[0])
    assert len(table) == len(ngsim[1])
    values = expected(traffic, table, 5 * (table.frame - 11_188_469_800), first=1)
    check_values(table, values)
    np.testing.assert_allclose(table.acceleration, values["acceleration"], atol=1e-3)
    assert (table.lane == values["lane"]).all()
    assert set(table.recording) == {"trajectories-us101"}
    np.testing.assert_allclose(table.edges["trajectories-us101"], LANE * np.arange(4), atol=0.02)
    np.testing.assert_allclose(table.time[0], 0.1 * table.frame[0])
    # leaders in the file are the nearest ahead, by centres
    row = find_leaders(table.frame, table.lane, table.x)
    assert (table.leader == np.where(row >= 0, table.vehicle[row], NOBODY)).all()
    assert (table.find_rows(table.leader) == row).all()


def test_columns_in_another_order_and_spelling_and_the_text_form_are_the_same(ngsim, tmp_path):
    path, rows = ngsim
    table = load_ngsim(path)
    other = tmp_path / path.name
    spelling = {"v_Length": "v_length", "Space_Headway": "Space_Hdwy", "Time_Headway": "Time_Hdwy"}
    write_csv(other, [{"O_Zone": "", **{spelling.get(k, k): row[k] for k in reversed(row)}} for row in rows])
    plain = tmp_path / "text" / "trajectories-us101.txt"
    plain.parent.mkdir()
    plain.write_text("\n".join("  ".join(str(value) for value in row.values()) for row in rows), encoding="utf-8")
    for loaded in (load_ngsim(other), load_ngsim(plain)):
        for name in COLUMNS:
            assert (loaded.column(name) == table.column(name)).all()


def test_locations_are_chosen_and_numbers_given_again_are_told_apart(ngsim, tmp_path):
    rows = [row for row in ngsim[1] if row["Vehicle_ID"] <= 3 and row["Frame_ID"] < 40]
    later = [{**row, "Global_Time": row["Global_Time"] + 900_000} for row in rows]
    elsewhere = [{**row, "Vehicle_ID": 77} for row in rows if row["Vehicle_ID"] == 1]
    path = tmp_path / "all.csv"
    write_csv(
        path,
        [{**row, "Location": "us-101"} for row in rows + later] + [{**row, "Location": "i-80"} for row in elsewhere],
    )
    with pytest.raises(ValueError, match=r"locations i-80, us-101; choose one"):
        load_ngsim(path)
    with pytest.raises(ValueError, match="not peachtree"):
        load_ngsim(path, location="peachtree")
    table = load_ngsim(path, location="us-101")
    assert set(table.recording) == {"us-101"}
    numbers = sorted({row["Vehicle_ID"] for row in rows})
    assert sorted(set(table.vehicle)) == [*numbers, *(n + 1_000_000 for n in numbers)]
    second = table.vehicle > 1_000_000
    assert (table.leader[second & (table.leader >= 0)] > 1_000_000).all()
    assert (table.leader[~second] < 1_000_000).all()


def change(rows, index, **values):
    return [{**row, **values} if i == index else row for i, row in enumerate(rows)]


BROKEN = {
    "a column is missing": (lambda rows: [{k: v for k, v in r.items() if k != "v_Vel"} for r in rows], "v_Vel"),
    "a row is given twice": (lambda rows: [*rows, rows[4]], r"line 42: vehicle 1 at frame .* first in line 6"),
    "a frame is missing": (lambda rows: rows[:20] + rows[23:], r"line 22: vehicle 1 was missing for 3 frames"),
    "a word": (lambda rows: change(rows, 7, v_Vel="fast"), r"line 9: v_Vel is 'fast', a number was expected"),
    "nothing in a field": (lambda rows: change(rows, 7, Local_X=""), "line 9: Local_X is empty"),
    "km/h in one row": (lambda rows: change(rows, 7, v_Vel=400.0), r"line 9: speed is 121.9 m/s"),
    "backwards": (lambda rows: change(rows, 7, v_Vel=-3.0), r"line 9: speed is -0.9144 m/s"),
    "metres": (
        lambda rows: [{**r, **{k: r[k] * FOOT for k in ("Local_X", "Local_Y", "v_Length", "v_Vel")}} for r in rows],
        r"line 2: the median length of vehicles is 1\.\d+ m, .* in feet",
    ),
    "km/h for ft/s": (
        lambda rows: [{**r, "v_Vel": r["v_Vel"] * 1.09728 * 2.0} for r in rows],
        r"line \d+: positions move 0\.45\d times as fast",
    ),
    "a jump": (lambda rows: change(rows, 7, Local_Y=rows[7]["Local_Y"] + 100.0), r"line 9: vehicle 1 moved 3\d\.\d+ m"),
    "no length": (lambda rows: change(rows, 7, v_Length=0.0), r"line 9: length of the vehicle is 0 m"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_ngsim_files_are_refused_with_file_and_line(name, ngsim, tmp_path):
    rows = [{**row, "Vehicle_ID": 1} for row in ngsim[1] if row["Vehicle_ID"] == ngsim[1][0]["Vehicle_ID"]][:40]
    spoil, message = BROKEN[name]
    path = tmp_path / "broken.csv"
    write_csv(path, spoil(rows))
    with pytest.raises(ValueError, match=message) as caught:
        load_ngsim(path)
    assert "broken.csv" in str(caught.value)


def test_gaps_are_cut_on_request(ngsim, tmp_path):
    path = tmp_path / "gap.csv"
    write_csv(path, ngsim[1][:10] + ngsim[1][13:30])
    table = load_ngsim(path, gaps="cut")
    assert table.track_starts().tolist() == [0, 10]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty"),
        ("Vehicle_ID,Global_Time,Local_X,Local_Y,v_Length,v_Width,v_Vel,v_Acc,Lane_ID,Preceding\n", "no rows"),
        ("1 2 3\n4 5 6\n", "no header and 3 columns"),
        ("1 2 3\n4 x 6\n", "Cannot read"),
        ("Vehicle_ID,Global_Time\n1,2\n1,2,3\n", "lacks the columns Local_X"),
    ],
)
def test_files_without_trajectories_are_refused(text, message, tmp_path):
    path = tmp_path / "odd.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ValueError, match=message):
        load_ngsim(path)
    with pytest.raises(ValueError, match=r"none\.csv"):
        load_ngsim(tmp_path / "none.csv")


def test_highd_turns_both_directions_into_the_road_frame(traffic, highd):
    folder, rows, lower = highd
    assert highd_recordings(folder) == ("01",)
    table = load_highd(folder, "01")
    assert set(table.recording) == {"01-upper", "01-lower"}
    for side, simulated, first in (("upper", traffic, 1), ("lower", lower, 25)):
        part = table.select(table.recording == f"01-{side}")
        # time 0.04 s is the first frame, which was simulated at 0 s
        at = 5 * part.frame - 2
        values = expected(simulated, part, at, first)
        # the upper lanes are turned about the origin, so x ends where the picture begins
        i = part.vehicle - first
        across = (simulated.y[np.minimum(at + 1, len(simulated.y) - 1), i] - simulated.y[at, i]) / DT
        values["speed"] = np.hypot(values["speed"], across)
        values["y"] = values["y"] + part.edges[f"01-{side}"][0]
        # between frames speeds are interpolated, and they bend where the leader changes
        check_values(part, values, x_offset=-ROAD if side == "upper" else 0.0, atol=0.02)
        np.testing.assert_allclose(np.diff(part.edges[f"01-{side}"]), LANE)
        assert (part.lane == values["lane"]).mean() > 0.999
        assert (part.leader == NOBODY).any()
        known = part.find_rows(part.leader) >= 0
        assert (part.x[part.find_rows(part.leader)[known]] > part.x[known]).all()
    assert (np.abs(np.diff(table.frame[table.vehicle == table.vehicle[0]])) == 1).all()
    assert len(table) < len(rows) / 2.4


def spoiled(folder, rows, tmp_path, file="tracks", **texts):
    for path in folder.iterdir():
        (tmp_path / path.name).write_text(path.read_text(encoding="utf-8"), encoding="utf-8")
    if file == "tracks":
        write_csv(tmp_path / "01_tracks.csv", rows)
    else:
        path = tmp_path / f"01_{file}.csv"
        text = path.read_text(encoding="utf-8")
        for old, new in texts.items():
            text = text.replace(old, new)
        path.write_text(text, encoding="utf-8")
    return tmp_path


def test_broken_highd_folders_are_refused(highd, tmp_path):
    folder, rows, _ = highd
    km_h = [{**row, "xVelocity": 3.6 * row["xVelocity"]} for row in rows]
    around = [{**row, "xVelocity": -row["xVelocity"]} for row in rows]
    for broken, message in (
        (rows[:30] + rows[33:], r"01_tracks\.csv, line 32: vehicle \d+ was missing for 3 frames"),
        ([*rows, rows[0]], r"01_tracks\.csv, line \d+: vehicle \d+ at frame \d+ is given twice, first in line 2"),
        (km_h, r"01_tracks\.csv, line \d+: "),
        (around, "against its drivingDirection"),
        (change(rows, 0, id=999), "line 2: vehicle 999 is not in the file of tracksMeta"),
        ([{k: v for k, v in row.items() if k != "precedingId"} for row in rows], "lacks the columns precedingId"),
    ):
        with pytest.raises(ValueError, match=message):
            load_highd(spoiled(folder, broken, tmp_path), "01")
    for file, texts, message in (
        ("recordingMeta", {"1,25,": "1,5,"}, r"01_recordingMeta\.csv, line 2: frameRate is 5"),
        ("recordingMeta", {"11.75;": "banana;"}, "separated by semicolons"),
        ("tracksMeta", {"Car,1": "Car,3"}, r"01_tracksMeta\.csv, line 2: drivingDirection is 3"),
    ):
        with pytest.raises(ValueError, match=message):
            load_highd(spoiled(folder, rows, tmp_path, file, **texts), "01")
    with pytest.raises(ValueError, match="is it the data folder of highD"):
        highd_recordings(tmp_path / "none")


def test_tables_survive_a_file(ngsim, tmp_path):
    table = load_ngsim(ngsim[0])
    write_trajectories(table, tmp_path / "table.parquet")
    again = read_trajectories(tmp_path / "table.parquet")
    assert again.edges == table.edges
    for name in COLUMNS:
        assert (again.column(name) == table.column(name)).all()
    with pytest.raises(ValueError, match="Cannot read trajectories from"):
        read_trajectories(tmp_path / "none.parquet")


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
        ({"x": [0.0, np.nan, 9.0]}, "Row 1: x is nan"),
        ({"speed": [1.0, 1.0, -1.0]}, "Row 2: speed is -1"),
        ({"length": 0.0}, "Row 0: length is 0"),
        ({name: [] for name in COLUMNS}, "at least one row"),
    ):
        with pytest.raises(ValueError, match=message):
            tabulate({**GOOD, **changes})
    with pytest.raises(ValueError, match="must increase"):
        tabulate(GOOD, {"r": (0.0, 3.5, 3.5)})


def test_lane_boundaries_lie_halfway_and_ramps_do_not_count():
    y = np.array([1.8, 5.4, 9.1, 12.0, 12.1])
    np.testing.assert_allclose(estimate_lane_edges(y, np.arange(1, 6)), (0.0, 3.6, 7.25, 10.55, 13.45), atol=1e-12)
    assert estimate_lane_edges(y[:1], np.array([1])) == ()
    assert estimate_lane_edges(y[1:3], np.array([2, 3])) == ()


@needs_data
def test_compact_tables_load():
    scenes, vehicles, pairs = load_us101_trajectories(DATA), load_us101_vehicles(DATA), load_i80_pairs(DATA)
    assert [len(scenes), len(vehicles), len(pairs)] == [54_336, 214_267, 110_905]
    assert len(load_us101_trajectories(DATA, merged=False)) == 65_686
    assert len(set(vehicles.vehicle)) == 370
    assert np.isnan(vehicles.length).all()
    following = pairs.leader != NOBODY
    assert following.sum() == 68_339
    assert (pairs.find_rows(pairs.leader)[following] >= 0).all()


def test_a_missing_compact_table_is_named(tmp_path):
    with pytest.raises(ValueError, match=PAIRS_FILE):
        load_i80_pairs(tmp_path)
