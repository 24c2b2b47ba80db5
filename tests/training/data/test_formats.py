"""Files of the five formats, there and back: values in the frame of the road, and what is refused, with its line."""

import gzip
import json

import numpy as np
import pytest
from scipy.io import savemat

from tests.training.data.recordings import (
    CLOCK,
    DT,
    FOOT,
    LANE,
    ROAD,
    WEST_END,
    coifman_matrix,
    i24_documents,
    simulate,
    tgsim_rows,
    write_coifman,
    write_csv,
    write_i24,
)
from training.data import columns
from training.data.events import ASSUMED_START, cut_in_events
from training.data.formats import (
    I24_EDGES,
    RECORDING_KINDS,
    find_tgsim_files,
    highd_recordings,
    load_coifman_li,
    load_highd,
    load_i24_motion,
    load_ngsim,
    load_recordings,
    load_tgsim,
)
from training.data.road_axis import lanes_of
from training.data.scenes import scenes_of
from training.data.table import COLUMNS, NOBODY, find_leaders

ARRAYS = ("timestamp", "x_position", "y_position")
TURNED = {"radius": 900.0, "angle": 2.6, "shift": (400.0, 60.0)}


@pytest.fixture(scope="module")
def matrix(traffic):
    return coifman_matrix(traffic)


@pytest.fixture(scope="module")
def documents(traffic):
    return i24_documents(traffic)


@pytest.fixture(scope="module")
def tgsim(traffic):
    return tgsim_rows(traffic)


def truth(traffic, table, step, first=0):
    """Simulated values at the rows of a table, by name."""
    at = np.rint(step).astype(int), table.vehicle - first
    values = {name: getattr(traffic, name)[at] for name in ("x", "y", "speed", "acceleration", "lane")}
    return values | {"length": traffic.length[at[1]], "width": traffic.width[at[1]]}


def check(table, values, atol, names=("x", "y", "speed", "acceleration", "length", "width"), lane=1):
    """The table has these values, lanes from the left, and the nearest ahead as leaders."""
    for name in names:
        np.testing.assert_allclose(getattr(table, name), values[name], atol=atol, err_msg=name)
    assert (table.lane == lane + values["lane"]).all()
    assert (table.leader == find_leaders(table.vehicle, table.frame, table.lane, values["x"], table.recording)).all()


def same(one, other, names=COLUMNS):
    return all((getattr(one, name) == getattr(other, name)).all() for name in names)


def test_ngsim(traffic, ngsim, tmp_path):
    """Also in another order and spelling of its columns, and as text without a header."""
    path, rows = ngsim
    table = load_ngsim(path)
    assert len(table) == len(rows) and set(table.recording) == {path.stem}
    check(table, truth(traffic, table, 5 * (table.frame - 11_188_469_800), first=1), 2e-3)
    np.testing.assert_allclose(table.edges[path.stem], LANE * np.arange(4), atol=0.02)
    other, plain = tmp_path / path.name, tmp_path / f"{path.stem}.txt"
    write_csv(other, [{"O_Zone": "", **{k.replace("v_Len", "v_len"): row[k] for k in reversed(row)}} for row in rows])
    plain.write_text("\n".join("  ".join(str(value) for value in row.values()) for row in rows), encoding="utf-8")
    assert same(load_ngsim(other), table) and same(load_ngsim(plain), table)


