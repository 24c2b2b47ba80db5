"""Columns of x: names and formatted values."""

from __future__ import annotations

import rare_envs
from rare_envs.study.columns import ORDINARY_DRAWS, draw_ordinary, format_value, list_columns

FOLLOWING = "rare_envs/CarFollowing-v0"


def test_columns_have_the_names_of_their_blocks() -> None:
    columns = list_columns(rare_envs.DrivingProblem("rare_envs/Highway-v0", horizon=2.0).space)
    assert [column.label for column in columns[:2]] == ["s[0] [m]", "s[1] [m]"]
    assert (columns[23].label, columns[24].label) == ("speed[5] [m/s]", "weights[0]")
    assert [column.shown for column in columns] == [True] * 24 + [False] * (404 + 220)
    assert [column.name for column in list_columns(rare_envs.DrivingProblem(FOLLOWING).space)] == [
        "ego_speed",
        "lead_speed",
        "gap",
    ]


def test_thin_air_is_not_shown_as_none() -> None:
    assert [format_value(value) for value in (1.9e-4, 0.03, 0.0, -12.345, -0.001)] == [
        "0.00019",
        "0.03",
        "0.00",
        "-12.35",
        "-0.001",
    ]
    assert [format_value(value, 1) for value in (0.002, 21.04)] == ["0.002", "21.0"]


def test_ordinary_scenarios_are_the_same_each_time() -> None:
    space = rare_envs.DrivingProblem(FOLLOWING).space
    first, again = draw_ordinary(space), draw_ordinary(space)
    assert first.shape == (ORDINARY_DRAWS, 3)
    assert (first == again).all()
