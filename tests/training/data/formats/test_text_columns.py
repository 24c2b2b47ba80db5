"""Text files of numbers: headers, lines in errors, and the checks of tracks and lengths."""

import numpy as np
import pytest

from training.data.formats.text_columns import Rows, check_lengths, check_tracks, read_column_names, read_numbers


def rows_of(n):
    return Rows("road.csv", {}, np.arange(2, 2 + n))


def test_columns_are_found_by_any_of_their_names_in_any_case(tmp_path):
    path = tmp_path / "road.csv"
    path.write_text('place,"SPEED",Id\nnorth,1.5,7\nsouth,2,8\n', encoding="utf-8-sig")
    assert read_column_names(path) == ["place", "SPEED", "Id"]
    rows = read_numbers(path, {"v": ("velocity", "speed"), "place": ("Place",)}, text=("place",))
    assert rows["v"].tolist() == [1.5, 2.0]
    assert rows["place"].tolist() == ["north", "south"]
    assert rows.lines.tolist() == [2, 3]
    kept = rows.select(rows["v"] > 1.8)
    assert str(kept.error(0, "too fast")) == f"{path}, line 3: too fast"
    with pytest.raises(ValueError, match="lacks the columns width; it has place, SPEED, Id"):
        read_numbers(path, {"width": ("width",)})


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
