"""Coordinates by pencil and paper, and which ones are refused."""

from typing import Any

import numpy as np
import pytest

from rare_envs.distributions.coordinates import LEAST_DISTANCE, ClosingSpeed, Coordinates, as_finite, move_inside

CLOSING = {"closing_behind": "v", "gap": "gap"}
CONTENT: dict[str, Any] = {
    "names": ["v", "lead", "gap"],
    "order": ["v", "gap", "lead"],
    "coordinates": ["plain", CLOSING, "log"],
    "low": [0.0, 5.0, 1.0],
    "high": [45.0, 40.0, 150.0],
}
FOLLOWING = Coordinates.from_dict(CONTENT)
X = np.array([[20.0, 14.0, 9.0], [10.0, 30.0, 100.0]])


def test_coordinates_by_hand() -> None:
    assert FOLLOWING.columns == (0, 2, 1)
    expected = [[20.0, np.log(9.0), 2.0], [10.0, np.log(100.0), -2.0]]
    np.testing.assert_allclose(FOLLOWING.to_coordinates(X), expected, rtol=1e-14)


def test_ranges_follow_row_by_row() -> None:
    low, high = FOLLOWING.bounds(1, X)
    np.testing.assert_allclose(low, [-20.0 / 3.0, -3.0], rtol=1e-14)  # (20 - 40) / 3, (10 - 40) / 10
    np.testing.assert_allclose(high, [5.0, 0.5], rtol=1e-14)
    assert FOLLOWING.bounds(0, X) == (0.0, 45.0)
    assert FOLLOWING.bounds(2, X) == (0.0, np.log(150.0))


def test_a_column_comes_back_from_its_coordinate_strictly_inside() -> None:
    y = FOLLOWING.to_coordinates(X)
    for i, j in enumerate(FOLLOWING.columns):
        np.testing.assert_allclose(FOLLOWING.value(j, y[:, i], X), X[:, j], rtol=1e-14)
    low, high = FOLLOWING.bounds(1, X)
    assert (FOLLOWING.value(1, low, X) < 40.0).all()
    assert (FOLLOWING.value(1, high, X) > 5.0).all()


def test_jacobian_by_hand_and_signs() -> None:
    np.testing.assert_allclose(FOLLOWING.log_jacobian(X), -1.5 * np.log(X[:, 2]), rtol=1e-14)
    assert [FOLLOWING.sign(j) for j in range(3)] == [1.0, -1.0, 1.0]


def test_dictionary_round_trip() -> None:
    assert FOLLOWING.to_dict() == CONTENT
    assert Coordinates.from_dict({"low": [0.0], "high": [1.0]}).kinds == ("plain",)
    assert FOLLOWING.kinds[1] == ClosingSpeed("v", "gap")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"coordinates": ["plain", "sqrt", "log"]}, 'Unknown coordinate \'sqrt\'; known are "plain", "log" and'),
        ({"coordinates": ["plain", {**CLOSING, "gap": "space"}, "log"]}, "names no column 'space'; columns are v, lea"),
        (
            {"coordinates": ["plain", {**CLOSING, "gap": "lead"}, "log"]},
            "lead depends on lead, which must come earlier",
        ),
        ({"order": ["v", "lead", "gap"]}, "of lead depends on gap, which must come earlier in order; order is v, lead"),
        ({"order": ["v", "gap"]}, "order must have each of the columns v, lead, gap once, got v, gap"),
        ({"names": ["v", "lead"]}, "Expected 3 different names, one for each column, got v, lead"),
        ({"coordinates": ["log"]}, r"low of shape \(1,\), one for each column, got \(3,\)"),
        ({"low": [0.0, 5.0, 0.0]}, "The gap 'gap' of the closing speed of lead needs a positive low"),
        ({"low": [0.0, 50.0, 1.0]}, r"low must be below high, got \[50, 40\] at coordinate 1"),
    ],
)
def test_wrong_coordinates_are_refused_in_one_line(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        Coordinates.from_dict({**CONTENT, **change})
    assert "\n" not in str(caught.value)


def test_a_missing_end_of_the_box_is_named() -> None:
    with pytest.raises(ValueError, match="Missing high; needed are low and high"):
        Coordinates.from_dict({key: value for key, value in CONTENT.items() if key != "high"})


def test_values_move_off_the_ends_by_one_float() -> None:
    ends = move_inside(np.array([1.0, 1.5, 2.0]), 1.0, 2.0)
    assert ends.tolist() == [np.nextafter(1.0, 2.0), 1.5, np.nextafter(2.0, 1.0)]
    at_zero = move_inside(np.array([0.0, -0.5]), np.array([0.0, -1.0]), np.array([1.0, 0.0]))
    assert at_zero.tolist() == [LEAST_DISTANCE, -0.5]
    assert move_inside(np.array([0.0]), -1.0, 0.0).tolist() == [-LEAST_DISTANCE]
    with pytest.raises(ValueError, match="gaps must be finite"):
        as_finite("gaps", [1.0, np.inf])