def test_ngsim_as_other_programs_save_it_is_the_same_table(ngsim, tmp_path):
    """With an index of pandas or blank lines at the end, gzipped, or by a spreadsheet; rounded times are refused."""
    path, rows = tmp_path / "road.csv", [row for row in ngsim[1] if row["Vehicle_ID"] <= 2][:60]
    text = write_csv(path, rows).read_text(encoding="utf-8")
    first, *others = text.splitlines()
    indexed = "\n".join([f",{first}", *(f"{k},{row}" for k, row in enumerate(others))])
    table = load_ngsim(path)
    for content in (
        indexed.encode(),
        f"{text}\n \n".encode(),
        f"{text}{',' * first.count(',')}\n,,\n".encode(),
        gzip.compress(indexed.encode()),
        b"\xef\xbb\xbf" + text.replace(",", ";").encode(),
        text.replace(",", "\t").encode(),
        "\n".join(others).replace(",0.0,", ",0E+00,").encode(),
        gzip.compress("\n".join([*others, "", ""]).encode()),
    ):
        path.write_bytes(content)
        assert same(load_ngsim(path), table), content[:200]
    write_csv(path, [{**row, "Global_Time": 1.1e12} for row in rows])
    with pytest.raises(ValueError, match=r"road\.csv, line 2: Global_Time is 1\.1e\+12 .*a spreadsheet has rounded it"):
        load_ngsim(path)
    for content in (
        gzip.compress(text.encode())[:-20],
        gzip.compress(text.encode() + bytes(2**21).replace(b"\0", b"\n")),
    ):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=r"Cannot read|unpacks to more than 100 times"):
            load_ngsim(path)


def test_locations_are_chosen_and_numbers_given_again_are_told_apart(ngsim, tmp_path):
    rows = [row for row in ngsim[1] if row["Vehicle_ID"] <= 3 and row["Frame_ID"] < 40]
    later = [{**row, "Global_Time": row["Global_Time"] + 900_000} for row in rows]
    elsewhere = [{**row, "Vehicle_ID": 77} for row in rows if row["Vehicle_ID"] == 1]
    placed = [{**row, "Location": "us-101"} for row in rows + later] + [{**r, "Location": "i-80"} for r in elsewhere]
    path = write_csv(tmp_path / "all.csv", placed)
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


def test_coifman_and_li(traffic, matrix, tmp_path):
    """Rear bumpers and an assumed length; text is the same."""
    path = write_coifman(tmp_path / "i80.mat", matrix)
    table = load_coifman_li(path, length=4.5)
    values = truth(traffic, table, 5 * (table.frame - 1), first=1)
    values["x"] = values["x"] - 0.5 * values["length"] + 2.25
    check(table, values, 1e-6, names=("x", "speed", "acceleration"))
    assert not table.edges and np.isnan(table.y).all() and np.isnan(table.width).all()
    assert same(load_coifman_li(write_coifman(tmp_path / "i80.txt", matrix), length=4.5), table, ("frame", "leader"))
    cuts = cut_in_events(table)
    start, crossing = (cuts["phase"] == phase for phase in ("start", "crossing"))
    early = cuts["frame"][crossing] - cuts["frame"][start]
    assert (early <= ASSUMED_START).all() and (early == ASSUMED_START).any()
    assert not cuts["start_seen"].any() and np.isnan(cuts["lateral_offset"]).all()


def test_highd_turns_both_directions_into_the_road_frame(traffic, highd):
    folder, rows, lower = highd
    table = load_highd(folder, "01")
    assert set(table.recording) == {"01-upper", "01-lower"} and len(table) < len(rows) / 2.4
    for side, simulated, first in (("upper", traffic, 1), ("lower", lower, 25)):
        part = table.select(table.recording == f"01-{side}")
        at, i = 5 * part.frame - 2, part.vehicle - first  # time 0.04 s is the first frame, which was simulated at 0 s
        values = truth(simulated, part, at, first)
        # the upper lanes are turned about the origin, so x ends where the picture begins
        values["x"] = values["x"] - (ROAD if side == "upper" else 0.0)
        values["y"] = values["y"] + part.edges[f"01-{side}"][0]
        across = (simulated.y[np.minimum(at + 1, len(simulated.y) - 1), i] - simulated.y[at, i]) / DT
        odd = at % 2  # between frames of 0.04 s speeds are interpolated
        values["speed"] = np.hypot(0.5 * (simulated.speed[at - odd, i] + simulated.speed[at + odd, i]), across)
        for name in ("x", "y", "speed", "length", "width"):
            np.testing.assert_allclose(getattr(part, name), values[name], atol=0.02, err_msg=name)
        np.testing.assert_allclose(np.diff(part.edges[f"01-{side}"]), LANE)
        assert (part.lane == 1 + values["lane"]).mean() > 0.999
        known = part.find_rows(part.leader) >= 0
        assert (part.x[part.find_rows(part.leader)[known]] > part.x[known]).all() and not known.all()


