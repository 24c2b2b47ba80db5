"""The matrix of Coifman and Li, there and back: rear bumpers, assumed and known lengths, and what is refused."""

import numpy as np
import pytest
from scipy.io import savemat

from tests.training.data.formats.published_files import coifman_matrix, write_coifman
from tests.training.data.recordings import expected
from training.data.events import ASSUMED_START, bumper_gaps, car_following_events, cut_in_events, find_lane_changes
from training.data.formats.coifman_li import MEAN_LENGTH, load_coifman_li
from training.data.trajectories import COLUMNS


@pytest.fixture(scope="module")
def matrix(traffic):
    return coifman_matrix(traffic)


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
    for suffix in (".txt", ".csv"):
        text = write_coifman(tmp_path / f"i80{suffix}", matrix)
        if suffix == ".csv":
            text.write_text(text.read_text(encoding="utf-8").replace(" ", ","), encoding="utf-8")
        other = load_coifman_li(text, length=4.5)
        for name in COLUMNS:
            if table.column(name).dtype.kind == "f":
                np.testing.assert_allclose(other.column(name), table.column(name), atol=1e-5)
            else:
                assert (other.column(name) == table.column(name)).all()


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


def test_events_are_found_without_positions_across(traffic, matrix, tmp_path):
    table = load_coifman_li(write_coifman(tmp_path / "i80.mat", matrix))
    assert len(car_following_events(table)["ego"]) >= 10
    cuts = cut_in_events(table)
    crossings = find_lane_changes(table)
    assert len(crossings) >= 3
    assert (traffic.changed[table.vehicle[crossings] - 1] >= 0).all()
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
        (lambda m: m[:, :17], "has 17 columns; expected the 18 of NGSIM"),
        (lambda m: m[:0], "has no rows"),
        (lambda m: changed(m, 6, 5, np.nan), "line 7: y_along is nan, a number was expected"),
        (lambda m: changed(m, 6, 11, np.inf), "line 7: speed is inf"),
        (lambda m: changed(m, 6, 11, 400.0), r"line 7: speed is 121.9 m/s"),
        (lambda m: changed(m, slice(None), 8, 15.0), "values in v_Length, .* file of NGSIM's own"),
        (lambda m: np.concatenate([m, m[:1]]), r"vehicle 1 at frame \d+ is given twice, first in line 1"),
        (lambda m: np.delete(m, [8, 9], axis=0), "line 9: vehicle 1 was missing for 2 frames"),
        (lambda m: m * np.where(np.arange(18) == 5, 0.3048, 1.0), r"positions move 0\.30\d times as fast"),
    ],
)
@pytest.mark.parametrize("suffix", [".mat", ".txt"])
def test_broken_matrices_are_refused(spoil, message, suffix, matrix, tmp_path):
    spoiled = spoil(matrix)
    path = write_coifman(tmp_path / f"broken{suffix}", spoiled)
    with pytest.raises(ValueError, match="empty" if suffix == ".txt" and not len(spoiled) else message) as caught:
        load_coifman_li(path)
    assert "broken" in str(caught.value) and "\n" not in str(caught.value)


def test_holes_are_cut_on_request(matrix, tmp_path):
    path = write_coifman(tmp_path / "i80.mat", np.delete(matrix, [8, 9], axis=0))
    assert load_coifman_li(path, gaps="cut").track_starts()[1] == 8


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
