from html.parser import HTMLParser

import samplers
from samplers.display import html_table


class Reader(HTMLParser):
    """Collect the texts of cells, and every element that was opened."""

    def __init__(self) -> None:
        super().__init__()
        self.texts: list[str] = []
        self.tags: list[str] = []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)

    def handle_data(self, data):
        self.texts.append(data)


def read(html):
    reader = Reader()
    reader.feed(html)
    return reader


def test_text_is_escaped_everywhere():
    evil = "<script>alert('x')</script>"
    found = read(html_table(evil, [(evil, evil)], [evil], [evil]))
    assert found.texts == [evil] * 5
    assert "script" not in found.tags


def test_rows_and_header_have_their_cells():
    found = read(html_table("", [("a", "1", "2")], ["", "first", "second"]))
    assert found.texts == ["first", "second", "a", "1", "2"]
    assert "caption" not in found.tags


def test_results_show_what_their_text_says():
    a, b = (samplers.FunctionProblem(lambda x, at=at: at - x[:, 0], dim=2) for at in (3.0, 3.2))
    result = samplers.estimate(a, seed=0, max_sim=2000)
    shown = read(result._repr_html_())
    assert f"P[f <= 0] = {result.p:.3e}" in shown.texts
    assert "2,000" in shown.texts
    comparison = samplers.compare(a, b, seed=0, max_sim=4000)
    assert f"{comparison.ratio:.3g}" in read(comparison._repr_html_()).texts
    curve = result.curve([0.0, 1.0])
    assert [f"{p:.3e}" for p in curve.p] == [text for text in read(curve._repr_html_()).texts if text[1:2] == "."][::2]


def test_warnings_are_shown():
    few = samplers.estimate(samplers.FunctionProblem(lambda x: 3.0 - x[:, 0], dim=1), "mc", seed=0, max_sim=100)
    assert f"warning: {few.warnings[0]}" in read(few._repr_html_()).texts