@pytest.mark.parametrize(
    ("place", "side"), [({}, "right"), ({"angle": -1.4}, "up"), (TURNED, "left"), ({**TURNED, "angle": 2.0}, "down")]
)
def test_tgsim_is_found_in_the_frame_of_the_road(place, side, traffic, tmp_path):
    place = {**place, "radius": -900.0} if side == "down" else place
    table = load_tgsim(write_csv(tmp_path / "I294.csv", tgsim_rows(traffic, lanes=(11, 12, 13), **place)))
    name = f"I294-1-{side}"
    assert set(table.recording) == {name}
    values = truth(traffic, table, table.time / DT)
    check(table, values, 1e-4, names=("speed", "acceleration", "length", "width"))
    offset = np.median(table.y - values["y"])
    np.testing.assert_allclose(table.y - offset, values["y"], atol=0.15)
    scale = 1.0 + offset / place.get("radius", np.inf)
    np.testing.assert_allclose(table.x - table.x.mean(), scale * (values["x"] - values["x"].mean()), atol=0.25)
    np.testing.assert_allclose(np.diff(table.edges[name]), LANE, atol=0.25)
    assert len(scenes_of(table, seconds=5.0)) >= 2


def test_runs_and_directions_of_tgsim_are_recordings_of_their_own(traffic, tgsim, tmp_path):
    """Numbers of vehicles come again in the next run; lanes of the other sign are the other direction, or shoulders."""
    other = simulate(1, lanes=2, per_lane=6, seconds=10.0)
    back = tgsim_rows(other, lanes=(-2, -1), first=500, angle=np.pi, shift=(400.0, -6.0))
    table = load_tgsim(write_csv(tmp_path / "I294.csv", [*tgsim, *back, *tgsim_rows(other, run=2)]))
    assert np.unique(table.recording).tolist() == ["I294-1-left", "I294-1-right", "I294-2-right"]
    left = table.select(table.recording == "I294-1-left")
    values, fresh = truth(other, left, left.time / DT, 500), np.diff(left.vehicle) != 0
    assert (left.lane == 1 + values["lane"]).all()
    np.testing.assert_allclose(np.diff(left.x)[~fresh], np.diff(values["x"])[~fresh], atol=2e-3)
    shoulder = [{**row, "lane_kf": -1 if row["lane_kf"] == 3 else row["lane_kf"]} for row in tgsim]
    table = load_tgsim(write_csv(tmp_path / "I395.csv", shoulder))
    assert ((table.lane == 0) == (truth(traffic, table, table.time / DT)["lane"] == 2)).all()
    assert (table.leader[table.lane == 0] == NOBODY).all()


def test_hyphens_no_runs_and_a_clock_between_ticks(tgsim, tmp_path):
    """Headers of earlier downloads, and I-395's file, which has no column of runs."""
    table = load_tgsim(write_csv(tmp_path / "I395.csv", tgsim))
    old = [{k.replace("_", "-").replace("id", "ID"): v for k, v in row.items() if k != "run_index"} for row in tgsim]
    (tmp_path / "old").mkdir()
    late = [{**row, "time": round(row["time"] + 0.04, 2)} for row in old]
    assert same(load_tgsim(write_csv(tmp_path / "old" / "I395.csv", late)), table)


def test_holes_and_empty_fields_are_cut_on_request(tgsim, tmp_path):
    """A frame without a position is a frame that the camera lost."""
    path = write_csv(tmp_path / "holes.csv", change(change(tgsim, 7, yloc_kf=""), 30, lane_kf=""))
    table = load_tgsim(path, gaps="cut")
    assert len(table) == len(tgsim) - 2
    assert len(table.track_starts()) == len({row["id"] for row in tgsim}) + 2
    write_csv(path, [{**row, "yloc_kf": ""} for row in tgsim])
    with pytest.raises(ValueError, match="no row in which every number is given"):
        load_tgsim(path, gaps="cut")


