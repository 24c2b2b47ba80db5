"""Files of NGSIM, and of Coifman and Li in their form, there and back: values, lanes, leaders, and what is refused."""

import numpy as np
import pytest
from scipy.io import savemat

from tests.training.data.published_files import coifman_matrix, write_coifman
from tests.training.data.recordings import FOOT, LANE, change, check_values, expected, write_csv
from training.data.events import ASSUMED_START, bumper_gaps, cut_in_events
from training.data.formats import MEAN_LENGTH, load_coifman_li, load_ngsim
from training.data.table import COLUMNS, NOBODY, find_leaders

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


@pytest.fixture(scope="module")
def matrix(traffic):
    return coifman_matrix(traffic)


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


@pytest.mark.parametrize("name", BROKEN)
def test_broken_ngsim_files_are_refused_with_file_and_line(name, ngsim, tmp_path):
    rows = [{**row, "Vehicle_ID": 1} for row in ngsim[1] if row["Vehicle_ID"] == ngsim[1][0]["Vehicle_ID"]][:40]
    spoil, message = BROKEN[name]
    path = tmp_path / "broken.csv"
    write_csv(path, spoil(rows))
    with pytest.raises(ValueError, match=message) as caught:
        load_ngsim(path)
    assert "broken.csv" in str(caught.value)


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


def test_the_matrix_becomes_si_units_and_centres_of_assumed_length(traffic, matrix, tmp_path):
    table = load_coifman_li(write_coifman(tmp_path / "i80.mat", matrix), length=4.5)
    assert len(table) == len(matrix) and set(table.recording) == {"i80"} and not table.edges
    values = expected(traffic, table, 5 * (table.frame - 1), first=1)
    np.testing.assert_allclose(table.x - 2.25, values["x"] - 0.5 * values["length"], atol=1e-6)
    np.testing.assert_allclose(table.speed, values["speed"], atol=1e-6)
    np.testing.assert_allclose(table.acceleration, values["acceleration"], atol=1e-6)
    assert (table.lane == values["lane"]).all()
    assert np.isnan(table.y).all() and np.isnan(table.width).all()
    row = table.find_rows(table.leader)
    assert (row >= 0).sum() > 500
    assert ((table.leader > 0) == (row >= 0)).all()
    # a gap is the distance of the rear bumpers less the length of the follower
    gap = bumper_gaps(table, np.flatnonzero(row >= 0), row[row >= 0])
    rear = values["x"] - 0.5 * values["length"]
    np.testing.assert_allclose(gap, rear[row[row >= 0]] - rear[row >= 0] - 4.5, atol=1e-6)
    assert load_coifman_li(tmp_path / "i80.mat").length[0] == MEAN_LENGTH
    text = write_coifman(tmp_path / "i80.txt", matrix)
    np.testing.assert_allclose(load_coifman_li(text, length=4.5).x, table.x, atol=1e-5)


def test_lengths_are_taken_from_ngsim_where_the_vehicle_is_there(traffic, matrix, ngsim, tmp_path):
    """The file of NGSIM lacks the last vehicles."""
    some = tmp_path / "ngsim.csv"
    lines = ngsim[0].read_text(encoding="utf-8").splitlines()
    some.write_text("\n".join([lines[0], *(x for x in lines[1:] if int(x.split(",")[0]) <= 6)]), encoding="utf-8")
    table = load_coifman_li(write_coifman(tmp_path / "i80.mat", matrix), ngsim=some)
    known = table.vehicle <= 6
    assert known.any() and not known.all()
    np.testing.assert_allclose(table.length[known], traffic.length[table.vehicle[known] - 1], atol=2e-3)
    assert (table.length[~known] == MEAN_LENGTH).all()
    some.write_text("\n".join([lines[0], *("9" + x for x in lines[1:30])]), encoding="utf-8")
    with pytest.raises(ValueError, match="has none of the vehicles"):
        load_coifman_li(tmp_path / "i80.mat", ngsim=some)


def test_cut_ins_are_found_without_positions_across(matrix, tmp_path):
    cuts = cut_in_events(load_coifman_li(write_coifman(tmp_path / "i80.mat", matrix)))
    start, crossing = (cuts["phase"] == phase for phase in ("start", "crossing"))
    early = cuts["frame"][crossing] - cuts["frame"][start]
    assert (early <= ASSUMED_START).all() and (early == ASSUMED_START).any()
    assert not cuts["start_seen"].any() and np.isnan(cuts["lateral_offset"]).all()


def changed(matrix, row, column, value):
    copy = matrix.copy()
    copy[row, column] = value
    return copy


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda m: m[:, :17], "17 columns; expected the 18 of NGSIM"),
        (lambda m: m[:0], "has no rows"),
        (lambda m: changed(m, 6, 5, np.nan), "line 7: Local_Y is nan, a number was expected"),
        (lambda m: changed(m, slice(None), 8, 15.0), "values in v_Length, .* file of NGSIM's own"),
        (lambda m: np.delete(m, [8, 9], axis=0), "line 9: vehicle 1 was missing for 2 frames"),
    ],
)
def test_broken_matrices_are_refused(spoil, message, matrix, tmp_path):
    with pytest.raises(ValueError, match=message) as caught:
        load_coifman_li(write_coifman(tmp_path / "broken.mat", spoil(matrix)))
    assert "broken" in str(caught.value) and "\n" not in str(caught.value)


def test_other_files_are_refused(matrix, tmp_path):
    other = tmp_path / "other.mat"
    whole = write_coifman(tmp_path / "whole.mat", matrix).read_bytes()
    for content in (b"not a matrix" * 40, b"", whole[: len(whole) // 2]):
        other.write_bytes(content)
        with pytest.raises(ValueError, match="Cannot read"):
            load_coifman_li(other)
    savemat(other, {"matrix": matrix})
    with pytest.raises(ValueError, match="has no matrix 'data'"):
        load_coifman_li(other)
    savemat(other, {"data": "words"})
    with pytest.raises(ValueError, match="matrix of numbers"):
        load_coifman_li(other)
    with pytest.raises(ValueError, match=r"Cannot read .*none\.mat"):
        load_coifman_li(tmp_path / "none.mat")
    with pytest.raises(ValueError, match="positive length"):
        load_coifman_li(tmp_path / "none.mat", length=0.0)
