"""Text of pages: numbers that stay whole, pictures and commands as they are."""

import pytest
from markupsafe import Markup

from rare_envs.study.html_report.templating import keep_numbers_whole


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("0.11 % to 0.15 %", "0.11\xa0% to 0.15\xa0%"),
        ("3.1 × 10⁻⁵ (95 % confidence)", "3.1\xa0×\xa010⁻⁵ (95\xa0% confidence)"),
        ("nothing % here, 2 x 10", "nothing % here, 2 x 10"),
    ],
)
def test_no_line_ends_within_a_number(text: str, shown: str) -> None:
    assert keep_numbers_whole(text) == shown


@pytest.mark.parametrize("value", [Markup("<svg>50 %</svg>"), 3, None])
def test_pictures_and_values_that_are_no_text_stay(value: object) -> None:
    assert keep_numbers_whole(value) is value