@pytest.mark.parametrize(("direction", "name"), [(-1, "morning-west"), (1, "morning-east")])
def test_both_carriageways_of_i24_become_the_road_frame(direction, name, traffic, tmp_path):
    table = load_i24_motion(write_i24(tmp_path / "morning.json", i24_documents(traffic, direction)))
    assert set(table.recording) == {name} == set(table.edges)
    seen = np.flatnonzero(traffic.inside(ROAD)[::2].any(axis=0))
    at = np.rint((table.time - CLOCK) / DT).astype(int), seen[table.vehicle - 1]
    np.testing.assert_allclose(table.x - direction * WEST_END * FOOT, traffic.x[at], atol=2e-3)
    np.testing.assert_allclose(table.y, traffic.y[at] + 12.0 * FOOT, atol=2e-3)
    np.testing.assert_allclose(table.length, traffic.length[at[1]], atol=1e-9)
    # slopes over 0.08 s, one-sided at the ends of a track, of a speed that changes by 6 m/s^2 at most
    np.testing.assert_allclose(table.speed, traffic.speed[at], atol=0.15)
    assert np.isnan(table.acceleration).all()
    assert (table.lane == lanes_of(traffic.y[at] + 12.0 * FOOT, I24_EDGES)).all() and table.lane.min() == 1
    assert (table.leader == find_leaders(table.vehicle, table.frame, table.lane, table.x)).all()


def test_carriageways_do_not_follow_each_other(documents, tmp_path):
    both = documents + i24_documents(simulate(1, lanes=2, per_lane=6, seconds=10.0), 1, mark="e")
    table = load_i24_motion(write_i24(tmp_path / "m.json", both, indent=1))
    assert set(table.edges) == {"m-west", "m-east"}
    alone = load_i24_motion(write_i24(tmp_path / "m.json", documents))
    assert same(table.select(table.recording == "m-west"), alone, ("vehicle", "frame", "x", "leader"))


def test_a_part_of_the_time_is_read_and_documents_longer_than_what_is_read_at_a_time(documents, tmp_path, monkeypatch):
    path = write_i24(tmp_path / "morning.json", documents, indent=2)
    whole, part = load_i24_motion(path), load_i24_motion(path, between=(CLOCK + 4.0, CLOCK + 8.0))
    assert (part.time.min(), part.time.max()) == pytest.approx((CLOCK + 4.0, CLOCK + 8.0))
    inside = whole.select((whole.time > CLOCK + 3.99) & (whole.time < CLOCK + 8.01))
    assert (part.vehicle == inside.vehicle).all()
    np.testing.assert_allclose(part.x, inside.x, atol=2e-3)
    monkeypatch.setattr(columns, "CHUNK", 977)
    assert same(load_i24_motion(path), whole, ("x", "leader"))


def test_each_kind_is_read_by_its_loader(ngsim, highd, tgsim, documents, matrix, tmp_path):
    (tmp_path / "geometry.csv").write_text("x1,y1\n1,2\n", encoding="utf-8")
    paths = {
        "ngsim": (ngsim[0], {"trajectories-us101"}),
        "highd": (highd[0], {"01-lower", "01-upper"}),
        "tgsim": (write_csv(tmp_path / "I294.csv", tgsim).parent, {"I294-1-right"}),
        "i24": (write_i24(tmp_path / "morning.json", documents), {"morning-west"}),
        "coifman": (write_coifman(tmp_path / "i80.mat", matrix), {"i80"}),
    }
    assert set(paths) == set(RECORDING_KINDS)
    for kind, (path, names) in paths.items():
        assert {name for table in load_recordings(kind, path) for name in table.recording} == names
    with pytest.raises(ValueError, match="Expected one of ngsim, highd, tgsim, i24, coifman, got 'waymo'"):
        next(load_recordings("waymo", "data"))


def change(rows, index, **values):
    return [{**row, **values} if i == index else row for i, row in enumerate(rows)]


def scale(rows, factor, *names):
    return [{**row, **{name: row[name] * factor for name in names}} for row in rows]


def without(row, name):
    return {key: value for key, value in row.items() if key != name}


def changed(matrix, row, column, value):
    copy = matrix.copy()
    copy[row, column] = value
    return copy


