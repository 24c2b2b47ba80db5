"""Compared values: their difference, and tables that name what they do not have."""

from __future__ import annotations

import pytest

from rare_envs.study.reproduction.comparison import ComparedValue, ComparisonTable


@pytest.mark.parametrize(
    ("paper", "ours", "difference"),
    [
        (2.0, 3.0, 0.5),
        (4.0, 3.0, -0.25),
        (None, 3.0, None),
        (2.0, None, None),
        (0.0, 1.0, None),
        (-2.0, 1.0, None),
        (2.0, -1.0, None),
    ],
)
def test_the_difference_is_relative_to_the_paper(paper, ours, difference) -> None:
    value = ComparedValue(labels=("x",), quantity="p", paper=paper, ours=ours)
    assert value.difference == difference
    assert value.to_dict()["difference"] == difference


def test_a_table_has_the_labels_and_reasons_that_it_names() -> None:
    value = ComparedValue(labels=("x",), quantity="p", reasons=("traffic",))
    with pytest.raises(ValueError, match="Expected 2 labels"):
        ComparisonTable(name="t", title="t", keys=("a", "b"), values=(value,))
    with pytest.raises(ValueError, match="No explanation 'traffic'"):
        ComparisonTable(name="t", title="t", keys=("a",), values=(value,))
