"""Raw NGSIM files, there and back: values, lanes, leaders, and every way to be broken."""

import numpy as np
import pytest

from tests.training.data.recordings import FOOT, LANE, change, check_values, expected, write_csv
from training.data.formats.ngsim import load_ngsim
from training.data.trajectories import COLUMNS, NOBODY, find_leaders

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