REFUSED = {
    "ngsim": (
        (lambda rows: [without(r, "v_Vel") for r in rows], "lacks the columns v_Vel"),
        (lambda rows: [*rows, rows[4]], r"line 42: vehicle 1 at frame .* first in line 6"),
        (lambda rows: rows[:20] + rows[23:], r"line 22: vehicle 1 was missing for 3 frames"),
        (lambda rows: change(rows, 7, v_Vel="fast"), r"line 9: v_Vel is 'fast', a number was expected"),
        (lambda rows: change(rows, 7, Local_X=""), "line 9: Local_X is empty"),
        (lambda rows: change(rows, 7, v_Vel=400.0), r"line 9: speed is 121.9 m/s"),
        (lambda rows: change(rows, 7, v_Vel=-3.0), r"line 9: speed is -0.9144 m/s"),
        (lambda rows: scale(rows, FOOT, "Local_X", "Local_Y", "v_Length", "v_Vel"), r"line 2: .* is 1\.\d+ m, .* feet"),
        (lambda rows: scale(rows, 2.2, "v_Vel"), r"line \d+: positions move 0\.45\d* times as fast"),
        (lambda rows: change(rows, 7, Local_Y=rows[7]["Local_Y"] + 100.0), r"line 9: vehicle 1 moved 3\d\.\d+ m"),
        (lambda rows: change(rows, 7, v_Length=0.0), r"line 9: length of the vehicle is 0 m"),
    ),
    "coifman": (
        (lambda m: m[:, :17], "17 columns; expected the 18 of NGSIM"),
        (lambda m: m[:0], "has no rows"),
        (lambda m: changed(m, 6, 5, np.nan), "line 7: Local_Y is nan, a number was expected"),
        (lambda m: changed(m, slice(None), 8, 15.0), "values in v_Length, .* file of NGSIM's own"),
    ),
    "highd": (
        (lambda rows: scale(rows, 3.6, "xVelocity"), r"broken_tracks\.csv, line \d+: "),
        (lambda rows: scale(rows, -1.0, "xVelocity"), "against its drivingDirection"),
        (lambda rows: change(rows, 0, id=999), "line 2: vehicle 999 is not in the file of tracksMeta"),
    ),
    "tgsim": (
        (lambda rows: [{**x, "speed_kf_x": 1.0, "speed_kf_y": 0.0} for x in rows], "is of streets"),
        (lambda rows: scale(rows, 10.0, "length_smoothed"), "median length .* in metres"),
        (lambda rows: scale(rows, 0.4, "time"), "times are 0.04 s apart, expected 0.1 s"),
    ),
    "i24": (
        (lambda d: [d[0], without(d[1], "y_position")], r"document 2 lacks y_position; it has _id,"),
        (lambda d: [d[0], d[1], d[0]], "document 3: _id .*6387.* was given before"),
        (lambda d: change(d, 1, x_position=d[1]["x_position"][1:]), r"document 2: expected arrays of one length"),
        (lambda d: change(d, 1, length="long"), "document 2: expected numbers in length"),
        (lambda d: change(d, 1, direction=0), "document 2: direction is 0, expected 1 or -1"),
        (lambda d: change(d, 1, direction=1), "document 2: the vehicle moves against its direction, 1"),
        (lambda d: scale(d, FOOT, "length", "width"), r"median length of vehicles is 1\.\d+ m, .* in feet"),
        (lambda d: [{**x, **{n: x[n][::3] for n in ARRAYS}} for x in d], "times are 0.12 s apart, expected 0.04 s"),
    ),
}


