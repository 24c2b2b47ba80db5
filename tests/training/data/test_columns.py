"""Text files of numbers: headers, lines in errors, and the checks of tracks and lengths."""

import numpy as np
import pytest

from tests.training.data.published_files import (
    CLOCK,
    coifman_matrix,
    i24_documents,
    tgsim_rows,
    write_coifman,
    write_i24,
    write_tgsim,
)
from training.data.columns import Column, Rows, check_lengths, check_tracks, read_header, read_table
from training.data.formats import RECORDING_KINDS, load_recordings


def rows_of(n):
    return Rows("road.csv", {}, np.arange(2, 2 + n))


def test_columns_are_found_by_any_of_their_names_in_any_case(tmp_path):
    path = tmp_path / "road.csv"
    path.write_text('place,"SPEED",Id\nnorth,1.5,7\nsouth,2,8\n', encoding="utf-8-sig")
    assert read_header(path) == ["place", "SPEED", "Id"]
    rows = read_table(path, {"v": Column(("velocity", "speed"), 2.0), "place": Column(("Place",), text=True)})
    assert rows["v"].tolist() == [3.0, 4.0]
    assert rows["place"].tolist() == ["north", "south"]
    assert rows.lines.tolist() == [2, 3]
    kept = rows.select(rows["v"] > 3.6)
    assert str(kept.error(0, "too fast")) == f"{path}, line 3: too fast"
    with pytest.raises(ValueError, match="lacks the columns width; it has place, SPEED, Id"):
        read_table(path, {"width": Column(("width",))})


@pytest.mark.parametrize(
    ("speed", "step", "gaps", "message"),
    [
        (10.0, 1.0, "error", None),
        (71.0, 7.1, "error", "speed is 71 m/s, expected 0 to 70"),
        (10.0, 10.5, "error", "moved 10.5 m in 0.1 s"),
        (10.0, 0.79, "error", "0.79 times as fast"),
        (10.0, 0.81, "error", None),
        (10.0, 1.24, "error", None),
        (10.0, 1.26, "error", "1.26 times as fast"),
    ],
)
def test_positions_and_speeds_must_agree_within_a_fifth(speed, step, gaps, message):
    """Five frames, 0.1 s and `step` metres apart: the ratio is step / (0.1 speed)."""
    n = 5
    arguments = (rows_of(n), np.ones(n), np.arange(n), step * np.arange(n), np.full(n, speed), 0.1, gaps)
    if message is None:
        check_tracks(*arguments)
    else:
        with pytest.raises(ValueError, match=message):
            check_tracks(*arguments)


def test_a_missing_frame_is_an_error_or_a_cut():
    frame = np.array([0, 1, 4, 5])
    arguments = (rows_of(4), np.ones(4), frame, 1.0 * frame, np.full(4, 10.0), 0.1)
    with pytest.raises(ValueError, match=r"line 4: vehicle 1 was missing for 2 frames before"):
        check_tracks(*arguments, "error")
    check_tracks(*arguments, "cut")


def test_lengths_are_those_of_vehicles():
    check_lengths(rows_of(3), np.array([4.0, 4.5, 18.0]), "metres")
    with pytest.raises(ValueError, match=r"line 3: length of the vehicle is 0 m"):
        check_lengths(rows_of(3), np.array([4.0, 0.0, 5.0]), "metres")
    with pytest.raises(
        ValueError, match=r"median length of vehicles is 45 m, expected 2\.5 to 30; lengths were taken to be in feet"
    ):
        check_lengths(rows_of(3), np.full(3, 45.0), "feet")


def test_each_kind_is_read_by_its_loader(traffic, ngsim, highd, tmp_path):
    paths = {
        "ngsim": ngsim[0],
        "highd": highd[0],
        "tgsim": write_tgsim(tmp_path / "I294.csv", tgsim_rows(traffic)).parent,
        "i24": write_i24(tmp_path / "morning.json", i24_documents(traffic)),
        "coifman": write_coifman(tmp_path / "i80.mat", coifman_matrix(traffic)),
    }
    assert set(paths) == set(RECORDING_KINDS)
    found = {kind: {name for t in load_recordings(kind, path) for name in t.recording} for kind, path in paths.items()}
    assert found == {
        "ngsim": {"trajectories-us101"},
        "highd": {"01-lower", "01-upper"},
        "tgsim": {"I294-1-right"},
        "i24": {"morning-west"},
        "coifman": {"i80"},
    }
    (part,) = load_recordings("i24", paths["i24"], between=(CLOCK, CLOCK + 2.0))
    assert part.time.max() == pytest.approx(CLOCK + 2.0)
    assert len(list(load_recordings("highd", paths["highd"], recordings=("01",)))) == 1


def test_an_unknown_kind_is_refused():
    with pytest.raises(ValueError, match="Expected one of ngsim, highd, tgsim, i24, coifman, got 'waymo'"):
        next(load_recordings("waymo", "data"))
