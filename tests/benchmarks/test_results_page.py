"""The page of results is what the committed records give."""

from benchmarks.results_page import PAGE, format_page, format_table


def test_the_page_is_what_the_records_give() -> None:
    assert PAGE.read_text(encoding="utf-8") == format_page(), "run python -m benchmarks.results_page"
    assert len(format_page().splitlines()) <= 300


def test_a_table_has_a_line_below_its_heads() -> None:
    assert format_table(["a", "b"], [["1", "2"]]).splitlines() == ["| a | b |", "|---|---|", "| 1 | 2 |"]