@pytest.mark.parametrize(
    ("kind", "number"), [(kind, number) for kind, cases in REFUSED.items() for number in range(len(cases))]
)
def test_broken_files_are_refused_in_one_line_with_file_and_place(
    kind, number, ngsim, highd, tgsim, documents, matrix, tmp_path
):
    good = {"highd": highd[1], "tgsim": tgsim, "i24": documents, "coifman": matrix}
    first = ngsim[1][0]["Vehicle_ID"]
    good["ngsim"] = [{**row, "Vehicle_ID": 1} for row in ngsim[1] if row["Vehicle_ID"] == first][:40]
    writers = {"i24": write_i24, "coifman": write_coifman}
    loaders = {"ngsim": load_ngsim, "coifman": load_coifman_li, "tgsim": load_tgsim, "i24": load_i24_motion}
    spoil, message = REFUSED[kind][number]
    path = tmp_path / {"i24": "broken.json", "coifman": "broken.mat", "highd": "broken_tracks.csv"}.get(
        kind, "broken.csv"
    )
    writers.get(kind, write_csv)(path, spoil(good[kind]))
    for meta in highd[0].iterdir() if kind == "highd" else ():
        if "Meta" in meta.name:
            (tmp_path / meta.name.replace("01", "broken")).write_text(meta.read_text(encoding="utf-8"))
    with pytest.raises(ValueError, match=message) as caught:
        load_highd(tmp_path, "broken") if kind == "highd" else loaders[kind](path)
    assert "broken" in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        ("recordingMeta", "1,25,", "1,5,", r"01_recordingMeta\.csv, line 2: frameRate is 5"),
        ("recordingMeta", "11.75;", "banana;", "separated by semicolons"),
        ("tracksMeta", "Car,1", "Car,3", r"01_tracksMeta\.csv, line 2: drivingDirection is 3"),
    ],
)
def test_broken_files_beside_the_tracks_are_refused(file, old, new, message, highd, tmp_path):
    for path in highd[0].iterdir():
        text = path.read_text(encoding="utf-8")
        (tmp_path / path.name).write_text(text.replace(old, new) if file in path.name else text, encoding="utf-8")
    with pytest.raises(ValueError, match=message):
        load_highd(tmp_path, "01")


@pytest.mark.parametrize(
    ("load", "content", "message"),
    [
        (load_ngsim, b"", "is empty"),
        (
            load_ngsim,
            b"Vehicle_ID,Global_Time,Local_X,Local_Y,v_Length,v_Width,v_Vel,v_Acc,Lane_ID,Preceding\n",
            "no rows",
        ),
        (load_ngsim, b"1 2 3\n4 5 6\n", "no header and 3 columns"),
        (load_ngsim, b"1 2 3\n4 x 6\n", "Cannot read"),
        (load_coifman_li, b"not a matrix" * 40, "Cannot read"),
        (load_i24_motion, b"id,time\n1,2\n", "is no JSON array"),
        (load_i24_motion, b"[]", "has no documents"),
        (load_i24_motion, b"[1, 2]", "no array of JSON objects"),
        (load_i24_motion, b'[{"_id": "a", "timestamp": [1.0, 2', "ends within the array"),
        (load_i24_motion, b"[\xff\xfe", "Cannot read"),
    ],
)
def test_other_files_are_refused(load, content, message, tmp_path):
    path = tmp_path / ("odd.mat" if load is load_coifman_li else "odd")
    path.write_bytes(content)
    with pytest.raises(ValueError, match=message) as caught:
        load(path)
    assert "odd" in str(caught.value)
    with pytest.raises(ValueError, match=r"Cannot read .*none"):
        load(tmp_path / "none.mat")


def test_truncated_files_and_other_matrices_are_refused(documents, matrix, tmp_path):
    text, path, other = json.dumps(documents), tmp_path / "cut.json", tmp_path / "other.mat"
    for end in (len(text) // 2, len(text) - 1):
        path.write_text(text[:end], encoding="utf-8")
        with pytest.raises(ValueError, match=r"cut\.json ends within the array|Cannot read .*cut\.json"):
            load_i24_motion(path)
    whole = write_coifman(other, matrix).read_bytes()
    other.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match="Cannot read"):
        load_coifman_li(other)
    for content in ({"matrix": matrix}, {"data": "words"}):
        savemat(other, content)
        with pytest.raises(ValueError, match="has no matrix of numbers 'data'"):
            load_coifman_li(other)


def test_folders_without_recordings_are_refused(tmp_path):
    with pytest.raises(ValueError, match="is it the data folder of highD"):
        highd_recordings(tmp_path)
    (tmp_path / "empty.csv").write_text("", encoding="utf-8")
    with pytest.raises(ValueError, match="has no CSV file with a column xloc_kf"):
        find_tgsim_files(tmp_path)
