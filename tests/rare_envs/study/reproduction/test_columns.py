"""Columns of compared tables, and numbers as text."""

from __future__ import annotations

from rare_envs.study.reproduction.columns import (
    format_compared,
    format_compared_ends,
    format_difference,
    group_rows,
    list_compared_columns,
)
from rare_envs.study.reproduction.comparison import ComparedValue, ComparisonTable


def test_what_no_value_has_is_no_column() -> None:
    bare = ComparedValue(labels=("SS",), quantity="p", ours=0.5)
    full = ComparedValue(labels=("SS",), quantity="runs", ours=8.0, ours_all_in=28.0, paper_all_in=6.0)
    tables = [
        ComparisonTable(name="t", title="T", keys=("method",), values=values, all_in_title="search counted").to_dict()
        for values in ((bare,), (bare, full))
    ]
    assert [column.head for column in list_compared_columns(tables[0])] == ["quantity", "ours"]
    heads = ["quantity", "ours", "paper, search counted", "ours, search counted"]
    assert [column.head for column in list_compared_columns(tables[1])] == heads
    shown = [[column.show(value) for column in list_compared_columns(tables[1])] for value in tables[1]["values"]]
    assert shown == [["p", "0.5", "–", "–"], ["runs", "8", "6", "28"]]


def test_equal_labels_apart_are_two_groups() -> None:
    values = [{"labels": [name]} for name in ("a", "a", "b", "a")]
    assert [(labels, len(rows)) for labels, rows in group_rows({"values": values})] == [
        (["a"], 2),
        (["b"], 1),
        (["a"], 1),
    ]


def test_numbers_and_differences_as_text() -> None:
    assert [format_compared(each) for each in (0.0, 999.4, 1000.4)] == ["0", "999", "1,000"]
    assert [format_difference(each) for each in (0.0, 2.5, -0.95)] == ["+0 %", "× 3.5", "× 0.05"]
    assert format_compared_ends((1e-5, 2000.0)) == "1.00e-05 to 2,000"
